//! Sources of fields beside the variables, what the robot is told of the ports' health, safe values
//! at the start, and refreshed outputs (docs/engine.md sections 6, 8 and 11).

mod rig;

use proto_core::config::*;
use proto_core::device::{ByteOrder, Encoding, Overflow};
use proto_core::engine::{BuildError, Engine, Input, LinkId, PortId};
use proto_core::modbus::Exception;
use proto_core::recipe::model::Mode;
use proto_core::sysvar::ModbusPlace;
use proto_core::wire::dialect::Dialect;
use proto_core::wire::scalar::ScalarType as T;
use proto_core::wire::state::StatePacket;
use rig::*;

const STATE: LinkId = LinkId::STATE;
const UDP: LinkId = LinkId::RECIPE_UDP;
const FRAME: &[u8] = &[255, 255, 7, 238, 238];

fn state(name: &str, scale: f32, offset: f32) -> OutputBinding {
    OutputBinding::State { value: StateValue::parse(name).unwrap(), scale, offset }
}

fn health(port: Option<u8>, value: PortValue) -> OutputBinding {
    OutputBinding::Port { port, value, scale: 1.0, offset: 0.0 }
}

/// A port that sends these fields between 1 and 2, every 4 ms.
fn lamp(cell: &mut Cell, fields: &[(T, OutputBinding)]) -> PortId {
    let fields = cell.fields(fields.iter().map(|&(ty, from)| user_out(ty, from)));
    let output = cell.part(&[1], &[2], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.rs485(recipe)
}

/// A port whose device sends one byte for this variable in [`FRAME`]s.
fn sensor(cell: &mut Cell, name: &str) -> PortId {
    let to = InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 };
    let fields = cell.fields([user_in(T::Byte, to)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe)
}

fn packet(change: impl FnOnce(&mut StatePacket)) -> Vec<u8> {
    let mut packet = StatePacket::ZERO;
    change(&mut packet);
    packet.to_bytes().to_vec()
}

/// The newest frame that was sent, without 1 and 2.
#[track_caller]
fn newest(rig: &mut Rig, port: PortId) -> Vec<u8> {
    let frame = rig.sent_to(port).pop().expect("a frame");
    frame[1..frame.len() - 1].to_vec()
}

// The controller's state.

#[test]
fn the_controllers_state_reaches_the_field() {
    let mut cell = Cell::new();
    let fields = [
        (T::Byte, state("mode", 1.0, 0.0)),
        (T::Byte, state("robot_state", 1.0, 0.0)),
        (T::Dword, state("error_code", 1.0, 0.0)),
        (T::Short, state("joint_position[6]", 1000.0, 0.0)),
        (T::Byte, state("digital_inputs[16]", 1.0, 0.0)),
        (T::Byte, state("mode", 1.0, 100.0)),
    ];
    let port = lamp(&mut cell, &fields);
    let mut rig = cell.rig();
    assert!(rig.engine.links().any(|link| link.id == STATE), "it needs the stream");
    rig.run(MS(50));
    assert!(rig.sent_to(port).is_empty(), "nothing is known yet");
    rig.link_bytes(
        STATE,
        &packet(|packet| {
            (packet.operation_mode, packet.robot_state) = (1, 6);
            packet.error_code = 0x0001_0203;
            packet.joint_position[5] = -1.5;
            packet.digital_inputs[15] = 1;
        }),
    );
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, port), [1, 6, 3, 2, 1, 0, 0x24, 0xFA, 1, 101]);
    rig.link_bytes(STATE, &packet(|packet| packet.operation_mode = 2));
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, port), [2, 0, 0, 0, 0, 0, 0, 0, 0, 102]);
}

#[test]
fn a_device_gets_it_in_its_own_byte_order() {
    let mut cell = Cell::new();
    let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(T::Short) };
    let field = FieldSpec::DeviceOutput {
        encoding,
        overflow: Overflow::Usual,
        from: state("tcp_velocity[3]", 1000.0, 1.0),
    };
    let fields = cell.fields([field]);
    let output = cell.part(&[1], &[2], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(STATE, &packet(|packet| packet.tcp_velocity[2] = 0.5));
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, port), [0x01, 0xF5]);
}

#[test]
fn what_cannot_be_read_is_not_sent_and_the_rest_is() {
    let mut cell = Cell::new();
    let first = lamp(&mut cell, &[(T::Float, state("joint_torque[1]", 1.0, 0.0))]);
    let second = lamp(&mut cell, &[(T::Float, state("joint_torque[2]", 1.0, 0.0))]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let torques = |one, two| packet(|packet| (packet.joint_torque[0], packet.joint_torque[1]) = (one, two));
    rig.link_bytes(STATE, &torques(1.0, 2.0));
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, first), 1.0_f32.to_le_bytes());
    for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        rig.sent_to(second);
        rig.link_bytes(STATE, &torques(wrong, 3.0));
        rig.run(MS(40));
        assert!(rig.sent_to(first).is_empty(), "{wrong}");
        assert_eq!(newest(&mut rig, second), 3.0_f32.to_le_bytes());
    }
    assert_eq!(rig.link(STATE).counters.unreadable, 3);
    rig.link_bytes(STATE, &torques(4.0, 3.0));
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, first), 4.0_f32.to_le_bytes());
}

#[test]
fn it_is_as_old_as_the_packet() {
    for on_stale in [OnStale::Hold, OnStale::Stop] {
        let mut cell = Cell::new();
        let port = lamp(&mut cell, &[(T::Byte, state("safety_state", 1.0, 0.0))]);
        cell.last_recipe().on_stale = on_stale;
        let mut rig = cell.rig();
        rig.run(MS(10));
        rig.link_bytes(STATE, &packet(|_| ()));
        rig.run(MS(480));
        assert!(!rig.sent_to(port).is_empty());
        rig.run(MS(40));
        rig.sent_to(port);
        rig.run(MS(40));
        assert_eq!(rig.sent_to(port).is_empty(), on_stale == OnStale::Stop);
    }
}

#[test]
fn the_speed_needs_a_dialect_that_has_it() {
    let mut cell = Cell::new();
    let port = lamp(&mut cell, &[(T::Byte, state("speed", 1.0, 0.0))]);
    let refused = cell.0.validate().unwrap_err();
    assert_eq!(refused.kind, ConfigErrorKind::StateValue(StateValueError::NoSpeed));
    cell.0.controller.set_dialect(Dialect::V2_6);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(STATE, &packet(|packet| packet.reserved_656[4] = 75));
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, port), [75]);
}

#[test]
fn there_is_room_for_thirty_two_values() {
    let mut cell = Cell::new();
    let all =
        |count: usize| (1..=count).map(|nth| (T::Byte, state(&format!("bool_inputs[{nth}]"), 1.0, 0.0)));
    let some: Vec<_> = all(28).collect();
    // The same value on two ports needs one place.
    lamp(&mut cell, &some);
    let more = ["mode", "robot_state", "program_state", "safety_state"];
    let more: Vec<_> = more.iter().map(|name| (T::Byte, state(name, 1.0, 0.0))).chain(all(28)).collect();
    lamp(&mut cell, &more);
    assert!(Engine::<8, 4, 512>::new(&cell.0).is_ok());
    lamp(&mut cell, &[(T::Byte, health(None, PortValue::Alive))]);
    let refused = Engine::<8, 4, 512>::new(&cell.0).unwrap_err();
    assert_eq!(refused, BuildError::TooMany { what: Counted::Sources, needed: 33, room: 32 });
}

// The health of ports, for the field.

#[test]
fn a_port_shows_its_own_health_and_that_of_others() {
    let mut cell = Cell::new();
    let device = sensor(&mut cell, "WordInputReg[1]");
    let fields = [
        (T::Byte, health(Some(0), PortValue::Alive)),
        (T::Byte, health(Some(0), PortValue::Frames)),
        (T::Word, health(Some(0), PortValue::Age)),
        (T::Byte, health(Some(0), PortValue::Rejected)),
        (T::Byte, health(None, PortValue::Alive)),
    ];
    let port = lamp(&mut cell, &fields);
    let mut rig = cell.rig();
    rig.run(MS(20));
    assert_eq!(newest(&mut rig, port), [0, 0, 0xFF, 0xFF, 0, 1], "it has never spoken");
    for _ in 0..300 {
        rig.bytes(device, FRAME);
        rig.run(MS(4));
    }
    let shown = newest(&mut rig, port);
    assert_eq!((shown[0], shown[1]), (1, 44), "300 wraps in a byte");
    assert!(shown[2] <= 4 && shown[3] == 0, "{shown:?}");
    rig.run(MS(80));
    let shown = newest(&mut rig, port);
    assert!(shown[0] == 1 && (78..=84).contains(&shown[2]), "{shown:?}");
    rig.run(MS(40));
    assert_eq!(newest(&mut rig, port)[0], 0, "it is overdue");
    rig.run(MS(70_000));
    assert_eq!(newest(&mut rig, port)[2..4], [0xFF, 0xFF], "the age saturates");
    rig.bytes(device, &[255, 255, 7, 1, 238]);
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, port)[4], 1, "the tail is wrong");
    rig.bytes(device, FRAME);
    rig.input(Input::PortDown { port: device });
    rig.run(MS(4));
    assert_eq!(newest(&mut rig, port)[0], 0, "gone");
}

// The health of ports, for the robot.

fn register(name: &str) -> usize {
    match var(name).modbus() {
        Some(ModbusPlace::Register { address }) => usize::from(address),
        other => panic!("{other:?}"),
    }
}

const TOLD: [(PortValue, &str); 4] = [
    (PortValue::Alive, "WordInputReg[20]"),
    (PortValue::Frames, "WordInputReg[21]"),
    (PortValue::Age, "WordInputReg[22]"),
    (PortValue::Rejected, "WordInputReg[23]"),
];

/// A device, and all of its health by Modbus; the registers of the controller have other values.
fn told() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let port = sensor(&mut cell, "WordInputReg[1]");
    TOLD.iter().for_each(|&(value, name)| cell.last_port().health.set(value, var(name)));
    let mut rig = cell.rig();
    rig.map.registers = [99; 118];
    (rig, port)
}

fn robot_sees(rig: &Rig) -> [u16; 4] {
    TOLD.map(|(_, name)| rig.map.registers[register(name)])
}

#[test]
fn a_device_that_is_dead_from_the_start_is_told() {
    let (mut rig, _) = told();
    rig.run(MS(20));
    assert_eq!(robot_sees(&rig), [0, 0, 0xFFFF, 0]);
    assert_eq!(rig.map.registers[register("WordInputReg[1]")], 99, "its own value is not invented");
    let status = rig.engine.status(rig.now);
    let owned: Vec<_> = status.variables().map(|known| (known.var, known.owner)).collect();
    assert_eq!(owned, TOLD.map(|(_, name)| (var(name), Some("port0"))));
}

#[test]
fn the_robot_sees_a_device_come_and_go() {
    let (mut rig, port) = told();
    rig.run(MS(20));
    for _ in 0..50 {
        rig.bytes(port, FRAME);
        rig.run(MS(4));
    }
    let [alive, frames, age, _] = robot_sees(&rig);
    assert!(alive == 1 && (20..=50).contains(&frames) && age <= 4, "{alive} {frames} {age}");
    let silent = rig.now;
    while robot_sees(&rig)[0] == 1 {
        rig.run(MS(1));
    }
    let micros = rig.now.saturating_since(silent).as_micros();
    assert!((95_000..=101_000).contains(&micros), "at once when it is overdue: {micros}");
    rig.run(MS(100));
    assert_eq!(robot_sees(&rig)[1], 50);
    rig.bytes(port, FRAME);
    rig.run(MS(96));
    rig.bytes(port, FRAME);
    rig.run(MS(8));
    assert_eq!(robot_sees(&rig)[0], 1);
    rig.input(Input::PortDown { port });
    assert_eq!(robot_sees(&rig)[0], 0, "at once when it is gone");
}

#[test]
fn what_has_not_changed_is_seldom_told() {
    let mut cell = Cell::new();
    let port = sensor(&mut cell, "WordInputReg[1]");
    cell.last_port().health.alive = Some(var("WordInputReg[20]"));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.take_written();
    rig.run(MS(3_000));
    let written = rig.take_written();
    assert!((2..=3).contains(&written.len()), "{written:?}");
    assert_eq!(rig.counters(port).undelivered, 0);
}

#[test]
fn age_is_told_ten_times_a_second_at_most() {
    let (mut rig, port) = told();
    rig.run(MS(10));
    rig.bytes(port, FRAME);
    rig.run(MS(5));
    rig.take_written();
    rig.run(MS(1_000));
    let written = rig.take_written().len();
    assert!((10..=13).contains(&written), "{written}");
}

#[test]
fn it_is_told_again_after_the_link_was_away_or_a_write_failed() {
    let (mut rig, _) = told();
    rig.run(MS(20));
    rig.map.registers = [99; 118];
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.run(MS(400));
    assert_eq!(robot_sees(&rig), [0, 0, 0xFFFF, 0]);

    rig.map.registers = [99; 118];
    rig.map.exception = Some(Exception::IllegalDataAddress);
    rig.run(MS(1_500));
    rig.map.exception = None;
    rig.run(MS(1_100));
    assert_eq!(robot_sees(&rig), [0, 0, 0xFFFF, 0]);
}

#[test]
fn it_goes_by_a_recipe_link_that_carries_it() {
    let mut cell = Cell::new();
    let port = sensor(&mut cell, "FloatInputReg[1]");
    cell.last_port().health.alive = Some(var("WordInputReg[20]"));
    cell.last_port().health.age = Some(var("FloatInputReg[2]"));
    let link = cell.stream(&["WordInputReg[20]", "FloatInputReg[1..2]"], &[]);
    cell.recipe_link(link);
    let mut rig = cell.rig();
    assert!(!rig.engine.links().any(|link| link.id == LinkId::MODBUS));
    rig.run(MS(200));
    assert!(rig.sent_on(UDP).is_empty(), "its neighbour is unknown");
    rig.link_bytes(STATE, &packet(|packet| packet.float_inputs[0] = 2.5));
    rig.run(MS(110));
    let frame = |alive: u8, value: f32, age: f32| {
        [&[255, 255, alive, 0][..], &value.to_le_bytes(), &age.to_le_bytes(), &[238, 238]].concat()
    };
    assert_eq!(rig.sent_on(UDP).last(), Some(&frame(0, 2.5, 4_294_967_295.0)));
    rig.bytes(port, FRAME);
    rig.run(MS(1));
    assert_eq!(rig.sent_on(UDP).last().unwrap()[4..8], 7.0_f32.to_le_bytes());
    // Sent to the robot in time, and alive within 100 ms.
    rig.run(MS(98));
    assert_eq!(rig.sent_on(UDP).last().unwrap()[2..4], [1, 0]);
}

#[test]
fn the_gateways_own_sleep_tells_nothing_old() {
    let (mut rig, port) = told();
    rig.run(MS(20));
    rig.bytes(port, FRAME);
    rig.run(MS(90));
    assert_eq!(robot_sees(&rig)[0], 1);
    rig.map.registers = [99; 118];
    rig.now += MS(3_000);
    rig.input(Input::Tick);
    rig.run(MS(400));
    let [alive, frames, age, _] = robot_sees(&rig);
    assert!(alive == 0 && frames == 1 && age >= 3_000, "{alive} {frames} {age}");
}

// Safe values at the start.

#[test]
fn a_device_that_is_dead_from_the_start_gets_its_safe_values() {
    for safe_at_start in [false, true] {
        let mut cell = Cell::new();
        let port = sensor(&mut cell, "WordInputReg[1]");
        cell.safe("WordInputReg[1]", 42.0);
        cell.last_port().safe_at_start = safe_at_start;
        let mut rig = cell.rig();
        rig.run(MS(20));
        let seen = rig.map.registers[register("WordInputReg[1]")];
        assert_eq!(seen, if safe_at_start { 42 } else { 0 });
        assert_eq!(rig.counters(port).timeouts, u32::from(safe_at_start));
        // It is repeated when the controller was away, and ends when the device speaks.
        rig.map.registers = [0; 118];
        rig.input(Input::LinkDown { link: LinkId::MODBUS });
        rig.run(MS(400));
        assert_eq!(rig.map.registers[register("WordInputReg[1]")], seen);
        rig.bytes(port, FRAME);
        rig.run(MS(4));
        assert_eq!(rig.map.registers[register("WordInputReg[1]")], 7);
    }
}

#[test]
fn at_the_start_a_variable_without_a_safe_value_holds() {
    let mut cell = Cell::new();
    let to = |name| InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 };
    let fields =
        cell.fields([user_in(T::Byte, to("WordInputReg[1]")), user_in(T::Byte, to("WordInputReg[2]"))]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe);
    cell.safe("WordInputReg[2]", 42.0);
    cell.last_port().safe_at_start = true;
    let mut rig = cell.rig();
    rig.run(MS(20));
    let written = rig.take_written();
    assert_eq!(written, [Written::Registers(register("WordInputReg[2]") as u16, vec![42])]);
}

#[test]
fn at_the_start_safe_values_fill_a_recipe_links_frame() {
    let mut cell = Cell::new();
    sensor(&mut cell, "ForceEnd[1]");
    cell.safe("ForceEnd[1]", 0.5);
    cell.last_port().safe_at_start = true;
    let link = cell.stream(&["ForceEnd[1]"], &[]);
    cell.recipe_link(link);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frame = [&[255, 255][..], &0.5_f32.to_le_bytes(), &[238, 238]].concat();
    assert_eq!(rig.sent_on(UDP).first(), Some(&frame));
}

// Outputs that are sent on change.

/// A port that sends WordOutputReg[1] when it changes.
fn tower(refresh: Option<u64>) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let word = OutputBinding::Variable { var: var("WordOutputReg[1]"), scale: 1.0, offset: 0.0 };
    let port = lamp(&mut cell, &[(T::Byte, word)]);
    cell.last_recipe().send = SendOn::Change;
    cell.last_port().refresh = refresh.map(MS);
    let mut rig = cell.rig();
    rig.run(MS(50));
    assert_eq!(rig.sent_to(port).len(), 1);
    (rig, port)
}

#[test]
fn a_device_that_is_powered_later_is_refreshed() {
    let (mut rig, port) = tower(None);
    rig.run(MS(10_000));
    assert!(rig.sent_to(port).is_empty());

    let (mut rig, port) = tower(Some(1_000));
    rig.run(MS(10_000));
    assert_eq!(rig.sent_to(port).len(), 10);
    rig.run(MS(500));
    rig.sent_to(port);
    rig.map.registers[register("WordOutputReg[1]")] = 5;
    rig.run(MS(20));
    assert_eq!(rig.sent_to(port), [[1, 5, 2]], "a change is sent at once");
    rig.run(MS(970));
    assert!(rig.sent_to(port).is_empty(), "counted from the newest frame");
    rig.run(MS(40));
    assert_eq!(rig.sent_to(port), [[1, 5, 2]]);
}

#[test]
fn a_device_that_comes_back_gets_its_state() {
    let (mut rig, port) = tower(None);
    rig.input(Input::PortDown { port });
    rig.run(MS(100));
    assert!(rig.sent_to(port).is_empty());
    rig.input(Input::PortUp { port });
    rig.run(MS(4));
    assert_eq!(rig.sent_to(port), [[1, 0, 2]]);
}

// Mistakes.

fn kind(cell: &Cell) -> ConfigErrorKind {
    cell.0.validate().expect_err("a mistake").kind
}

#[test]
fn a_lamp_shows_whether_links_are_up() {
    let mut cell = Cell::new();
    let up = |link| OutputBinding::Link { link, scale: 1.0, offset: 0.0 };
    let inverted = OutputBinding::Link { link: LinkSource::Modbus, scale: -1.0, offset: 1.0 };
    let fields = [(T::Byte, up(LinkSource::Modbus)), (T::Byte, inverted), (T::Byte, up(LinkSource::Command))];
    let lamp = lamp(&mut cell, &fields);
    sensor(&mut cell, "BitInputReg[1]");
    let mut rig = cell.rig();
    rig.run(MS(100));
    assert_eq!(newest(&mut rig, lamp), [1, 0, 0], "nobody picks commands, so there is no such link");
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    let _ = rig.sent_to(lamp);
    rig.run(MS(8));
    assert_eq!(newest(&mut rig, lamp), [0, 1, 0]);
    rig.run(MS(1_000));
    assert_eq!(newest(&mut rig, lamp), [1, 0, 0]);
}

#[test]
fn a_link_that_cannot_be_is_refused() {
    for (link, expected) in
        [(LinkSource::RecipeUdp, false), (LinkSource::Listening(0), false), (LinkSource::State, true)]
    {
        let mut cell = Cell::new();
        lamp(&mut cell, &[(T::Byte, OutputBinding::Link { link, scale: 1.0, offset: 0.0 })]);
        let result = cell.0.validate();
        let is_it = |error: &ConfigError| error.kind == ConfigErrorKind::NoLink { link };
        assert_eq!(result.as_ref().is_err_and(is_it), !expected, "{result:?}");
    }
}

#[test]
fn mistakes_are_refused() {
    use ConfigErrorKind as Kind;
    let out = |ty, from| {
        let mut cell = Cell::new();
        lamp(&mut cell, &[(ty, from)]);
        cell
    };
    let unknown = OutputBinding::State { value: StateValue { row: 200, item: 0 }, scale: 1.0, offset: 0.0 };
    assert_eq!(kind(&out(T::Byte, unknown)), Kind::StateValue(StateValueError::Unknown));
    assert!(matches!(kind(&out(T::Byte, state("mode", 0.0, 0.0))), Kind::BadScale { .. }));
    let other = health(Some(1), PortValue::Alive);
    assert_eq!(kind(&out(T::Byte, other)), Kind::NoFieldPort { port: 1 });
    let scaled = OutputBinding::Port { port: None, value: PortValue::Frames, scale: 2.0, offset: 0.0 };
    assert_eq!(kind(&out(T::Byte, scaled)), Kind::ScaledCount);
    let count = health(None, PortValue::Rejected);
    assert_eq!(kind(&out(T::Float, count)), Kind::NeedsInteger { ty: T::Float });

    let port = |change: &dyn Fn(&mut Port)| {
        let mut cell = Cell::new();
        sensor(&mut cell, "WordInputReg[1]");
        change(cell.last_port());
        cell
    };
    let with = |name: &'static str| port(&move |port| port.health.alive = Some(var(name)));
    for name in ["BitInputReg[3]", "DigitalOutputCommand[1]", "ForceEnd[1]", "WordOutputReg[1]"] {
        assert_eq!(kind(&with(name)), Kind::NotForHealth { var: var(name) });
    }
    assert_eq!(kind(&with("WordInputReg[1]")), Kind::HealthTwice { var: var("WordInputReg[1]") });
    let no_way = Kind::NoRoute { var: var("FloatInputReg[1]"), port: 0 };
    assert_eq!(kind(&with("FloatInputReg[1]")), no_way);
    let twice = port(&|port| {
        (port.health.alive, port.health.age) = (Some(var("WordInputReg[2]")), Some(var("WordInputReg[2]")));
    });
    assert_eq!(kind(&twice), Kind::HealthTwice { var: var("WordInputReg[2]") });
    let mut cell = with("WordInputReg[2]");
    sensor(&mut cell, "WordInputReg[2]");
    assert_eq!(kind(&cell), Kind::OwnedTwice { var: var("WordInputReg[2]"), other: 0 });
    assert_eq!(kind(&port(&|port| port.safe_at_start = true)), Kind::NoSafeValues);
    assert_eq!(kind(&port(&|port| port.refresh = Some(MS(1_000)))), Kind::OnlyChangesRefresh);
    assert_eq!(kind(&port(&|port| port.refresh = Some(MS(0)))), Kind::ZeroTime);
}
