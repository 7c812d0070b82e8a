//! Configurations that a program writes: what the builder makes, and what it refuses.

use std::net::Ipv4Addr;

use proto_core::config::*;
use proto_core::device::{
    Algorithm, Bits, Boundary, ByteOrder, Checksum, Digits, Encoding, Escape, Kind, Overflow, Width,
};
use proto_core::sysvar::{Direction, ParseError, SysVar};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType::{Byte, Double, Dword, Short, Word};
use proto_core::wire::scalar::{Scalar, ScalarError, ScalarType};

const HEAD: &[u8] = &[0xFF, 0xFF];

fn var(name: &str) -> SysVar {
    SysVar::parse(name).unwrap()
}

/// A device that switches one output and sees the pose.
fn sensor() -> RecipeBuilder<'static> {
    Recipe::realtime("sensor").stream_input(HEAD, &[], &["DigitalOutputCommand[1]"]).stream_output(
        HEAD,
        &[],
        &["RobotState[8..13]"],
    )
}

fn refused<const PORTS: usize, const RECIPES: usize, const FIELDS: usize, const C: usize, const S: usize>(
    builder: ConfigBuilder<PORTS, RECIPES, FIELDS, C, S>,
) -> (Place, ConfigErrorKind) {
    let ConfigError { place, kind } = builder.build().expect_err("it is wrong");
    (place, kind)
}

/// The defaults that docs/configuration.md states.
#[test]
fn defaults_are_those_of_a_file() {
    let config: GatewayConfig = GatewayConfig::builder()
        .controller("192.168.12.138")
        .recipe(sensor())
        .port(Port::rs485("rs485-1", "sensor"))
        .recipe(Recipe::realtime("hand").can_output(&[CanFields::standard(1, &["RobotState[8]"])]))
        .port(Port::can("can-1", "hand"))
        .recipe_link("sensor")
        .build()
        .unwrap();
    let controller = &config.controller;
    assert_eq!((controller.address.as_str(), controller.dialect.as_str()), ("192.168.12.138", "v2.3"));
    assert_eq!((controller.command_port, controller.state_port, controller.modbus_port), (2000, 2001, 502));
    assert_eq!(controller.recipe_link, Some(RecipeLink { udp_port: 2011, recipe: 0 }));
    assert_eq!(config.network, BoardAddress::Dhcp);
    let ms = Duration::from_millis;
    for port in &config.ports {
        assert_eq!((port.cycle, port.timeout, port.stale_after), (ms(4), ms(100), ms(500)), "{}", port.name);
        assert_eq!(port.on_timeout.len, 0, "inputs hold");
    }
    let line = Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: ms(50),
        turnaround: Duration::from_micros(100),
        echo: Echo::Auto,
    };
    assert_eq!(config.ports[0].bus, Bus::Rs485(line));
    assert_eq!(config.ports[1].bus, Bus::Can { bitrate: 500_000 });
    assert_eq!((config.recipes[0].on_stale, config.recipes[0].send), (OnStale::Hold, SendOn::Period));
}

#[test]
fn everything_that_is_said_is_in_it() {
    let network = Network {
        address: Ipv4Addr::new(192, 168, 12, 20),
        prefix: 24,
        router: Some(Ipv4Addr::new(192, 168, 12, 1)),
        dns: None,
    };
    let commands = [(1, "run(pick.jspf,50)"), (2, "stop")];
    let config: GatewayConfig<3, 3, 32, 2, 2> = GatewayConfig::builder()
        .controller(
            ControllerBuilder::new("10.0.0.2").dialect("v2.6").command_port(1).state_port(2).modbus_port(3),
        )
        .network(network)
        .recipe(
            Recipe::user("plc")
                .stream_input(
                    HEAD,
                    &[0xEE],
                    &[
                        InputField::commands(ScalarType::Byte, &commands).when(CommandWhen::Frame),
                        InputField::variable(ScalarType::Short, "WordInputReg[1]").scaled(0.5, 1.0),
                        InputField::unused(ScalarType::Double),
                    ],
                )
                .stream_output(
                    HEAD,
                    &[],
                    &[
                        OutputField::reply(ScalarType::Byte),
                        OutputField::counter(ScalarType::Dword),
                        OutputField::constant(ScalarType::Int, -3.0),
                        OutputField::variable(ScalarType::Float, var("RobotState[8]")).scaled(2.0, 3.0),
                    ],
                )
                .on_stale(OnStale::Stop)
                .send_on_rising("BitOutputReg[3]", 7),
        )
        .recipe(
            Recipe::realtime("hand")
                .can_input(&[CanFields::standard(0x501, &[var("DigitalOutputCommand[2]")])])
                .can_output(&[CanFields::extended(0x12345, &["RobotState[8..9]"])]),
        )
        .recipe(Recipe::realtime("up").stream_output(&[], &[0x0A], &["RobotState[26]"]))
        .port(
            Port::rs485("line", "plc")
                .baud(9_600)
                .parity(Parity::Even)
                .stop_bits(2)
                .idle_gap(Duration::from_millis(10))
                .turnaround(Duration::ZERO)
                .cycle(Duration::from_millis(20))
                .timeout(Duration::from_millis(30))
                .stale_after(Duration::from_millis(40))
                .safe(&[("WordInputReg[1]", 7.0)]),
        )
        .port(Port::can("can", "hand").bitrate(250_000).safe(&[(var("DigitalOutputCommand[2]"), 1.0)]))
        .port(Port::udp_listen("udp", "up", "0.0.0.0:50000"))
        .recipe_link_at("up", 12_011)
        .build()
        .unwrap();
    let controller = &config.controller;
    assert_eq!(
        (controller.dialect.as_str(), controller.command_port, controller.modbus_port),
        ("v2.6", 1, 3)
    );
    assert_eq!(controller.recipe_link, Some(RecipeLink { udp_port: 12_011, recipe: 2 }));
    assert_eq!(config.network, BoardAddress::Static(network));
    let plc = &config.recipes[0];
    assert_eq!(plc.on_stale, OnStale::Stop);
    assert_eq!(plc.send, SendOn::Rising { var: var("BitOutputReg[3]"), bit: 7 });
    let Parts::Stream { input: Some(input), output: Some(output) } = &plc.parts else { panic!("{plc:?}") };
    assert_eq!((&input.head[..], &input.tail[..]), (HEAD, &[0xEE][..]));
    let table = Span { start: 0, len: 2 };
    assert_eq!(
        input.fields.of(&config.fields),
        [
            FieldSpec::UserInput {
                ty: ScalarType::Byte,
                to: InputBinding::Commands { table, when: CommandWhen::Frame }
            },
            FieldSpec::UserInput {
                ty: ScalarType::Short,
                to: InputBinding::Variable { var: var("WordInputReg[1]"), scale: 0.5, offset: 1.0 }
            },
            FieldSpec::UserInput { ty: ScalarType::Double, to: InputBinding::Unused },
        ]
    );
    assert_eq!(
        output.fields.of(&config.fields),
        [
            FieldSpec::UserOutput { ty: ScalarType::Byte, from: OutputBinding::Reply },
            FieldSpec::UserOutput { ty: ScalarType::Dword, from: OutputBinding::Counter },
            FieldSpec::UserOutput { ty: ScalarType::Int, from: OutputBinding::Constant(-3.0) },
            FieldSpec::UserOutput {
                ty: ScalarType::Float,
                from: OutputBinding::Variable { var: var("RobotState[8]"), scale: 2.0, offset: 3.0 }
            },
        ]
    );
    let texts: Vec<_> = table.of(&config.commands).iter().map(|entry| (entry.first, &*entry.text)).collect();
    assert_eq!(texts, commands);
    let Parts::Can { input, output } = &config.recipes[1].parts else { panic!("{:?}", config.recipes[1]) };
    assert_eq!((input[0].id, output[0].id), (CanId::Standard(0x501), CanId::Extended(0x12345)));
    let pose = ["RobotState[8]", "RobotState[9]"].map(|name| FieldSpec::System(var(name)));
    assert_eq!(output[0].fields.of(&config.fields), pose);
    let Bus::Rs485(line) = config.ports[0].bus else { panic!("{:?}", config.ports[0]) };
    assert_eq!((line.baud, line.parity, line.stop_bits), (9_600, Parity::Even, 2));
    assert_eq!((line.idle_gap, line.turnaround), (Duration::from_millis(10), Duration::ZERO));
    let port = &config.ports[0];
    let times = [port.cycle, port.timeout, port.stale_after].map(Duration::as_millis);
    assert_eq!(times, [20, 30, 40]);
    let safe = |port: &Port| port.on_timeout.of(&config.safe_values)[0];
    assert_eq!(safe(port), SafeValue::new(var("WordInputReg[1]"), Scalar::Word(7)));
    assert_eq!(safe(&config.ports[1]).value, Scalar::Byte(1));
    assert_eq!(config.ports[1].bus, Bus::Can { bitrate: 250_000 });
    assert_eq!(config.ports[2].bus, Bus::UdpListen { listen: "0.0.0.0:50000".try_into().unwrap() });
}

#[test]
fn a_board_builds_in_place_what_the_builder_builds() {
    let port = Port::rs485("rs485-1", "sensor").safe(&[("DigitalOutputCommand[1]", 0.0)]);
    let built: GatewayConfig = GatewayConfig::builder()
        .controller("10.0.0.2")
        .recipe(sensor())
        .port(port)
        .recipe_link("sensor")
        .build()
        .unwrap();
    let mut placed: GatewayConfig = GatewayConfig::default();
    placed.set_controller("10.0.0.2").unwrap();
    assert_eq!(placed.add_recipe(&sensor()), Ok(0));
    assert_eq!(placed.add_port(&port), Ok(0));
    placed.set_recipe_link("sensor", 2011).unwrap();
    assert_eq!(placed, built);
    assert_eq!(placed.view(), built.view());
}

#[test]
fn what_is_refused_leaves_nothing_behind() {
    let mut config: GatewayConfig<1, 1, 3, 1, 2> = GatewayConfig::empty();
    let field = [InputField::commands(ScalarType::Byte, &[(1, "stop")])];
    let recipe = Recipe::user("a").stream_input(HEAD, &[], &field);
    for wrong in [
        recipe.stream_output(HEAD, &[], &[OutputField::variable(ScalarType::Byte, "Nothing[1]")]),
        recipe.stream_output(HEAD, &[0; 9], &[OutputField::reply(ScalarType::Byte)]),
        recipe.send_on_rising("BitOutputReg[0]", 1),
        recipe.can_output(&[]),
        Recipe::realtime("a").stream_input(HEAD, &[], &["WordInputReg[1..4]"]),
        Recipe::user("a b"),
    ] {
        assert!(config.add_recipe(&wrong).is_err(), "{wrong:?}");
        assert_eq!(config, GatewayConfig::empty());
    }
    assert_eq!(config.add_recipe(&recipe), Ok(0));
    let before = config.clone();
    let port = Port::rs485("p", "a");
    for wrong in [
        Port::rs485("p", "b"),
        Port::rs485("", "a"),
        port.safe(&[("WordInputReg[1]", 1.0), ("WordInputReg[2]", -1.0)]),
        port.safe(&[("WordInputReg[1]", 1.0), ("WordInputReg[2]", 1.0), ("WordInputReg[3]", 1.0)]),
        port.safe(&[("WordInputReg[1]", 65_536.0)]),
        port.safe(&[("WordInputReg[1..2]", 1.0)]),
    ] {
        assert!(config.add_port(&wrong).is_err(), "{wrong:?}");
        assert_eq!(config, before);
    }
    assert!(config.add_port(&Port::tcp_listen("p", "a", &"1".repeat(49))).is_err());
    assert!(config.set_controller(ControllerBuilder::new("a").dialect("v9")).is_err());
    assert!(config.set_recipe_link("b", 2011).is_err());
    assert_eq!(config, before);
    assert_eq!(config.add_port(&port), Ok(0));
}

#[test]
fn mistakes_have_places() {
    let base = GatewayConfig::<1, 2, 16, 4, 4>::builder;
    let recipe = |key| Place::Recipe { recipe: 0, key };
    assert_eq!(
        refused(base().controller("10.0.0.1:80")),
        (Place::Controller(ControllerKey::Address), ConfigErrorKind::Address)
    );
    assert_eq!(
        refused(base().controller(ControllerBuilder::new("a").dialect("v1"))),
        (Place::Controller(ControllerKey::Dialect), ConfigErrorKind::UnknownDialect)
    );
    let names = ["DigitalOutputCommand[1]", "ForceEnd[0..5]"];
    assert_eq!(
        refused(base().controller("a").recipe(Recipe::realtime("r").stream_input(HEAD, &[], &names))),
        (
            Place::Field { recipe: 0, part: Direction::Input, frame: 0, field: 1 },
            ConfigErrorKind::Variable(ParseError::OutOfRange { group: "ForceEnd", index: 0, last: 6 })
        )
    );
    let frames = [CanFields::standard(1, &["WordInputReg[1]"]), CanFields::standard(2, &["Nobody[1]"])];
    assert_eq!(
        refused(base().controller("a").recipe(Recipe::realtime("r").can_input(&frames))),
        (
            Place::Field { recipe: 0, part: Direction::Input, frame: 1, field: 0 },
            ConfigErrorKind::Variable(ParseError::UnknownGroup)
        )
    );
    let mixed = Recipe::realtime("r").can_input(&frames[..1]).stream_output(HEAD, &[], &["RobotState[8]"]);
    assert_eq!(refused(base().recipe(mixed)), (recipe(RecipeKey::Whole), ConfigErrorKind::MixedParts));
    assert_eq!(
        refused(base().controller("a").recipe(sensor()).port(Port::rs485("p", "other"))),
        (Place::Port { port: 0, key: PortKey::Recipe }, ConfigErrorKind::NoSuchName)
    );
    assert_eq!(
        refused(base().controller("a").recipe_link("sensor").recipe(sensor())),
        (Place::Controller(ControllerKey::RecipeLink), ConfigErrorKind::NoSuchName)
    );
    let safe = Port::rs485("p", "sensor").safe(&[("DigitalOutputCommand[1]", 256.0)]);
    let (place, kind) = refused(base().controller("a").recipe(sensor()).port(safe));
    assert_eq!(place, Place::SafeValue { entry: 0 });
    assert!(matches!(kind, ConfigErrorKind::Constant(ScalarError::OutOfRange { .. })), "{kind:?}");
    // Mistakes that concern several items are found at the end.
    let twice = base().controller("a").recipe(sensor()).recipe(sensor());
    assert_eq!(
        refused(twice),
        (Place::Recipe { recipe: 1, key: RecipeKey::Name }, ConfigErrorKind::DuplicateName { other: 0 })
    );
}

fn only_fields(recipe: RecipeBuilder<'_>) -> Vec<FieldSpec> {
    let config: GatewayConfig =
        GatewayConfig::builder().controller("a").recipe(recipe).port(Port::rs485("p", "r")).build().unwrap();
    config.fields.to_vec()
}

#[test]
fn fields_of_devices_are_written_as_their_manuals_have_them() {
    let to = |name| InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 };
    let value = |encoding, to| FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to };
    let status = Encoding::bits(Byte, 4..=5);
    let table = [(1, "stop")];
    let fields = only_fields(Recipe::user("r").stream_input(
        &[],
        &[],
        &[
            InputField::constant(Byte, 9),
            InputField::variable(Word, "WordInputReg[1]"),
            InputField::variable(status, "WordInputReg[2]").scaled(2.0, 1.0),
            InputField::variable(Encoding::bit(Byte, 7).shared(), "WordInputReg[3]"),
            InputField::commands(Encoding::bcd(2), &table),
            InputField::variable(Encoding::from(Short).big_endian(), "WordInputReg[4]").wrapping(),
            InputField::unused(Encoding::int24()),
            InputField::padding(3),
            InputField::checksum("crc16-modbus"),
        ],
    ));
    let commands = InputBinding::Commands { table: Span { start: 0, len: 1 }, when: CommandWhen::Change };
    let scaled = InputBinding::Variable { var: var("WordInputReg[2]"), scale: 2.0, offset: 1.0 };
    let crc = Checksum::standard(Algorithm::named("crc16-modbus").unwrap());
    let bit = Bits { bytes: 1, first: 7, count: 1, signed: false };
    let bit = Encoding { kind: Kind::Bits(bit), order: ByteOrder::Little, shared: true };
    assert_eq!(
        fields,
        [
            FieldSpec::Fixed { encoding: Encoding::scalar(Byte), value: 9 },
            // As the controller's own recipes have it.
            FieldSpec::UserInput { ty: Word, to: to("WordInputReg[1]") },
            value(status, scaled),
            value(bit, to("WordInputReg[3]")),
            value(Encoding::bcd(2), commands),
            FieldSpec::DeviceInput {
                encoding: Encoding { order: ByteOrder::Big, ..Encoding::scalar(Short) },
                overflow: Overflow::Wrap,
                to: to("WordInputReg[4]"),
            },
            value(Encoding::int24(), InputBinding::Unused),
            FieldSpec::Padding { len: 3, fill: 0 },
            FieldSpec::Checksum(crc),
        ]
    );
}

#[test]
fn requests_to_devices_are_written_as_their_manuals_have_them() {
    let sum = Checksum::standard(Algorithm::Xor8).over(1, Some(2));
    let fields = only_fields(
        Recipe::user("r").stream_output(
            b"#",
            b"\r",
            &[
                OutputField::constant(Encoding::hex(2), 255.0),
                OutputField::counter(Encoding::decimal_until(b',')),
                OutputField::reply(Encoding::uint24()),
                OutputField::variable(Encoding::decimal(8).decimals(2), "RobotState[8]").limited(-1.5, 9.25),
                OutputField::variable(Encoding::hex_until(b';'), "BitOutputReg[1]")
                    .mapped(&[(0, 0, 7.0), (1, 9, 8.0)]),
                OutputField::variable(Byte, "WordOutputReg[2]").scaled(0.5, 0.0).clamped(0.0, 50.0),
                OutputField::variable(Encoding::bits(Dword, 0..=7).signed(), "WordOutputReg[1]").wrapping(),
                OutputField::padding(2, 0xFF),
                OutputField::checksum(sum),
                OutputField::constant(Double, 0.5),
            ],
        ),
    );
    let from = |name| OutputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 };
    let value = |encoding, from| FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from };
    let decimals = Kind::Decimal(Digits { width: Width::Fixed(8), decimals: 2 });
    let signed = Kind::Bits(Bits { bytes: 4, first: 0, count: 8, signed: true });
    let little = |kind| Encoding { kind, order: ByteOrder::Little, shared: false };
    assert_eq!(
        fields,
        [
            value(little(Kind::Hex(Width::Fixed(2))), OutputBinding::Constant(255.0)),
            value(Encoding::decimal_until(b','), OutputBinding::Counter),
            value(little(Kind::Uint24), OutputBinding::Reply),
            value(little(decimals), from("RobotState[8]")),
            FieldSpec::Limits(Limits { low: -1.5, high: 9.25, outside: Outside::Refuse }),
            value(little(Kind::Hex(Width::Until(b';'))), from("BitOutputReg[1]")),
            FieldSpec::Mapped(MapEntry { first: 0, last: 0, sent: 7.0 }),
            FieldSpec::Mapped(MapEntry { first: 1, last: 9, sent: 8.0 }),
            FieldSpec::UserOutput {
                ty: Byte,
                from: OutputBinding::Variable { var: var("WordOutputReg[2]"), scale: 0.5, offset: 0.0 },
            },
            FieldSpec::Limits(Limits { low: 0.0, high: 50.0, outside: Outside::Clamp }),
            FieldSpec::DeviceOutput {
                encoding: little(signed),
                overflow: Overflow::Wrap,
                from: from("WordOutputReg[1]"),
            },
            FieldSpec::Padding { len: 2, fill: 0xFF },
            FieldSpec::Checksum(sum),
            FieldSpec::UserOutput { ty: Double, from: OutputBinding::Constant(0.5) },
        ]
    );
}

#[test]
fn an_unknown_checksum_is_refused_with_the_names() {
    let fields = [InputField::constant(Byte, 1), InputField::checksum("crc16")];
    let recipe = Recipe::user("r").stream_input(&[], &[], &fields);
    let builder: ConfigBuilder = GatewayConfig::builder().controller("a").recipe(recipe);
    let (place, kind) = refused(builder);
    assert_eq!(place, Place::Field { recipe: 0, part: Direction::Input, frame: 0, field: 1 });
    assert_eq!(kind, ConfigErrorKind::UnknownChecksum);
    let said = kind.to_string();
    assert!(said.starts_with("no checksum has this name; allowed: crc8 crc8-autosar "), "{said}");
    assert!(said.ends_with(" sum8 sum16 xor8 lrc"), "{said}");
}

#[test]
fn no_room_says_how_many_are_needed() {
    fn needed<const P: usize, const R: usize, const F: usize, const C: usize, const S: usize>()
    -> Option<(Counted, usize, usize)> {
        let table = [(1, "stop"), (2, "state"), (3, "pause")];
        let commands = [InputField::commands(ScalarType::Byte, &table)];
        let builder: ConfigBuilder<P, R, F, C, S> = GatewayConfig::builder()
            .controller("a")
            .recipe(sensor())
            .recipe(Recipe::user("panel").stream_input(HEAD, &[], &commands))
            .port(Port::rs485("one", "sensor").safe(&[("DigitalOutputCommand[1]", 0.0)]))
            .port(Port::rs485("two", "panel"));
        match builder.build().err()?.kind {
            ConfigErrorKind::TooMany { what, needed, room } => Some((what, needed, room)),
            kind => panic!("{kind}"),
        }
    }
    assert_eq!(needed::<2, 2, 8, 3, 1>(), None, "this is what it needs");
    assert_eq!(needed::<1, 2, 8, 3, 1>(), Some((Counted::Ports, 2, 1)));
    assert_eq!(needed::<2, 0, 8, 3, 1>(), Some((Counted::Recipes, 2, 0)));
    assert_eq!(needed::<2, 2, 4, 3, 1>(), Some((Counted::Fields, 8, 4)), "of both recipes");
    assert_eq!(needed::<2, 2, 8, 2, 1>(), Some((Counted::Commands, 3, 2)));
    assert_eq!(needed::<2, 2, 8, 3, 0>(), Some((Counted::SafeValues, 1, 0)));
}

#[test]
fn names_are_those_that_a_file_allows() {
    for name in ["a", "rs485-1", "ä.b/c", &"x".repeat(32)] {
        assert_eq!(check_name(name), Ok(()), "{name:?}");
    }
    for (name, kind) in [
        ("", ConfigErrorKind::NameLength { len: 0 }),
        (&*"x".repeat(33), ConfigErrorKind::NameLength { len: 33 }),
        ("a b", ConfigErrorKind::NameCharacter { character: ' ' }),
        ("a\u{a0}b", ConfigErrorKind::NameCharacter { character: '\u{a0}' }),
        ("a=b", ConfigErrorKind::NameCharacter { character: '=' }),
        ("a\"", ConfigErrorKind::NameCharacter { character: '"' }),
        ("a\n", ConfigErrorKind::NameCharacter { character: '\n' }),
        ("a\u{7f}", ConfigErrorKind::NameCharacter { character: '\u{7f}' }),
    ] {
        assert_eq!(check_name(name), Err(kind), "{name:?}");
    }
    // A stored configuration keeps the rule as well.
    let mut config: GatewayConfig = GatewayConfig::builder()
        .controller("a")
        .recipe(sensor())
        .port(Port::rs485("p", "sensor"))
        .build()
        .unwrap();
    config.ports[0].name = "p 1".try_into().unwrap();
    let kind = ConfigErrorKind::NameCharacter { character: ' ' };
    let place = Place::Port { port: 0, key: PortKey::Name };
    assert_eq!(config.validate(), Err(ConfigError { place, kind }));
    config.ports[0].name = "p".try_into().unwrap();
    config.recipes[0].name = "s=".try_into().unwrap();
    let place = Place::Recipe { recipe: 0, key: RecipeKey::Name };
    let kind = ConfigErrorKind::NameCharacter { character: '=' };
    assert_eq!(config.validate(), Err(ConfigError { place, kind }));
}

#[test]
fn addresses_are_those_that_a_file_allows() {
    for address in ["192.168.12.138", "robot.cell-7", "my_robot", "::1", "fe80::1", "::ffff:1.2.3.4"] {
        assert_eq!(check_address(address), Ok(()), "{address}");
    }
    for address in ["", "1.2.3.4:5", "[::1]", "fe80::1%2", "a b", "a/b", "ä"] {
        assert_eq!(check_address(address), Err(ConfigErrorKind::Address), "{address}");
    }
    let kind = ConfigErrorKind::TooLong { len: 65, longest: MAX_ADDRESS };
    assert_eq!(check_address(&"a".repeat(65)), Err(kind));
}

/// An engine and its configuration have sizes of their own.
#[test]
fn larger_configurations_than_a_file_can_be_are_refused() {
    let mut config: GatewayConfig<9, 1, 32, 0, 0> = GatewayConfig::empty();
    config.set_controller("a").unwrap();
    config.add_recipe(&Recipe::realtime("r").stream_output(HEAD, &[], &["RobotState[8]"])).unwrap();
    for port in 0..9 {
        config.add_port(&Port::rs485(&format!("p{port}"), "r")).unwrap();
    }
    let kind = ConfigErrorKind::TooMany { what: Counted::Ports, needed: 9, room: MAX_PORTS };
    let error = ConfigError { place: Place::Whole, kind };
    assert_eq!(config.validate(), Err(error));
    assert_eq!(error.to_string(), "configuration: 9 ports; there is room for 8");
}

#[test]
fn frames_of_a_stream_may_end_with_their_tail_or_stand_between_escape_bytes() {
    let fields = [InputField::variable(ScalarType::Byte, "WordInputReg[1]")];
    let recipe = Recipe::user("scanner").stream_input(&[], &[13, 10], &fields);
    let framings = [
        (Boundary::Fields, None),
        (Boundary::Tail, None),
        (Boundary::Silence, None),
        (Boundary::Fields, Some(Escape::Slip)),
    ];
    for (boundary, escape) in framings {
        let recipe = recipe.framing(Direction::Input, boundary, escape).framing(
            Direction::Output,
            Boundary::Tail,
            None,
        );
        let bus = Bus::Rs485(Rs485::DEFAULT);
        let config: GatewayConfig = GatewayConfig::builder()
            .controller("10.0.0.2")
            .recipe(recipe)
            .port(Port::on("line", "scanner", bus.clone()))
            .build()
            .unwrap();
        let Parts::Stream { input: Some(part), output: None } = &config.recipes[0].parts else { panic!() };
        assert_eq!((part.framing, part.escape), (boundary, escape));
        assert_eq!(config.ports[0].bus, bus);
    }
}
