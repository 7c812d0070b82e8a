//! What a gateway says of itself: status, latency and tap (docs/engine.md section 10).

mod rig;

use proto_core::config::{Bus, CommandWhen, InputBinding, Parts};
use proto_core::engine::{
    BusState, Engine, FieldBus, Input, LinkId, MAX_TAPPED, OUTPUT_BUFFER, Output, PortState, Rejection,
    ReplyCode, Status, TapDirection, TapPlace, TapVerdict,
};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};
use proto_core::wire::state::{LEN, OperationMode, RobotState, StatePacket};

use rig::{Cell, MS, Rig, user_in, var};

/// The specification's frame around a byte of outputs.
fn outputs(value: u8) -> [u8; 5] {
    [255, 255, value, 238, 238]
}

/// A line that commands outputs, and a panel on CAN.
fn configuration() -> Cell {
    let mut cell = Cell::new();
    let line = cell.stream(&["DigitalOutputCommand[1]"], &["DigitalSignalStatus[4]", "RobotState[8]"]);
    let bus = cell.can(&[(5, &["WordInputReg[1]"])], &[]);
    cell.rs485(line);
    cell.can_port(bus);
    cell
}

fn cell() -> Rig {
    configuration().rig()
}

fn state_packet(change: impl FnOnce(&mut StatePacket)) -> [u8; LEN] {
    let mut packet = StatePacket::parse(&[0; LEN]).unwrap();
    change(&mut packet);
    packet.to_bytes()
}

/// The oldest Modbus request that has no answer is answered.
fn answer(rig: &mut Rig) {
    let request = rig.sent_on(LinkId::MODBUS);
    let answer = rig.answer(&request[0]);
    rig.link_bytes(LinkId::MODBUS, &answer);
}

fn port<'a>(status: &Status<'a>, name: &str) -> proto_core::engine::PortStatus<'a> {
    status.ports().find(|port| port.name == name).unwrap()
}

#[test]
fn ports_have_names_states_and_ages() {
    let mut rig = cell();
    let status = rig.engine.status(rig.now);
    let line = port(&status, "port0");
    assert_eq!((line.state, line.age, line.overdue), (PortState::Silent, None, 1));
    assert_eq!((line.recipe, line.bus), (0, FieldBus::Rs485));

    rig.bytes(line.id, &outputs(3));
    rig.run(MS(30));
    let status = rig.engine.status(rig.now);
    let line = port(&status, "port0");
    assert_eq!((line.state, line.age, line.overdue), (PortState::Working, Some(MS(30)), 0));
    assert_eq!(line.counters.frames_in, 1);
    let panel = port(&status, "port1");
    assert_eq!((panel.state, panel.age), (PortState::Silent, None));
    assert_eq!(panel.bus, FieldBus::Can { state: BusState::Active });
}

#[test]
fn known_variables_have_value_age_and_owner_and_others_are_absent() {
    let mut rig = cell();
    rig.can(proto_core::engine::PortId(1), 5, &[0x34, 0x12]);
    rig.run(MS(7));
    let status = rig.engine.status(rig.now);
    let known: Vec<_> = status.variables().filter(|known| known.owner.is_some()).collect();
    let [word] = known[..] else { panic!("{known:?}") };
    assert_eq!((word.var, word.value), (var("WordInputReg[1]"), Scalar::Word(0x1234)));
    assert_eq!((word.age, word.owner), (MS(7), Some("port1")));
}

#[test]
fn the_newest_rejection_is_kept_with_its_bytes() {
    let mut rig = cell();
    let line = proto_core::engine::PortId(0);
    let rejection = |rig: &Rig, name: &str| {
        let status = rig.engine.status(rig.now);
        port(&status, name).last_rejection.copied()
    };
    assert_eq!(rejection(&rig, "port0"), None);

    // A swapped head, in two chunks: one rejection, from its first byte on.
    let first = rig.now;
    rig.bytes(line, &[0xEE, 0xAA, 0x48]);
    rig.run(MS(2));
    rig.bytes(line, &[0x01, 0x02]);
    let seen = rejection(&rig, "port0").unwrap();
    assert_eq!((seen.why, seen.at, seen.len), (Rejection::NoFrame, first, 5));
    assert_eq!(seen.bytes(), [0xEE, 0xAA, 0x48, 0x01, 0x02]);

    // Silence ends half a frame.
    rig.run(MS(100));
    rig.bytes(line, &[255, 255, 9]);
    rig.run(MS(100));
    let seen = rejection(&rig, "port0").unwrap();
    assert_eq!((seen.why, seen.bytes()), (Rejection::Partial, &[255, 255, 9][..]));

    // After silence, another rejection begins.
    rig.bytes(line, &[7; 40]);
    let seen = rejection(&rig, "port0").unwrap();
    assert_eq!((seen.why, seen.len, seen.bytes()), (Rejection::NoFrame, 40, &[7; 32][..]));

    rig.can(proto_core::engine::PortId(1), 6, &[1, 2]);
    let seen = rejection(&rig, "port1").unwrap();
    assert_eq!((seen.why, seen.can_id), (Rejection::ForeignId, Some(CanId::Standard(6))));
    rig.can(proto_core::engine::PortId(1), 5, &[1, 2, 3]);
    let seen = rejection(&rig, "port1").unwrap();
    assert_eq!((seen.why, seen.bytes()), (Rejection::WrongLength, &[1, 2, 3][..]));
    // A good frame takes nothing of that away.
    rig.can(proto_core::engine::PortId(1), 5, &[1, 2]);
    assert_eq!(rejection(&rig, "port1").unwrap(), seen);
}

#[test]
fn a_foreign_id_is_kept_as_long_as_it_may_be_the_one_that_was_meant() {
    let mut rig = cell();
    let port = proto_core::engine::PortId(1);
    let rejection = |rig: &Rig| {
        let status = rig.engine.status(rig.now);
        status.ports().find(|port| port.name == "port1").unwrap().last_rejection.copied()
    };
    let id = |rig: &Rig| rejection(rig).and_then(|last| last.can_id);
    for nth in 6..20 {
        rig.run(MS(100));
        rig.can(port, nth, &[nth as u8, 2]);
        let seen = rejection(&rig).unwrap();
        assert_eq!((seen.can_id, seen.at), (Some(CanId::Standard(nth)), rig.now), "the newest");
        assert_eq!((seen.why, seen.bytes()), (Rejection::ForeignId, &[nth as u8, 2][..]));
    }
    assert_eq!(rig.counters(port).rejected_id, 14);
    // Not each of a busy bus.
    rig.run(MS(99));
    rig.can(port, 20, &[1, 2]);
    assert_eq!(id(&rig), Some(CanId::Standard(19)));
    // The recipe's id comes, so the others are those of other nodes.
    rig.can(port, 5, &[1, 2]);
    rig.can(port, 30, &[1, 2]);
    assert_eq!(id(&rig), Some(CanId::Standard(19)));
    assert_eq!(rig.counters(port).rejected_id, 16, "it is counted");
}

#[test]
fn a_foreign_id_displaces_nothing_else() {
    let mut rig = cell();
    let port = proto_core::engine::PortId(1);
    rig.can(port, 5, &[1, 2, 3]);
    rig.can(port, 30, &[1, 2]);
    let status = rig.engine.status(rig.now);
    let last = status.ports().find(|port| port.name == "port1").unwrap().last_rejection.copied();
    assert_eq!(last.map(|last| last.why), Some(Rejection::WrongLength));
}

#[test]
fn the_controller_says_its_mode_and_states_when_it_has_a_state_link() {
    let mut rig = cell();
    let status = rig.engine.status(rig.now);
    assert_eq!(status.controller(), None, "before the first packet");
    rig.run(MS(10));
    rig.link_bytes(
        LinkId::STATE,
        &state_packet(|packet| {
            packet.operation_mode = 0;
            packet.robot_state = 6;
        }),
    );
    rig.run(MS(20));
    let status = rig.engine.status(rig.now);
    let controller = status.controller().unwrap();
    assert_eq!(controller.states.mode, OperationMode::Manual);
    assert_eq!(controller.states.robot, RobotState::Enable);
    assert_eq!(controller.age, MS(20));
}

#[test]
fn the_newest_command_of_a_port_is_told_with_its_outcome() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf)"), (2, "resume")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Frame };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255], &[254], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    let panel = cell.rs485(recipe);
    let mut rig = cell.rig();
    let newest_command = |rig: &Rig| {
        let status = rig.engine.status(rig.now);
        let panel = port(&status, "port0");
        (panel.command.map(|command| command.to_string()), panel.reply)
    };
    assert_eq!(newest_command(&rig), (None, ReplyCode::None));
    rig.run(MS(10));
    rig.bytes(panel, &[255, 1, 254]);
    assert_eq!(newest_command(&rig), (Some("run(pick.jspf)".into()), ReplyCode::Pending));
    rig.link_bytes(LinkId::COMMAND, b"run fail\r\n");
    assert_eq!(newest_command(&rig), (Some("run(pick.jspf)".into()), ReplyCode::Fail));
    rig.bytes(panel, &[255, 2, 254]);
    assert_eq!(newest_command(&rig).0.as_deref(), Some("resume"));
}

#[test]
fn a_command_that_failed_is_told_with_the_controllers_states_at_that_moment() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf)"), (2, "resume")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Frame };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255], &[254], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    let panel = cell.rs485(recipe);
    // A second port shows a value of the state stream, so that there is a state link.
    let shown = cell.stream(&[], &["RobotState[8]"]);
    cell.rs485(shown);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let manual = state_packet(|packet| packet.robot_state = 4);
    rig.link_bytes(LinkId::STATE, &manual);
    rig.run(MS(30));
    rig.bytes(panel, &[255, 1, 254]);
    assert!(port(&rig.engine.status(rig.now), "port0").last_failed.is_none());
    rig.link_bytes(LinkId::COMMAND, b"run fail\r\n");
    // What comes later says nothing about it, nor does what succeeds.
    rig.link_bytes(LinkId::STATE, &state_packet(|packet| packet.operation_mode = 2));
    rig.bytes(panel, &[255, 2, 254]);
    rig.link_bytes(LinkId::COMMAND, b"resume success\r\n");
    let status = rig.engine.status(rig.now);
    assert_eq!(port(&status, "port0").reply, ReplyCode::Success);
    let failed = port(&status, "port0").last_failed.unwrap();
    assert_eq!(failed.command.to_string(), "run(pick.jspf)");
    let controller = failed.controller.unwrap();
    assert_eq!(controller.states.mode, OperationMode::Manual);
    assert_eq!(controller.states.robot, RobotState::PowerOff);
    assert_eq!(controller.age, MS(30));
}

#[test]
fn links_of_listening_ports_have_the_ports_name() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["ForceEnd[1..6]"], &[]);
    cell.rs485(recipe);
    let up = cell.stream(&["ForceEnd[1..6]"], &[]);
    cell.port(Bus::TcpListen { listen: "0.0.0.0:50000".try_into().unwrap() }, up);
    let rig = cell.rig();
    let status = rig.engine.status(rig.now);
    let names: Vec<_> = status.links().map(|link| link.name).collect();
    assert!(names.contains(&"port1"), "{names:?}");
}

#[test]
fn latency_runs_from_the_frame_to_the_request_and_to_its_answer() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let line = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    let before = *rig.engine.latency();
    rig.bytes(line, &outputs(1));
    let handed = rig.engine.latency().handed_over;
    assert_eq!(handed.count(), before.handed_over.count() + 1);
    assert_eq!(handed.max(), Duration::ZERO, "the engine hands it over within the call");

    // A second value has to wait for the answer to the first.
    rig.now += MS(1);
    rig.bytes(line, &outputs(2));
    rig.now += MS(6);
    answer(&mut rig);
    let latency = *rig.engine.latency();
    assert_eq!(latency.handed_over.max(), MS(6));
    assert_eq!(latency.arrived.max(), MS(7), "the answer to the first");
    assert_eq!(latency.modbus.max(), MS(7));
    rig.now += MS(2);
    answer(&mut rig);
    assert_eq!(rig.engine.latency().arrived.max(), MS(8), "received 8 ms before its answer");
}

#[test]
fn lateness_is_measured_from_the_cycle_to_the_hand_over() {
    let mut rig = cell();
    rig.run(MS(50));
    rig.link_bytes(LinkId::STATE, &state_packet(|_| ()));
    rig.run(MS(50));
    let before = rig.engine.latency().lateness;
    assert!(before.count() > 5 && before.max() == Duration::ZERO, "{before:?}");
    // The driver comes 3 ms late.
    rig.now = rig.wake + MS(3);
    rig.input(Input::Tick);
    assert_eq!(rig.engine.latency().lateness.max(), MS(3));
}

#[test]
fn whoever_taps_sees_frames_requests_and_rejections_in_order() {
    let cell = configuration();
    let mut engine = Box::new(Engine::<8, 4, 512, 8192>::idle());
    engine.configure(&cell.0).unwrap();
    let now = Instant::from_millis(5_000);
    let mut buf = [0; OUTPUT_BUFFER];
    let mut pass = |engine: &mut Engine<8, 4, 512, 8192>, input: Input<'_>| {
        engine.handle(now, input);
        while !matches!(engine.poll_output(now, &mut buf), Output::Sleep { .. }) {}
    };
    let (line, bus) = (proto_core::engine::PortId(0), proto_core::engine::PortId(1));
    pass(&mut engine, Input::PortUp { port: line });
    pass(&mut engine, Input::PortUp { port: bus });
    pass(&mut engine, Input::Tick);
    pass(&mut engine, Input::LinkUp { link: LinkId::MODBUS });
    pass(&mut engine, Input::LinkSent { link: LinkId::MODBUS });
    // The tap has no listener yet.
    pass(&mut engine, Input::PortBytes { port: line, bytes: &outputs(9) });
    engine.tap().listen(true);
    let can = CanFrame::new(CanId::Standard(6), &[1]).unwrap();
    pass(&mut engine, Input::PortCan { port: bus, frame: can });
    pass(&mut engine, Input::PortBytes { port: line, bytes: &outputs(1) });
    pass(&mut engine, Input::PortBytes { port: line, bytes: &[1, 2] });
    pass(&mut engine, Input::LinkBytes { link: LinkId::MODBUS, bytes: &[0, 1] });

    let mut room = [0; MAX_TAPPED];
    let mut seen = Vec::new();
    while let Some(record) = engine.tap().next(&mut room) {
        assert_eq!((record.at, record.lost), (now, 0));
        let id = record.can_id;
        seen.push((record.place, record.direction, record.verdict, id, record.bytes.to_vec()));
    }
    let (to, from) = (TapDirection::In, TapDirection::Out);
    let rejected = TapVerdict::Rejected;
    let expected = [
        (TapPlace::Port(bus), to, rejected(Rejection::ForeignId), Some(CanId::Standard(6)), vec![1]),
        (TapPlace::Port(line), to, TapVerdict::Taken, None, outputs(1).to_vec()),
        (TapPlace::Port(line), to, rejected(Rejection::NoFrame), None, vec![1, 2]),
        (TapPlace::Link(LinkId::MODBUS), to, TapVerdict::Link, None, vec![0, 1]),
    ];
    assert_eq!(seen, expected);
    assert!(seen.iter().all(|(_, way, ..)| *way != from), "the first request is unanswered");
}
