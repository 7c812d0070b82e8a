//! What the keys of exchanges and of Modbus mean in the configuration.

use proto_core::config::{
    Bus, CanFields, Coil, Echo, Exchange, ExchangeBuilder, ExchangeFrame, FieldSpec, GatewayConfig,
    InputBinding, InputField, OnStale, OutputBinding, OutputField, Parity, Parts, Port, Recipe, Rs485, Span,
    StateValue, Transaction, Triggers,
};
use proto_core::device::{Algorithm, Bits, ByteOrder, Checksum, Encoding, Kind};
use proto_core::modbus::rtu::{Operation, Table};
use proto_core::sysvar::SysVar;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;
use recipe_config::file::{Text, parse_gateway, parse_recipes};

const LINE: &str = include_str!("good/line.toml");

fn line() -> Box<GatewayConfig> {
    parse_gateway(Text { name: "line.toml", toml: LINE }, &[]).unwrap_or_else(|error| panic!("{error}"))
}

/// The exchanges of a recipe.
fn exchanges(config: &GatewayConfig, recipe: usize) -> &[Exchange] {
    config.view().exchanges_of(&config.recipes[recipe])
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn to(name: &str) -> InputBinding {
    InputBinding::Variable { var: SysVar::parse(name).unwrap(), scale: 1.0, offset: 0.0 }
}

fn rtu(config: &GatewayConfig, nth: usize) -> (Operation, &[FieldSpec], &[FieldSpec]) {
    match exchanges(config, 0)[nth].transaction {
        Transaction::Rtu { operation, written, read } => {
            (operation, written.of(&config.fields), read.of(&config.fields))
        }
        other => panic!("{other:?}"),
    }
}

fn coil(first: u8, shared: bool) -> Encoding {
    let kind = Kind::Bits(Bits { bytes: 1, first, count: 1, signed: false });
    Encoding { kind, order: ByteOrder::Little, shared }
}

#[test]
fn a_master_has_its_registers() {
    let config = line();
    assert_eq!(config.recipes[0].parts, Parts::Stream { input: None, output: None });
    let first = exchanges(&config, 0)[0];
    assert_eq!((first.peer, first.timeout, first.retries, first.pause), (9, ms(50), 2, ms(5)));
    assert_eq!(first.when, Triggers::every(ms(100)));
    let (operation, written, read) = rtu(&config, 0);
    assert_eq!(operation, Operation::ReadInputRegisters { address: 0x07D0, count: 5 });
    assert!(written.is_empty());
    let order = |field: &FieldSpec| field.element()?.encoding().map(|encoding| encoding.order);
    assert_eq!(order(&read[0]), Some(ByteOrder::BigSwapped), "the exchange's order of words");
    assert_eq!(order(&read[3]), Some(ByteOrder::Big), "of a register");

    let (operation, written, read) = rtu(&config, 1);
    let (read_address, write_address) = (0x10, 0x20);
    assert_eq!(
        operation,
        Operation::ReadWriteRegisters { read_address, read_count: 2, write_address, write_count: 2 }
    );
    assert_eq!((order(&read[0]), written.len()), (Some(ByteOrder::Big), 2));
    let second = exchanges(&config, 0)[1];
    let rising = Some((SysVar::parse("BitOutputReg[3]").unwrap(), 0));
    assert_eq!(second.when, Triggers { every: None, start: true, change: true, rising });
    assert_eq!((second.timeout, second.retries, second.pause), (ms(100), 1, ms(0)), "the defaults");
    assert_eq!(rtu(&config, 5).0, Operation::WriteRegister { address: 1 });
}

#[test]
fn bits_of_a_register_leave_the_others_as_they_are() {
    let fields = "write = [{ name = \"light\", type = \"word\", bits = 2, from = \"BitOutputReg[3].1\" }, \
                  { name = \"level\", type = \"word\", bits = \"8..11\", from = \"WordOutputReg[2]\" }]";
    let speed = "write = [{ name = \"speed\", type = \"word\", from = \"WordOutputReg[3]\" }]";
    for function in ["\"mask-write-register\"", "22"] {
        let toml = LINE.replace(speed, fields).replace("\"write-register\"", function);
        let config = parse_gateway(Text { name: "line.toml", toml: &toml }, &[]).unwrap();
        let (operation, written, read) = rtu(&config, 5);
        assert_eq!(operation, Operation::MaskWriteRegister { address: 1, mask: 0x0F04 });
        assert_eq!((written.len(), read.len()), (2, 0));
        // As tools show it: address and function, where, what is kept, the bits, the CRC.
        let recipes = parse_recipes(Text { name: "line.toml", toml: &toml }, &[]).unwrap();
        let recipe_config::AnyRecipe::Device(recipe) = &recipes[0] else { panic!() };
        let exchange = &recipe.exchanges[5];
        for frame in [&exchange.request, &exchange.reply] {
            let frame =
                frame.as_ref().unwrap().lay_out(recipe.carrier, proto_core::sysvar::Direction::Output);
            let (frame, mut out) = (frame.unwrap(), [0; 16]);
            let bits = |nth: usize| if nth == 4 { 1.0 } else { 5.0 };
            assert_eq!(frame.layout.encode(&frame.elements, bits, &mut out), Some(10));
            assert_eq!(out[..8], [6, 22, 0, 1, 0xF0, 0xFB, 0x05, 0x04]);
        }
    }
}

#[test]
fn coils_share_bytes_lowest_first() {
    let config = line();
    let (operation, _, read) = rtu(&config, 2);
    assert_eq!(operation, Operation::ReadCoils { address: 0, count: 28 });
    assert_eq!(operation.read_len(), 4);
    let value = |first, shared, to| FieldSpec::DeviceInput {
        encoding: coil(first, shared),
        overflow: Default::default(),
        to,
    };
    let start = read[1];
    assert_eq!(
        read,
        [
            value(0, false, to("WordInputReg[4]")),
            start,
            FieldSpec::Fixed { encoding: coil(5, true), value: 1 },
            FieldSpec::Padding { len: 1, fill: 0 },
            value(2, false, InputBinding::Unused),
            FieldSpec::Padding { len: 1, fill: 0 },
        ]
    );
    assert!(
        matches!(start, FieldSpec::DeviceInput { encoding, to: InputBinding::Commands { .. }, .. } if encoding == coil(4, true))
    );

    let (operation, written, _) = rtu(&config, 3);
    assert_eq!((operation, written.len()), (Operation::WriteCoil { address: 0xAC }, 1));
    let (operation, written, _) = rtu(&config, 4);
    assert_eq!(operation, Operation::WriteCoils { address: 0, count: 3 });
    let output = |first, shared, from| FieldSpec::DeviceOutput {
        encoding: coil(first, shared),
        overflow: Default::default(),
        from,
    };
    assert_eq!(
        written,
        [output(0, false, OutputBinding::Constant(1.0)), output(2, true, OutputBinding::Counter)]
    );
}

#[test]
fn a_slave_serves_its_blocks() {
    let config = line();
    let blocks = exchanges(&config, 1);
    let operations: Vec<_> = blocks
        .iter()
        .map(|block| match block.transaction {
            Transaction::Served { operation, written, read } => {
                (block.peer, operation, written.len, read.len)
            }
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(
        operations,
        [
            (5, Operation::ReadHoldingRegisters { address: 0, count: 3 }, 0, 2),
            (5, Operation::WriteRegisters { address: 100, count: 2 }, 1, 0),
            (5, Operation::ReadDiscreteInputs { address: 0, count: 10 }, 0, 2),
            (5, Operation::WriteCoils { address: 7, count: 1 }, 1, 0),
        ]
    );
    assert!(blocks.iter().all(|block| block.when.is_never()));
}

#[test]
fn an_exchange_has_frames_of_its_own() {
    let config = line();
    let talk = exchanges(&config, 2);
    assert_eq!((talk[0].peer, talk[0].when), (3, Triggers::every(ms(50))));
    assert_eq!(
        talk[0].transaction,
        Transaction::Frames { request: Some(0), reply: Some(1), refusal: Some(2) }
    );
    assert_eq!(talk[1].transaction, Transaction::Frames { request: None, reply: Some(3), refusal: None });
    assert_eq!(talk[2].transaction, Transaction::Frames { request: Some(4), reply: None, refusal: None });
    assert_eq!(talk[2].pause, ms(10));
    let reply = &config.frames[1];
    assert_eq!((&reply.head[..], &reply.tail[..], reply.id, reply.remote), (&[2][..], &[3][..], None, false));

    let drive = exchanges(&config, 3);
    assert_eq!(drive[0].when, Triggers { start: true, ..Triggers::NEVER });
    let Transaction::Frames { request: Some(request), .. } = drive[1].transaction else {
        panic!("{:?}", drive[1])
    };
    let request = &config.frames[usize::from(request)];
    assert_eq!((request.id, request.remote), (Some(CanId::Standard(0x701)), true));
    assert_eq!(request.fields.len, 0);
}

#[test]
fn lines_of_modbus_have_its_silences() {
    let config = line();
    let lines: Vec<_> = config
        .ports
        .iter()
        .filter_map(|port| match port.bus {
            Bus::Rs485(line) => Some((line.idle_gap, line.turnaround, line.echo)),
            _ => None,
        })
        .collect();
    // 3.5 characters of 11 bits at 19200 bit/s; 1750 µs above; a plain line.
    let (slow, fast) = (Duration::from_micros(2_006), Duration::from_micros(1_750));
    let plain = Rs485::default();
    // A reply may come in pieces, so a master waits as long for its end as others do.
    let usual = plain.idle_gap;
    assert_eq!(
        lines,
        [(usual, slow, Echo::Yes), (ms(3), fast, Echo::Auto), (usual, plain.turnaround, Echo::Auto)]
    );
}

#[test]
fn tools_get_whole_frames() {
    let recipes = parse_recipes(Text { name: "line.toml", toml: LINE }, &[]).unwrap();
    let recipe_config::AnyRecipe::Device(line) = &recipes[0] else { panic!("{:?}", recipes[0]) };
    let names = |frame: &Option<recipe_config::NamedFrame>| -> Vec<String> {
        frame.iter().flat_map(|frame| &frame.fields).map(|field| field.name.clone()).collect()
    };
    let exchange = &line.exchanges[1];
    assert_eq!(
        names(&exchange.request),
        ["slave", "function", "address", "count", "write-address", "write-count", "bytes", "wanted", "", ""]
    );
    assert_eq!(names(&exchange.reply), ["slave", "function", "bytes", "position", ""]);
    assert_eq!(names(&exchange.refusal), ["slave", "function", "code", ""]);
    assert_eq!(names(&line.exchanges[4].reply), [""; 0], "nobody answers a broadcast");
}

#[test]
fn a_program_writes_what_a_file_says() {
    let coil = Coil;
    let position = Encoding::scalar(ScalarType::Float).big_endian();
    let total = Encoding::scalar(ScalarType::Dword).ordered(ByteOrder::BigSwapped);
    let crc = Checksum::standard(Algorithm::named("xor8").unwrap());
    let built: GatewayConfig = GatewayConfig::builder()
        .controller("192.168.12.138")
        .recipe(
            Recipe::user("line").exchanges(&[
                ExchangeBuilder::read_input_registers(
                    9,
                    0x07D0,
                    &[
                        InputField::variable(total, "WordInputReg[1]").wrapping(),
                        InputField::commands(ScalarType::Byte, &[(1, "stop")]),
                        InputField::padding(1),
                        InputField::constant(ScalarType::Word, 7),
                        InputField::variable(Encoding::bit(ScalarType::Word, 3), "WordInputReg[2]"),
                        InputField::unused(Encoding::bits(ScalarType::Word, 4..=7).big_endian().shared()),
                    ],
                )
                .every(ms(100))
                .timeout(ms(50))
                .retries(2)
                .pause(ms(5)),
                ExchangeBuilder::read_write_registers(
                    9,
                    (0x10, &[InputField::variable(position, "WordInputReg[3]")]),
                    (
                        0x20,
                        &[
                            OutputField::variable(ScalarType::Short, "WordOutputReg[1]"),
                            OutputField::padding(2, 0xFF),
                        ],
                    ),
                )
                .at_start()
                .on_change()
                .on_rising("BitOutputReg[3]", 0),
                ExchangeBuilder::read_coils(
                    5,
                    0,
                    &[
                        InputField::variable(coil, "WordInputReg[4]"),
                        InputField::padding(3),
                        InputField::commands(coil, &[(1, "run(pick.jspf,50)")]),
                        InputField::constant(coil, 1),
                        InputField::padding(12),
                        InputField::unused(coil),
                        InputField::padding(9),
                    ],
                )
                .every(ms(20)),
                ExchangeBuilder::write_coil(5, 0xAC, &[OutputField::variable(coil, "WordOutputReg[2]")])
                    .on_change(),
                ExchangeBuilder::write_coils(
                    0,
                    0,
                    &[
                        OutputField::constant(coil, 1.0),
                        OutputField::padding(1, 0),
                        OutputField::counter(coil),
                    ],
                )
                .every(ms(1000)),
                ExchangeBuilder::write_register(
                    6,
                    1,
                    &[OutputField::variable(ScalarType::Word, "WordOutputReg[3]")],
                )
                .every(ms(500)),
            ]),
        )
        .recipe(Recipe::user("plc").exchanges(&[
            ExchangeBuilder::served(
                5,
                Table::HoldingRegisters,
                0,
                &[
                    OutputField::variable(ScalarType::Float, "RobotState[8]"),
                    OutputField::constant(ScalarType::Word, 1.0),
                ],
            ),
            ExchangeBuilder::served(
                5,
                Table::HoldingRegisters,
                100,
                &[InputField::variable(total, "WordInputReg[10]")],
            ),
            ExchangeBuilder::served(
                5,
                Table::DiscreteInputs,
                0,
                &[
                    OutputField::state(coil, StateValue::parse("mode").unwrap()),
                    OutputField::padding(8, 0),
                    OutputField::constant(coil, 1.0),
                ],
            ),
            ExchangeBuilder::served(5, Table::Coils, 7, &[InputField::commands(coil, &[(1, "stop")])]),
        ]))
        .recipe(
            Recipe::user("talk").exchanges(&[ExchangeBuilder::request(ExchangeFrame::stream(
                &[2],
                &[3],
                &[
                    OutputField::constant(ScalarType::Byte, 87.0),
                    OutputField::constant(ScalarType::Byte, 63.0),
                    OutputField::checksum(crc),
                ],
            ))
            .reply(ExchangeFrame::stream(
                &[2],
                &[3],
                &[
                    InputField::constant(ScalarType::Byte, 87),
                    InputField::variable(total, "WordInputReg[11]").wrapping(),
                    InputField::checksum(crc),
                ],
            ))
            .refusal(ExchangeFrame::stream(
                &[],
                &[],
                &[InputField::constant(ScalarType::Byte, 0x15), InputField::unused(ScalarType::Byte)],
            ))
            .peer(3)
            .every(ms(50))]),
        )
        .recipe(
            Recipe::user("drive")
                .can_input(&[CanFields::standard(
                    0x181,
                    &[InputField::variable(ScalarType::Word, "WordInputReg[13]")],
                )])
                .exchanges(&[ExchangeBuilder::request(ExchangeFrame::remote(CanId::Standard(0x701)))
                    .reply(ExchangeFrame::can(
                        CanId::Standard(0x701),
                        &[InputField::variable(ScalarType::Byte, "WordInputReg[15]")],
                    ))
                    .peer(1)
                    .every(ms(100))]),
        )
        .port(
            Port::modbus_rtu("line", "line")
                .baud(19_200)
                .parity(Parity::Even)
                .timeout(ms(2000))
                .echo(Echo::Yes),
        )
        .port(Port::modbus_rtu_slave("plc", "plc").idle_gap(ms(3)))
        .port(Port::rs485("talk", "talk"))
        .port(Port::can("drive", "drive"))
        .build()
        .unwrap();
    let file = line();
    for recipe in 0..4 {
        let (file, built) = (shown(&file, recipe), shown(&built, recipe));
        match recipe {
            // The file has more of them.
            2 => assert_eq!(file[..built.len()], built[..]),
            3 => assert_eq!(file[1..], built[..]),
            _ => assert_eq!(file, built),
        }
    }
    assert_eq!(file.ports, built.ports);
}

/// The exchanges of a recipe, with their frames and fields in place of ranges; constants of requests are
/// those of replies.
fn shown(config: &GatewayConfig, recipe: usize) -> Vec<String> {
    let fields = |span: Span| span.of(&config.fields).iter().map(show_field).collect::<Vec<_>>();
    let frame = |nth: Option<u8>| {
        let frame = config.frames.get(usize::from(nth?)).unwrap();
        Some((frame.id, frame.remote, &frame.head, &frame.tail, fields(frame.fields)))
    };
    let show = |exchange: &Exchange| {
        let timing = (exchange.peer, exchange.when, exchange.timeout, exchange.retries, exchange.pause);
        match exchange.transaction {
            Transaction::Rtu { operation, written, read }
            | Transaction::Served { operation, written, read } => {
                format!("{timing:?} {operation:?} {:?} {:?}", fields(written), fields(read))
            }
            Transaction::Frames { request, reply, refusal } => {
                format!(
                    "{timing:?} {:?} {:?} {:?} {:?}",
                    frame(request),
                    frame(reply),
                    frame(exchange.pending),
                    frame(refusal)
                )
            }
        }
    };
    exchanges(config, recipe).iter().map(show).collect()
}

fn show_field(field: &FieldSpec) -> String {
    match *field {
        // A text of a file is constants.
        FieldSpec::Fixed { encoding, value } if encoding == Encoding::scalar(ScalarType::Byte) => {
            format!("constant {value}")
        }
        FieldSpec::UserOutput { ty: ScalarType::Byte, from: OutputBinding::Constant(value) } => {
            format!("constant {value}")
        }
        FieldSpec::DeviceInput { encoding, overflow, to: InputBinding::Commands { when, .. } } => {
            format!("commands {encoding:?} {overflow:?} {when:?}")
        }
        FieldSpec::UserInput { ty, to: InputBinding::Commands { when, .. } } => {
            format!("commands {ty} {when:?}")
        }
        other => format!("{other:?}"),
    }
}

#[test]
fn a_slave_can_refuse_to_show_stale_values() {
    let stale = LINE.replace("address = 5\n", "address = 5\non_stale = \"stop\"\n");
    assert_ne!(LINE, stale);
    let config = parse_gateway(Text { name: "line.toml", toml: &stale }, &[]).unwrap();
    let on_stale: Vec<_> = config.recipes.iter().map(|recipe| recipe.on_stale).collect();
    assert_eq!(on_stale[..3], [OnStale::Hold, OnStale::Stop, OnStale::Hold]);
}

#[test]
fn a_request_may_be_a_head_alone_and_its_constants_need_no_names() {
    let toml = |first: &str, second: &str| {
        format!(
            "[controller]\naddress = \"192.168.12.138\"\n\n[[recipe]]\nname = \"gripper\"\nkind = \"stream\"\nmode = \
             \"user\"\n\n[[recipe.exchange]]\nevery_ms = 100\nrequest = {{ {first} }}\nreply = {{ head = [1, 3], \
             fields = [] }}\n\n[[recipe.exchange]]\non = [\"start\"]\nrequest = {{ head = [2], fields = [{second}] \
             }}\n\n[[port]]\nname = \"line\"\nbus = \"rs485\"\nrecipe = \"gripper\"\n"
        )
    };
    let read = |first: &str, second: &str| {
        parse_gateway(Text { name: "cell.toml", toml: &toml(first, second) }, &[])
            .map_err(|error| error.to_string())
    };
    let alone = "head = [1, 3], checksum = { kind = \"crc16-modbus\" }, fields = []";
    let config = read(alone, "{ type = \"byte\", value = 0x41 }, { type = \"word\", value = 500 }").unwrap();
    let values: Vec<_> = config
        .fields
        .iter()
        .filter_map(|field| match field {
            FieldSpec::Fixed { value, .. } => Some(*value),
            _ => None,
        })
        .collect();
    assert_eq!(values, [0x41, 500]);
    let frames =
        parse_recipes(Text { name: "cell.toml", toml: &toml(alone, "{ type = \"byte\", value = 1 }") }, &[]);
    let Some(recipe_config::AnyRecipe::Device(recipe)) = frames.unwrap().pop() else { panic!() };
    let request = recipe.exchanges[0].request.as_ref().unwrap();
    let frame = request.lay_out(recipe.carrier, proto_core::sysvar::Direction::Output).unwrap();
    assert_eq!(frame.layout.lengths(), (4, 4));
    assert_eq!(recipe.exchanges[1].request.as_ref().unwrap().fields[0].name, "");
    let constant = "{ type = \"byte\", value = 1 }";
    for (first, second, said) in [
        ("fields = []", constant, "request: the frame has no fields"),
        (alone, "{ type = \"byte\", value = 256 }", "exchange[2].request.fields[1]: "),
        (alone, "{ type = \"byte\", value = 0.5 }", "0.5 has a fraction"),
        (alone, "{ type = \"float\", value = 1 }", "a constant that may have a fraction needs a name"),
        (alone, "{ type = \"byte\", from = \"counter\" }", "name is missing; give the field a name"),
    ] {
        let error = read(first, second).unwrap_err();
        assert!(error.contains(said), "{second}: {error}");
    }
}
