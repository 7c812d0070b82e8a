//! Exchanges that a program writes: what is refused, where, and how long they take.

use proto_core::config::*;
use proto_core::device::Encoding;
use proto_core::modbus::rtu::{Operation, Table};
use proto_core::sysvar::Direction;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType::{Byte, Dword, Float, Word};

type Config = GatewayConfig;

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn register() -> [InputField<'static>; 1] {
    [InputField::variable(Word, "WordInputReg[1]")]
}

fn value() -> [OutputField<'static>; 1] {
    [OutputField::variable(Word, "WordOutputReg[1]")]
}

/// A configuration with one recipe of these exchanges on a line of its own.
fn with(asks: &[ExchangeBuilder<'_>]) -> Result<Config, ConfigError> {
    let config = Config::builder().controller("10.0.0.2").recipe(Recipe::user("line").exchanges(asks));
    match asks.iter().any(|ask| format!("{ask:?}").contains("Some(Standard")) {
        true => config.port(Port::can("line", "line")).build(),
        false => config.port(Port::modbus_rtu("line", "line").baud(19_200)).build(),
    }
}

#[track_caller]
fn refused(asks: &[ExchangeBuilder<'_>]) -> String {
    with(asks).expect_err("it is wrong").to_string()
}

#[track_caller]
fn assert_refused(asks: &[ExchangeBuilder<'_>], said: &str) {
    assert_eq!(refused(asks), format!("recipe 1, exchange {}: {said}", asks.len()));
}

/// `nth` says which key, with its comma.
#[track_caller]
fn assert_refused_at(asks: &[ExchangeBuilder<'_>], key: &str, said: &str) {
    assert_eq!(refused(asks), format!("recipe 1, exchange {}, {key}: {said}", asks.len()));
}

#[test]
fn mistakes_in_modbus_have_their_place() {
    let (register, value) = (register(), value());
    let read = ExchangeBuilder::read_holding_registers(9, 0, &register).every(ms(100));
    let write = ExchangeBuilder::write_registers(9, 0, &value).on_change();
    assert!(with(&[read, write]).is_ok());
    assert_refused(
        &[ExchangeBuilder::read_holding_registers(9, 0, &register)],
        "it would never be asked; set every_ms, on or follow",
    );
    assert_refused_at(
        &[read, ExchangeBuilder::write_registers(248, 0, &value).on_change()],
        "peer",
        "slave 248 is out of range; allowed: 1..=247, or 0 to write to all of them",
    );
    assert_refused_at(
        &[ExchangeBuilder::read_holding_registers(0, 0, &register).at_start()],
        "peer",
        "slave 0 is all of them, which cannot be read; allowed: writes",
    );
    assert_refused_at(&[read.every(ms(0))], "period", "must be longer than 0");
    assert_refused_at(&[read.timeout(ms(0))], "timeout", "must be longer than 0");
    assert_refused_at(&[read.pause(ms(10_001))], "pause", "10001 ms is too long; at most 10000 ms");
    assert_refused_at(
        &[read.on_rising("WordOutputReg[1]", 0)],
        "rising bit",
        "WordOutputReg[1] is a word; a trigger needs a variable made of bits",
    );
    assert_refused_at(
        &[ExchangeBuilder::read_holding_registers(9, 0xFFFF, &[InputField::padding(4)]).every(ms(100))],
        "registers or coils",
        "65535 to 65536 are out of range; the last register or coil is 65535",
    );
    assert_refused_at(
        &[ExchangeBuilder::read_holding_registers(9, 0, &[InputField::padding(3)]).every(ms(100))],
        "registers or coils",
        "the fields have 3 bytes, the registers or coils 2; pad fills them up",
    );
    assert_refused_at(
        &[ExchangeBuilder::read_holding_registers(9, 0, &[InputField::padding(255)]).every(ms(100))],
        "registers or coils",
        "a count of 127 is out of range; allowed: 1..=125",
    );
    assert_refused_at(
        &[ExchangeBuilder::read_coils(9, 0, &register).every(ms(100))],
        "registers or coils",
        "the fields of coils are one bit each; their type is Coil",
    );
    assert_refused_at(
        &[ExchangeBuilder::write_register(9, 0, &[OutputField::variable(Dword, "WordOutputReg[1]")])
            .on_change()],
        "registers or coils",
        "the fields have 4 bytes, the registers or coils 2; pad fills them up",
    );
    assert_refused_at(
        &[ExchangeBuilder::mask_write_register(9, 0, &[OutputField::variable(Dword, "WordOutputReg[1]")])
            .on_change()],
        "registers or coils",
        "the fields have 4 bytes, the registers or coils 2; pad fills them up",
    );
    let some = "the fields are some bits of the register, not all; those are written with write-register";
    for fields in [OutputField::variable(Word, "WordOutputReg[1]"), OutputField::padding(2, 0xFF)] {
        let ask = ExchangeBuilder::mask_write_register(9, 0, core::slice::from_ref(&fields));
        assert_refused_at(&[ask.on_change()], "registers or coils", some);
    }
    assert_refused_at(
        &[ExchangeBuilder::read_holding_registers(
            9,
            0,
            &[InputField::unused(Encoding::decimal_until(b','))],
        )
        .every(ms(100))],
        "registers or coils",
        "fields in registers have a fixed length; give the text a width",
    );
    // Frames are counted on: the first of the output part, field 2.
    let wrong =
        [OutputField::padding(2, 0), OutputField::variable(Word, "WordOutputReg[1]").scaled(0.0, 0.0)];
    assert_eq!(
        refused(&[read, write, ExchangeBuilder::write_registers(9, 7, &wrong).on_change()]),
        "recipe 1, output part, frame 2, field 2: scale 0 and offset 0 must be finite numbers, and scale \
         not 0: the value would be lost"
    );
    let many: Vec<_> =
        (1..=33).map(|slave| ExchangeBuilder::write_registers(slave, 0, &value).on_change()).collect();
    assert!(with(&many[..32]).is_ok());
    assert_refused_at(&many, "peer", "one slave or other peer too many; allowed: up to 32 on a port");
}

#[test]
fn the_bits_that_are_written_are_those_of_the_fields() {
    let bits = |first, last| OutputField::variable(Encoding::bits(Word, first..=last), "WordOutputReg[1]");
    let more = |encoding: Encoding| OutputField::constant(encoding.shared(), 1.0);
    let halves = |first: OutputField<'static>| vec![first, OutputField::padding(1, 0xFF)];
    for (fields, expected) in [
        (vec![bits(3, 3)], 0x0008),
        (vec![bits(0, 14)], 0x7FFF),
        (vec![bits(8, 11), more(Encoding::bit(Word, 0))], 0x0F01),
        (halves(OutputField::variable(Byte, "WordOutputReg[1]")), 0xFF00),
        (halves(OutputField::variable(Encoding::bit(Byte, 7), "WordOutputReg[1]")), 0x8000),
    ] {
        let config = with(&[ExchangeBuilder::mask_write_register(9, 5, &fields).on_change()]).unwrap();
        let Transaction::Rtu { operation, .. } = config.exchanges[0].transaction else { panic!() };
        assert_eq!(operation, Operation::MaskWriteRegister { address: 5, mask: expected }, "{fields:?}");
        // Another mask than that of the fields.
        let mut config = config;
        let Transaction::Rtu { operation, .. } = &mut config.exchanges[0].transaction else { panic!() };
        *operation = Operation::MaskWriteRegister { address: 5, mask: expected ^ 0x0010 };
        assert_eq!(config.validate().unwrap_err().kind, ConfigErrorKind::Exchange(ExchangeError::Mask));
    }
}

#[test]
fn mistakes_in_blocks_have_their_place() {
    let (register, value) = (register(), value());
    let block = ExchangeBuilder::served(5, Table::HoldingRegisters, 10, &value);
    assert!(with(&[block, ExchangeBuilder::served(5, Table::HoldingRegisters, 11, &register)]).is_ok());
    assert!(
        with(&[block, ExchangeBuilder::served(5, Table::InputRegisters, 10, &value)]).is_ok(),
        "another table"
    );
    assert_refused_at(
        &[block, ExchangeBuilder::served(5, Table::HoldingRegisters, 9, &[InputField::padding(4)])],
        "registers or coils",
        "an earlier block has some of these registers or coils",
    );
    assert_refused_at(
        &[block, ExchangeBuilder::served(6, Table::Coils, 9, &[OutputField::constant(Coil, 1.0)])],
        "peer",
        "the blocks of a slave have one address",
    );
    assert_refused_at(
        &[ExchangeBuilder::served(0, Table::Coils, 9, &[OutputField::constant(Coil, 1.0)])],
        "peer",
        "address 0 is out of range; allowed: 1..=247",
    );
    assert_refused(&[block.every(ms(100))], "there is no request to send; remove every_ms and on");
    assert_refused(
        &[block, ExchangeBuilder::read_holding_registers(9, 0, &register).every(ms(100))],
        "a recipe has exchanges of one kind: Modbus master, Modbus slave, or frames",
    );
    // A master writes input registers: nothing such is served.
    let mut config = with(&[block]).unwrap();
    let Transaction::Served { operation, .. } = &mut config.exchanges[0].transaction else { panic!() };
    *operation = Operation::WriteRegister { address: 10 };
    assert_eq!(config.validate().unwrap_err().kind, ConfigErrorKind::Exchange(ExchangeError::NotServed));
}

#[test]
fn mistakes_in_frames_have_their_place() {
    let (register, value) = (register(), value());
    let frame = ExchangeFrame::stream(&[2], &[3], &value);
    let reply = ExchangeFrame::stream(&[2], &[3], &register);
    let ask = ExchangeBuilder::request(frame).every(ms(100));
    assert!(
        with(&[
            ask.reply(reply),
            ExchangeBuilder::unasked(ExchangeFrame::stream(&[4], &[], &[InputField::unused(Byte)]))
        ])
        .is_ok()
    );
    assert_refused(&[ExchangeBuilder::request(frame)], "it would never be asked; set every_ms, on or follow");
    assert_refused(
        &[ExchangeBuilder::unasked(reply).at_start()],
        "there is no request to send; remove every_ms and on",
    );
    let lone = "a pending answer or a refusal answers a request that has a reply";
    assert_refused_at(&[ask.refusal(reply)], "refusal", lone);
    assert_refused_at(&[ask.pending(reply)], "pending", lone);
    let id = CanId::Standard(0x701);
    let unused = [InputField::unused(Byte)];
    let can = ExchangeFrame::can(id, &unused);
    assert!(with(&[ExchangeBuilder::request(ExchangeFrame::remote(id)).reply(can).at_start()]).is_ok());
    assert_refused_at(
        &[ExchangeBuilder::request(frame).reply(can).at_start()],
        "request",
        "frames of a CAN recipe have an id, those of a stream recipe have none",
    );
    assert_refused_at(
        &[ExchangeBuilder::request(ExchangeFrame::can(id, &value))
            .reply(ExchangeFrame::remote(id))
            .at_start()],
        "reply",
        "only a request can be remote",
    );
    assert_eq!(
        refused(&[ask, ask.reply(ExchangeFrame::stream(&[], &[], &register))]),
        "recipe 1, input part, frame 1: nothing tells where a frame begins: a head, a tail, a checksum or \
         a constant is needed"
    );
    let mut config = with(&[ask]).unwrap();
    config.exchanges[0].transaction = Transaction::Frames { request: Some(7), reply: None, refusal: None };
    let error = config.validate().unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::OutsidePool { end: 8, len: 1 });
    config.exchanges[0].transaction = Transaction::Frames { request: None, reply: None, refusal: None };
    assert_eq!(config.validate().unwrap_err().kind, ConfigErrorKind::Exchange(ExchangeError::Nothing));
}

/// A status that tells which answer it is; what is behind it goes to a register.
fn status(value: i64) -> [InputField<'static>; 2] {
    [InputField::constant(Byte, value), InputField::variable(Byte, "WordInputReg[1]")]
}

#[test]
fn several_answers_are_told_apart() {
    let (request, done, busy) = ([OutputField::constant(Byte, 9.0)], status(0), status(1));
    let code = [InputField::variable(Byte, "WordInputReg[2]"), InputField::padding(1)];
    let plain = [InputField::constant(Byte, 1), InputField::padding(1)];
    let ask = ExchangeBuilder::request(ExchangeFrame::stream(b"G", &[], &request)).every(ms(100));
    fn answer<'a>(fields: &'a [InputField<'a>]) -> ExchangeFrame<'a> {
        ExchangeFrame::stream(b"S", &[], fields)
    }
    fn can<'a>(fields: &'a [InputField<'a>]) -> ExchangeFrame<'a> {
        ExchangeFrame::can(CanId::Standard(0x201), fields)
    }
    let config = with(&[ask.reply(answer(&done)).pending(answer(&plain)).refusal(answer(&code))]).unwrap();
    let Transaction::Frames { reply, refusal, .. } = config.exchanges[0].transaction else { panic!() };
    assert_eq!((reply, config.exchanges[0].pending, refusal), (Some(1), Some(2), Some(3)));
    // A mistake in any of them has its place: they are counted if they have values.
    let wrong = [InputField::constant(Byte, 5), InputField::variable(Byte, "WordOutputReg[1]")];
    let place = |frame| Place::Field { recipe: 0, part: Direction::Input, frame, field: 1 };
    let at = |asks: &[ExchangeBuilder<'_>]| with(asks).unwrap_err().place;
    let both = ask.reply(answer(&done));
    assert_eq!(at(&[both.pending(answer(&wrong))]), place(1));
    assert_eq!(at(&[both.pending(answer(&plain)).refusal(answer(&wrong))]), place(1));
    let four = [InputField::constant(Byte, 4), InputField::variable(Byte, "WordInputReg[4]")];
    assert_eq!(at(&[both.pending(answer(&four)).refusal(answer(&wrong))]), place(2));
    let unasked = [InputField::variable(Byte, "WordOutputReg[1]")];
    let unasked = ExchangeBuilder::unasked(ExchangeFrame::stream(b"E", &[], &unasked));
    let second = Place::Field { recipe: 0, part: Direction::Input, frame: 3, field: 0 };
    assert_eq!(at(&[both.pending(answer(&four)).refusal(answer(&code)), unasked]), second);
    let hidden = "every such frame is another answer as well, which is looked for first (reply, pending, refusal) or is \
                  shorter; give that one a constant that this one does not have";
    assert_refused_at(&[ask.reply(answer(&code)).pending(answer(&plain))], "pending", hidden);
    assert_refused_at(&[ask.reply(answer(&done)).refusal(answer(&done))], "refusal", hidden);
    // A shorter frame without a constant is the beginning of each longer one.
    let short = [InputField::unused(Byte)];
    assert_refused_at(&[ask.reply(answer(&done)).refusal(answer(&short))], "reply", hidden);
    let on_can = ExchangeBuilder::request(ExchangeFrame::can(CanId::Standard(1), &request)).every(ms(100));
    assert!(with(&[on_can.reply(can(&done)).refusal(can(&short))]).is_ok(), "CAN tells the length");
    assert_refused_at(&[on_can.reply(can(&code)).refusal(can(&plain))], "refusal", hidden);
    assert!(with(&[on_can.reply(can(&done)).pending(can(&busy))]).is_err(), "two write one register");
    // What may be an echo says nothing.
    let echo = [InputField::unused(Byte)];
    assert_refused_at(
        &[ask.reply(answer(&done)).pending(ExchangeFrame::stream(b"G", &[], &echo))],
        "pending",
        "it may have the bytes of its request, as an echo has; give it another constant",
    );
    let stops = [InputField::commands(Byte, &[(1, "stop")]), InputField::padding(1)];
    assert_refused_at(
        &[ask.reply(answer(&done)).refusal(answer(&stops))],
        "refusal",
        "the fields of a pending answer and of a refusal have no commands and no counter",
    );
}

#[test]
fn a_restart_is_told_by_a_number_of_a_reply() {
    let fields = [
        InputField::padding(2),
        InputField::constant(Word, 7),
        InputField::unused(Word),
        InputField::variable(Float, "WordInputReg[1]"),
    ];
    let value = value();
    let start = ExchangeBuilder::write_registers(9, 0, &value).at_start();
    let read = |field, value| {
        ExchangeBuilder::read_holding_registers(9, 0, &fields).every(ms(100)).restarted(field, value)
    };
    for good in [read(1, 65_535.0), read(2, 0.5)] {
        let config = with(&[start, good]).unwrap();
        assert!(config.exchanges[1].restarted.is_some());
    }
    let refused = |ask, why: &str| {
        let error = with(&[start, ask]).unwrap_err().to_string();
        assert_eq!(error, format!("recipe 1, exchange 2, restarted: {why}"));
    };
    refused(read(0, 7.0), "field 1 of the reply is no number");
    refused(read(3, 7.0), "field 4 of the reply is no number");
    refused(read(1, 65_536.0), "the field cannot be 65536; allowed: 0..=65535");
    refused(read(1, 0.5), "0.5 has a fraction; this field has integers only");
    let nothing =
        "allowed in the reply of an exchange, if one of its device has \"start\" in on, which is asked again";
    refused(ExchangeBuilder::read_holding_registers(8, 0, &fields).every(ms(100)).restarted(1, 0.0), nothing);
    refused(ExchangeBuilder::write_registers(9, 5, &value).every(ms(100)).restarted(1, 0.0), nothing);
}

#[test]
fn a_refused_recipe_leaves_nothing_behind() {
    let value = value();
    let mut config: GatewayConfig<1, 1, 8, 0, 0, 2> = GatewayConfig::empty();
    let wrong = [OutputField::variable(Word, "NoSuchReg[1]")];
    let asks = [
        ExchangeBuilder::request(ExchangeFrame::stream(&[1], &[], &value)),
        ExchangeBuilder::request(ExchangeFrame::stream(&[1], &[], &wrong)),
    ];
    let error = config.add_recipe(&Recipe::user("line").exchanges(&asks)).unwrap_err();
    assert_eq!(error.place, Place::Field { recipe: 0, part: Direction::Output, frame: 1, field: 0 });
    assert_eq!((config.exchanges.len(), config.frames.len(), config.fields.len()), (0, 0, 0));
    let asks = [ExchangeBuilder::write_registers(1, 0, &value); 3];
    let error = config.add_recipe(&Recipe::user("line").exchanges(&asks)).unwrap_err();
    assert_eq!(error.kind, ConfigErrorKind::TooMany { what: Counted::Exchanges, needed: 3, room: 2 });
}

/// 19 200 bit/s, 10 bits a character: 520.8 µs each; 3.5 characters are 1823 µs.
#[test]
fn an_exchange_takes_its_frames_silences_and_pause() {
    let (register, value) = (register(), value());
    let config = with(&[
        ExchangeBuilder::read_holding_registers(9, 0, &register).every(ms(100)).timeout(ms(50)).pause(ms(5)),
        ExchangeBuilder::write_coil(0, 0, &[OutputField::constant(Coil, 1.0)]).at_start(),
        ExchangeBuilder::write_registers(8, 0, &value).on_change(),
    ])
    .unwrap();
    let port = &config.ports[0];
    let budget = |nth: usize| config.view().exchange_budget(port, &config.exchanges[nth]);
    let us = Duration::from_micros;
    let read = budget(0);
    assert_eq!((read.request, read.reply), (8, 7));
    let request = us(1_823) + us(4_167);
    assert_eq!(read.time, request + us(1_823) + us(3_646) + ms(5));
    assert_eq!(read.time_without_reply, request + ms(50) + ms(5));
    let broadcast = budget(1);
    assert_eq!((broadcast.request, broadcast.reply), (8, 0));
    assert_eq!(broadcast.time, request + ms(100), "the time that slaves have after a broadcast");
    assert_eq!(broadcast.time_without_reply, broadcast.time);
    assert_eq!(budget(2).request, 11);
    // Only the first has a period: 16.459 of 100 ms.
    assert_eq!(config.view().line_share(port), Some(17));
}

#[test]
fn a_line_that_is_full_and_a_timeout_that_is_short_are_told() {
    let register = register();
    let warnings = |every, timeout| {
        let config: Config = Config::builder()
            .controller("10.0.0.2")
            .recipe(Recipe::user("line").exchanges(&[
                ExchangeBuilder::read_holding_registers(9, 0, &register).every(every),
                ExchangeBuilder::write_registers(9, 0, &[OutputField::padding(2, 0)]).every(ms(1_000)),
            ]))
            .port(Port::modbus_rtu("line", "line").baud(19_200).timeout(timeout))
            .build()
            .unwrap();
        let view = config.view();
        view.warnings().map(|warning| view.describe_warning(warning).to_string()).collect::<Vec<_>>()
    };
    assert_eq!(warnings(ms(100), ms(300)), [""; 0]);
    // 11.459 ms in 11, and 13.5 in 1000.
    assert_eq!(warnings(ms(12), ms(300)), [""; 0]);
    assert_eq!(
        warnings(ms(11), ms(300)),
        [
            "port \"line\": the exchanges with a period take 106 % of the line's time, so they are asked less often"
        ]
    );
    let said = "port \"line\": an exchange is asked every 300 ms, but the timeout is 300 ms, so its values are overdue \
                until the next reply";
    assert_eq!(warnings(ms(300), ms(300)), [said], "a write has no values that can be overdue");
}

#[test]
fn an_exchange_on_can_takes_its_frames() {
    let config = with(&[ExchangeBuilder::request(ExchangeFrame::remote(CanId::Standard(1)))
        .reply(ExchangeFrame::can(
            CanId::Standard(1),
            &[InputField::variable(Float, "WordInputReg[1]"), InputField::padding(4)],
        ))
        .every(ms(10))])
    .unwrap();
    let budget = config.view().exchange_budget(&config.ports[0], &config.exchanges[0]);
    let frames =
        can_frame_time(CanId::Standard(1), 0, 500_000) + can_frame_time(CanId::Standard(1), 8, 500_000);
    assert_eq!((budget.request, budget.reply, budget.time), (0, 8, frames));
    assert_eq!(config.recipes[0].parts, Parts::Can { input: Default::default(), output: Default::default() });
}

#[test]
fn an_echo_needs_exchanges() {
    let echo = |recipe: RecipeBuilder<'_>| {
        Config::builder()
            .controller("10.0.0.2")
            .recipe(recipe)
            .port(Port::rs485("line", "line").echo(Echo::Yes))
            .build()
    };
    let one = [OutputField::constant(Byte, 1.0)];
    let plain = Recipe::user("line").stream_output(&[1], &[], &one);
    let error = echo(plain).unwrap_err().to_string();
    assert_eq!(
        error,
        "port 1, echo: allowed only with a recipe of exchanges: other frames are not told from their echo"
    );
    let value = value();
    let asks = [ExchangeBuilder::request(ExchangeFrame::stream(&[1], &[], &value)).at_start()];
    let config = echo(Recipe::user("line").exchanges(&asks)).unwrap();
    assert!(matches!(config.ports[0].bus, Bus::Rs485(line) if line.echo == Echo::Yes));
}

#[test]
fn a_port_of_modbus_tcp_takes_what_a_master_asks() {
    let build = |asks: &[ExchangeBuilder<'_>], host: &str, tcp_port| -> Result<Config, String> {
        let port = Port::modbus_tcp("drive", "drive", host).tcp_port(tcp_port);
        let config = Config::builder().controller("10.0.0.2").recipe(Recipe::user("drive").exchanges(asks));
        config.port(port).build().map_err(|error| error.to_string())
    };
    let (register, value) = (register(), value());
    let asks = [ExchangeBuilder::read_holding_registers(255, 0, &register).every(ms(100))];
    let config = build(&asks, "drive.cell", 1502).unwrap();
    assert_eq!(config.ports[0].bus, Bus::ModbusTcp { host: "drive.cell".try_into().unwrap(), port: 1502 });
    let budget = config.view().exchange_budget(&config.ports[0], &config.exchanges[0]);
    assert_eq!((budget.request, budget.reply, budget.time), (12, 11, Duration::ZERO));
    let refused = |asks: &[ExchangeBuilder<'_>], host, port| build(asks, host, port).unwrap_err();
    assert!(refused(&asks, "drive cell", 502).starts_with("port 1, to: "));
    assert!(refused(&asks, "drive.cell", 0).starts_with("port 1, to: "));
    let to_all = [ExchangeBuilder::write_registers(0, 0, &value).on_change()];
    assert_eq!(
        refused(&to_all, "drive.cell", 502),
        "recipe 1, exchange 1, peer: slave 0 is all of them, which Modbus TCP does not have; allowed: 1..=255"
    );
    let frames = [ExchangeBuilder::request(ExchangeFrame::stream(&[1], &[], &value)).at_start()];
    assert_eq!(
        refused(&frames, "drive.cell", 502),
        "port 1, recipe: recipe 1 has no exchanges of a Modbus master; a port of Modbus TCP takes only such recipes"
    );
    let on_line = Config::builder().controller("10.0.0.2").recipe(Recipe::user("line").exchanges(&asks));
    let error = on_line.port(Port::modbus_rtu("line", "line")).build().unwrap_err().to_string();
    assert!(
        error.ends_with("slave 255 is out of range; allowed: 1..=247, or 0 to write to all of them"),
        "{error}"
    );
}

#[test]
fn exchanges_of_a_configuration_make_it_again() {
    let coils =
        [OutputField::variable(Coil, "WordOutputReg[1]"), OutputField::variable(Coil, "WordOutputReg[2]")];
    let (register, value) = (register(), value());
    let config = with(&[
        ExchangeBuilder::read_write_registers(9, (1, &register), (8, &value)).every(ms(100)).late(ms(7_000)),
        ExchangeBuilder::write_coils(5, 3, &coils).on_rising("BitOutputReg[3]", 1).outcome("WordInputReg[2]"),
        ExchangeBuilder::write_register(5, 4, &value)
            .follows(1)
            .trigger(ms(500))
            .outcome_count("WordInputReg[3]"),
    ]);
    let config = config.unwrap();
    let again = config.exchanges.iter().map(|one| {
        let Transaction::Rtu { operation, written, read } = one.transaction else { panic!("of a master") };
        let fields = (written.of(&config.fields), read.of(&config.fields));
        ExchangeBuilder::packed(one.peer, operation, false, fields).settings(*one, None)
    });
    assert_eq!(with(&again.collect::<Vec<_>>()), Ok(config.clone()));
}
