//! Errors that a file cannot have, but a stored or hand-made configuration can, each with its place. The messages for
//! files are tested with the files.

#[cfg(feature = "serde")]
use proptest::prelude::*;
use std::net::Ipv4Addr;
use std::string::ToString;

use super::*;
use crate::command::ParseError;
#[cfg(feature = "serde")]
use crate::modbus::rtu::Table;
use crate::recipe::PartError;
use crate::recipe::model::Mode;
use crate::sysvar::{Direction, SysVar};
use crate::time::Duration;
use crate::wire::scalar::{Scalar, ScalarType};

fn var(name: &str) -> SysVar {
    SysVar::parse(name).unwrap()
}

fn text<const N: usize>(text: &str) -> String<N> {
    String::try_from(text).unwrap()
}

/// A configuration under construction.
struct Builder(GatewayConfig);

impl Builder {
    /// A controller and nothing else.
    fn new() -> Self {
        let mut config = GatewayConfig::empty();
        config.set_controller("192.168.12.138").unwrap();
        Self(config)
    }

    /// One RS-485 port that switches outputs and shows the pose.
    fn one_port() -> Self {
        Self::new().stream(&["DigitalOutputCommand[1]"], &["RobotState[8]", "RobotState[9]"]).rs485(0)
    }

    fn recipe(mut self, mode: Mode, input: Fields<'_>, output: Fields<'_>) -> Self {
        let name = std::format!("recipe-{}", self.0.recipes.len());
        let mut recipe = if mode == Mode::User { Recipe::user(&name) } else { Recipe::realtime(&name) };
        if input.counts().0 > 0 {
            recipe = recipe.stream_input(&[0xFF, 0xFF], &[], input);
        }
        if output.counts().0 > 0 {
            recipe = recipe.stream_output(&[0xFF, 0xFF], &[], output);
        }
        self.0.add_recipe(&recipe).unwrap();
        self
    }

    fn stream(self, input: &[&str], output: &[&str]) -> Self {
        self.recipe(Mode::Realtime, input.into(), output.into())
    }

    fn user(self, input: &[FieldSpec], output: &[FieldSpec]) -> Self {
        self.recipe(Mode::User, input.into(), output.into())
    }

    fn port(mut self, recipe: u8, bus: Bus) -> Self {
        let name = text(&std::format!("port-{}", self.0.ports.len()));
        self.0.ports.push(Port::new(name, bus, recipe)).unwrap();
        self
    }

    fn rs485(self, recipe: u8) -> Self {
        self.port(recipe, Bus::Rs485(Rs485::default()))
    }

    fn link(mut self, recipe: u8) -> Self {
        self.0.controller.recipe_link = Some(RecipeLink { udp_port: 2011, recipe });
        self
    }

    fn with(mut self, change: impl FnOnce(&mut GatewayConfig)) -> Self {
        change(&mut self.0);
        self
    }

    #[track_caller]
    fn valid(self) -> GatewayConfig {
        self.0.validate().unwrap_or_else(|error| panic!("{error}"));
        self.0
    }

    #[track_caller]
    fn refused(self, place: Place, kind: ConfigErrorKind) {
        assert_eq!(self.0.validate(), Err(ConfigError { place, kind }));
    }
}

fn field(recipe: u8, part: Direction, field: u8) -> Place {
    Place::Field { recipe, part, frame: 0, field }
}

fn user_input(to: InputBinding) -> FieldSpec {
    FieldSpec::UserInput { ty: ScalarType::Byte, to }
}

fn constant() -> FieldSpec {
    FieldSpec::UserOutput { ty: ScalarType::Byte, from: OutputBinding::Constant(1.0) }
}

#[test]
fn good_configurations_pass() {
    Builder::one_port().valid();
    Builder::one_port().stream(&["DigitalOutputCommand[1]"], &["RobotState[26]"]).link(1).valid();
    let listen = Bus::TcpListen { listen: text("[::]:50000") };
    Builder::one_port().port(0, listen).valid();
    // A configuration without ports is valid.
    Builder::new().valid();
}

#[test]
fn ranges_that_leave_their_pools_are_refused() {
    let outside = ConfigErrorKind::OutsidePool { end: 3, len: 2 };
    let span = Span { start: 1, len: 2 };
    Builder::one_port().with(|config| config.fields.truncate(2)).refused(
        Place::Frame { recipe: 0, part: Direction::Output, frame: 0 },
        ConfigErrorKind::OutsidePool { end: 3, len: 2 },
    );
    Builder::one_port()
        .with(|config| {
            let safe = SafeValue::new(var("DigitalOutputCommand[1]"), Scalar::Byte(0));
            config.safe_values.extend([safe, safe]);
            config.ports[0].on_timeout = span;
        })
        .refused(Place::Port { port: 0, key: PortKey::OnTimeout }, outside);
    let table = InputBinding::Commands { table: span, when: CommandWhen::Change };
    Builder::new()
        .user(&[user_input(table)], &[])
        .refused(field(0, Direction::Input, 0), ConfigErrorKind::OutsidePool { end: 3, len: 0 });
    let far = Span { start: u16::MAX, len: u16::MAX };
    Builder::one_port().with(|config| config.ports[0].on_timeout = far).refused(
        Place::Port { port: 0, key: PortKey::OnTimeout },
        ConfigErrorKind::OutsidePool { end: 131_070, len: 0 },
    );
}

#[test]
fn indices_that_name_nothing_are_refused() {
    let missing = ConfigErrorKind::NoSuchRecipe { recipe: 7, recipes: 1 };
    Builder::one_port()
        .with(|config| config.ports[0].recipe = 7)
        .refused(Place::Port { port: 0, key: PortKey::Recipe }, missing);
    Builder::one_port().link(7).refused(Place::Controller(ControllerKey::RecipeLink), missing);
}

#[test]
fn fields_of_the_wrong_kind_are_refused() {
    // The layout checks the fields of a realtime recipe; only the check of recipes sees bindings.
    Builder::new().user(&[constant()], &[]).refused(
        field(0, Direction::Input, 0),
        ConfigErrorKind::WrongField { mode: Mode::User, part: Direction::Input },
    );
    Builder::new().user(&[FieldSpec::System(var("ForceEnd[1]"))], &[]).refused(
        field(0, Direction::Input, 0),
        ConfigErrorKind::Part(PartError::WrongMode {
            at: crate::recipe::FieldPlace { frame: None, field: 0 },
            mode: Mode::User,
        }),
    );
}

#[test]
fn numbers_that_no_file_can_hold_are_refused() {
    for (scale, offset) in [(f32::NAN, 0.0), (1.0, f32::INFINITY), (0.0, 1.0)] {
        let to = InputBinding::Variable { var: var("WordInputReg[1]"), scale, offset };
        let refused = Builder::new().user(&[user_input(to)], &[]).0.validate().unwrap_err();
        assert!(matches!(refused.kind, ConfigErrorKind::BadScale { .. }), "{refused}");
    }
    let from = OutputBinding::Constant(f64::NAN);
    let refused = Builder::new().user(&[], &[FieldSpec::UserOutput { ty: ScalarType::Float, from }]);
    assert!(matches!(refused.0.validate().unwrap_err().kind, ConfigErrorKind::Constant(_)));
    let table = Span { start: 0, len: 1 };
    let to = InputBinding::Commands { table, when: CommandWhen::Frame };
    for (value, text, kind) in [
        (i64::MAX, "stop", ConfigErrorKind::CommandValue { value: i64::MAX, ty: ScalarType::Byte }),
        (1, " ", ConfigErrorKind::Command(ParseError::Empty)),
    ] {
        let entry = CommandEntry::new(value, self::text(text));
        Builder::new()
            .user(&[user_input(to)], &[])
            .with(|config| config.commands.push(entry).unwrap())
            .refused(Place::Command { entry: 0 }, kind);
    }
}

#[test]
fn safe_values_fit_their_variables() {
    let digital = var("DigitalOutputCommand[3]");
    for (value, kind) in [
        (Scalar::Word(0), ConfigErrorKind::SafeType { var: digital, ty: ScalarType::Word }),
        (Scalar::Byte(4), ConfigErrorKind::SafeValue { var: digital }),
    ] {
        Builder::new()
            .stream(&["DigitalOutputCommand[3]"], &[])
            .rs485(0)
            .with(|config| {
                config.safe_values.push(SafeValue::new(digital, value)).unwrap();
                config.ports[0].on_timeout = Span { start: 0, len: 1 };
            })
            .refused(Place::SafeValue { entry: 0 }, kind);
    }
    let force = SafeValue::new(var("ForceEnd[1]"), Scalar::Float(f32::NAN));
    Builder::new()
        .stream(&["ForceEnd[1]"], &[])
        .rs485(0)
        .link(0)
        .with(|config| {
            config.safe_values.push(force).unwrap();
            config.ports[0].on_timeout = Span { start: 0, len: 1 };
        })
        .refused(Place::SafeValue { entry: 0 }, ConfigErrorKind::SafeValue { var: force.var });
}

#[test]
fn a_variable_has_one_owner() {
    let var = var("DigitalOutputCommand[1]");
    Builder::one_port().rs485(0).refused(
        Place::Port { port: 1, key: PortKey::Recipe },
        ConfigErrorKind::OwnedTwice { var, other: 0 },
    );
    // A route carries what a port owns, but owns nothing itself.
    Builder::one_port().port(0, Bus::UdpListen { listen: text("0.0.0.0:0") }).valid();
}

#[test]
fn what_only_recipe_ports_carry_needs_one() {
    let force = var("ForceEnd[1]");
    Builder::new()
        .stream(&["ForceEnd[1]"], &[])
        .rs485(0)
        .refused(field(0, Direction::Input, 0), ConfigErrorKind::NoRoute { var: force, port: 0 });
    Builder::new().stream(&["ForceEnd[1]"], &[]).rs485(0).link(0).valid();
    Builder::new()
        .stream(&["ForceEnd[1]"], &[])
        .link(0)
        .refused(field(0, Direction::Input, 0), ConfigErrorKind::Unowned { var: force });
    // A variable that the state stream shows can also be read back.
    Builder::new().stream(&["FloatInputReg[1]"], &[]).link(0).valid();

    let mass = var("RobotState[26]");
    Builder::new()
        .stream(&[], &["RobotState[26]"])
        .rs485(0)
        .refused(field(0, Direction::Output, 0), ConfigErrorKind::NoSource { var: mass, port: 0 });
    Builder::new().stream(&[], &["RobotState[26]"]).rs485(0).link(0).valid();
}

#[test]
fn errors_name_things_when_the_configuration_is_at_hand() {
    let config = Builder::one_port().rs485(0).0;
    let error = config.validate().unwrap_err();
    let unnamed = "port 2, recipe: DigitalOutputCommand[1] is written by this port and by port 1; a variable has one owner";
    assert_eq!(error.to_string(), unnamed);
    let named = unnamed.replace("port 2", "port \"port-1\"").replace("port 1;", "port \"port-0\";");
    assert_eq!(config.view().describe(error).to_string(), named);
}

#[test]
fn warnings_are_not_errors() {
    let config = Builder::one_port()
        .stream(&["DigitalOutputCommand[1]", "WordInputReg[1]"], &[])
        .link(1)
        .stream(&["BitInputReg[1]"], &[])
        .with(|config| {
            let Bus::Rs485(line) = &mut config.ports[0].bus else { return };
            line.baud = 9_600;
        })
        .valid();
    let shortest = Duration::from_micros(10_417 + 100);
    let expected = [
        Warning::DoesNotFit { port: 0, cycle: MIN_CYCLE, shortest },
        Warning::ReadBack { recipe: 1, var: var("WordInputReg[1]") },
        Warning::Unused { recipe: 2 },
    ];
    assert!(
        config.view().warnings().eq(expected),
        "{:?}",
        config.view().warnings().collect::<std::vec::Vec<_>>()
    );
    let said = config.view().describe_warning(expected[0]).to_string();
    assert!(said.contains("port \"port-0\"") && said.contains("10517 µs"), "{said}");
    assert_eq!(Builder::one_port().valid().view().warnings().count(), 0);
}

/// Adds all kinds of exchanges, each in its own recipe, and their ports.
#[cfg(feature = "serde")]
fn add_exchanges(config: &mut GatewayConfig) {
    let time = Duration::from_millis(50);
    let read = [InputField::variable(ScalarType::Word, "WordInputReg[10]"), InputField::padding(2)];
    let coils = [OutputField::constant(Coil, 1.0), OutputField::padding(9, 0), OutputField::counter(Coil)];
    let sent = [OutputField::variable(ScalarType::Word, "WordOutputReg[1]")];
    let byte = [InputField::constant(ScalarType::Byte, 0x15)];
    let answer = [InputField::variable(ScalarType::Word, "WordInputReg[11]")];
    let id = crate::wire::can::CanId::Standard(0x701);
    let state = [InputField::variable(ScalarType::Byte, "WordInputReg[12]")];
    let job = [InputField::variable(ScalarType::Word, "WordInputReg[13]")];
    let master = [
        ExchangeBuilder::read_input_registers(9, 16, &read).every(time).retries(2),
        ExchangeBuilder::write_coils(0, 8, &coils).on_rising("BitOutputReg[3]", 7),
    ];
    let slave = [
        ExchangeBuilder::served(5, Table::HoldingRegisters, 0, &sent),
        ExchangeBuilder::served(5, Table::HoldingRegisters, 1, &job),
    ];
    let frames = [ExchangeBuilder::request(ExchangeFrame::stream(&[2], &[3], &sent))
        .reply(ExchangeFrame::stream(&[2], &[3], &answer))
        .refusal(ExchangeFrame::stream(&[], &[], &byte))
        .peer(3)
        .at_start()
        .on_change()];
    let remote = [ExchangeBuilder::request(ExchangeFrame::remote(id))
        .reply(ExchangeFrame::can(id, &state))
        .every(time)
        .pause(time)];
    for (name, asks) in [("master", &master[..]), ("slave", &slave), ("talk", &frames)] {
        config.add_recipe(&Recipe::user(name).exchanges(asks)).unwrap();
        config.add_port(&Port::modbus_rtu(name, name).echo(Echo::Yes)).unwrap();
    }
    config.add_recipe(&Recipe::user("remote").exchanges(&remote)).unwrap();
    config.add_port(&Port::can("remote", "remote")).unwrap();
}

/// All kinds of fields, exchanges, a command table, a safe value and a board's own address.
#[cfg(feature = "serde")]
pub(super) fn every_kind() -> GatewayConfig {
    let table = InputBinding::Commands { table: Span { start: 0, len: 1 }, when: CommandWhen::Frame };
    let word = InputBinding::Variable { var: var("WordInputReg[1]"), scale: 2.0, offset: 1.0 };
    let shown = OutputBinding::Variable { var: var("BitOutputReg[3]"), scale: 1.0, offset: 0.0 };
    Builder::new()
        .user(
            &[user_input(table), user_input(word), user_input(InputBinding::Unused)],
            &[constant(), FieldSpec::UserOutput { ty: ScalarType::Int, from: shown }],
        )
        .stream(&["ForceEnd[1]"], &["RobotState[26]"])
        .rs485(0)
        .link(1)
        .stream(&["ForceEnd[1]"], &["RobotState[26]"])
        .rs485(2)
        .with(|config| {
            config.commands.push(CommandEntry::new(1, text("stop"))).unwrap();
            config.safe_values.push(SafeValue::new(var("ForceEnd[1]"), Scalar::Float(0.0))).unwrap();
            config.network = BoardAddress::Static(network());
            config.ports[1].on_timeout = Span { start: 0, len: 1 };
            config.recipes[0].send = SendOn::Rising { var: var("BitOutputReg[3]"), bit: 7 };
            add_exchanges(config);
        })
        .valid()
}

#[cfg(feature = "serde")]
proptest! {
    #[test]
    fn a_damaged_stored_configuration_is_refused_or_usable(
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
    ) {
        let mut bytes = [0; 1024];
        let len = postcard::to_slice(&every_kind(), &mut bytes).unwrap().len();
        for (place, value) in damage {
            bytes[place.index(len)] = value;
        }
        let Ok(config) = postcard::from_bytes::<GatewayConfig>(&bytes[..len]) else { return Ok(()) };
        match config.validate() {
            // An engine must be able to plan a valid configuration.
            Ok(()) => {
                prop_assert!(config.view().warnings().count() < 1_000);
                let view = config.view();
                let budgets = |port| view.exchanges.iter().map(move |one| view.exchange_budget(port, one));
                let mut all = config.ports.iter().flat_map(budgets);
                prop_assert!(all.all(|budget| budget.time <= budget.time_without_reply));
                prop_assert!(crate::engine::Plan::new(&config).is_ok());
            }
            Err(error) => prop_assert!(!config.view().describe(error).to_string().is_empty()),
        }
    }
}

#[cfg(feature = "serde")]
#[test]
fn a_configuration_survives_storage() {
    let config = Builder::one_port().stream(&["ForceEnd[1]"], &[]).link(1).0;
    let mut bytes = [0; 512];
    let stored = postcard::to_slice(&config, &mut bytes).unwrap();
    assert!(stored.len() <= 150, "{} bytes", stored.len());
    let back: GatewayConfig = postcard::from_bytes(stored).unwrap();
    assert_eq!(back, config);
    for cut in 0..stored.len() {
        assert!(postcard::from_bytes::<GatewayConfig>(&stored[..cut]).is_err(), "cut at {cut}");
    }
}

fn network() -> Network {
    Network {
        address: Ipv4Addr::new(192, 168, 12, 20),
        prefix: 24,
        router: Some(Ipv4Addr::new(192, 168, 12, 1)),
        dns: Some(Ipv4Addr::new(8, 8, 8, 8)),
    }
}

/// Checks one port, a controller with this address, and a changed network.
fn checked(controller: &str, change: impl FnOnce(&mut Network)) -> Result<(), (NetworkKey, ConfigErrorKind)> {
    let mut config = Builder::one_port().0;
    config.controller.address = text(controller);
    let mut network = network();
    change(&mut network);
    config.network = BoardAddress::Static(network);
    config.validate().map_err(|error| match error.place {
        Place::Network(key) => (key, error.kind),
        place => panic!("{place:?}"),
    })
}

#[test]
fn a_board_reaches_what_it_needs_from_its_own_address() {
    let alone = |network: &mut Network| (network.router, network.dns) = (None, None);
    assert_eq!(checked("192.168.12.138", |_| {}), Ok(()));
    assert_eq!(checked("192.168.12.138", alone), Ok(()));
    assert_eq!(checked("10.0.0.9", |_| {}), Ok(()), "through the router");
    assert_eq!(checked("robot.cell", |_| {}), Ok(()));
    let nameless = checked("robot.cell", |network| network.dns = None);
    assert_eq!(nameless, Err((NetworkKey::Address, ConfigErrorKind::NeedsDns)));
    let (address, mut lonely) = (Ipv4Addr::new(10, 0, 0, 9), network());
    alone(&mut lonely);
    let refused = checked("10.0.0.9", alone);
    assert_eq!(
        refused,
        Err((NetworkKey::Address, ConfigErrorKind::NeedsRouter { address, network: lonely }))
    );
    let refused = checked("192.168.12.138", |network| network.router = None);
    assert!(matches!(refused, Err((NetworkKey::Dns, ConfigErrorKind::NeedsRouter { .. }))));
}

#[test]
fn a_board_its_router_and_its_name_server_have_addresses_of_hosts() {
    for prefix in [0, 31, 32, 255] {
        let refused = checked("192.168.12.138", |network| network.prefix = prefix);
        assert_eq!(refused, Err((NetworkKey::Address, ConfigErrorKind::Prefix { prefix })));
    }
    // The network's own address, its broadcast address, and addresses that no host can have.
    let nobody = ["192.168.12.0", "192.168.12.255", "0.0.0.1", "127.0.0.1", "224.0.0.1", "255.255.255.255"];
    for address in nobody.map(|address| address.parse::<Ipv4Addr>().unwrap()) {
        let is_refused = |refused, wanted| {
            matches!(refused, Err((key, ConfigErrorKind::NoHostAddress { address: named, .. }))
                if key == wanted && named == address)
        };
        let refused = checked("192.168.12.138", |network| network.address = address);
        assert!(is_refused(refused, NetworkKey::Address), "{address}: {refused:?}");
        let refused = checked("192.168.12.138", |network| network.router = Some(address));
        assert!(is_refused(refused, NetworkKey::Router), "{address}: {refused:?}");
    }
    let elsewhere = Some(Ipv4Addr::new(10, 0, 0, 9));
    let refused = checked("192.168.12.138", |network| network.router = elsewhere);
    assert!(matches!(refused, Err((NetworkKey::Router, ConfigErrorKind::NoHostAddress { .. }))));
    let refused = checked("192.168.12.138", |network| network.dns = Some(Ipv4Addr::LOCALHOST));
    assert!(matches!(refused, Err((NetworkKey::Dns, ConfigErrorKind::NoHostAddress { .. }))));
    let refused = checked("192.168.12.138", |network| network.router = Some(network.address));
    assert_eq!(refused, Err((NetworkKey::Router, ConfigErrorKind::OwnAddress)));
    let refused = checked("192.168.12.138", |network| network.dns = Some(network.address));
    assert_eq!(refused, Err((NetworkKey::Dns, ConfigErrorKind::OwnAddress)));
}

#[test]
fn every_kind_of_error_has_a_text() {
    let (kinds, texts) = (include_str!("error.rs"), include_str!("describe.rs"));
    for (name, path) in [("ConfigErrorKind", "Kind"), ("ExchangeError", "Self")] {
        let (_, of_enum) = kinds.split_once(&std::format!("pub enum {name} {{")).unwrap();
        let (variants, _) = of_enum.split_once("\n}").unwrap();
        let lines = variants.lines().filter_map(|line| line.strip_prefix("    "));
        let names: std::vec::Vec<_> = lines
            .filter(|line| line.starts_with(char::is_uppercase))
            .filter_map(|line| line.split([' ', '(', ',']).next())
            .collect();
        assert!(names.len() > 30, "{name}");
        for variant in names {
            let arm = std::format!("{path}::{variant} ");
            assert!(texts.contains(&arm) || texts.contains(&arm.replace(' ', "(")), "{name}::{variant}");
        }
    }
}
