//! Random inputs in any order: nothing panics, every call ends, and the invariants hold after each.

use proptest::prelude::*;
use proto_core::command::Action;
use proto_core::modbus::Exception;
use proto_core::wire::state::SafetyState;
use recipe_config::{Function, FunctionInput, FunctionOutput, ShownState};

use super::machine::SafetyHold;
use super::*;
use ScalarType::{Byte, Float};

#[derive(Debug, Clone)]
enum Step {
    Time(u64),
    Command(u8, Vec<u8>),
    Modbus(u8, Vec<u8>),
    Open(u8, u8),
    Close(u8, u8),
    PortBytes(u8, Vec<u8>),
    Frame(u8),
    Can(u16, Vec<u8>),
    Datagram(u16, Vec<u8>),
    Up(u8),
    Down(u8),
    Sent(u8),
    Knob(u8),
    Late(u64),
    Read(u8, u8, u8),
}

fn text() -> impl Strategy<Value = Vec<u8>> {
    let words: Vec<String> = Action::ALL
        .iter()
        .map(|action| action.word().to_owned())
        .chain(
            [
                "state",
                "isprogfinish",
                "getlasterror",
                "speed(50)",
                "run(a)",
                "run(b)",
                "run(c)",
                "run(d)",
                "run(x)",
                "(",
            ]
            .map(String::from),
        )
        .collect();
    prop_oneof![
        8 => proptest::sample::select(words).prop_map(|word| format!("{word}\n").into_bytes()),
        1 => proptest::collection::vec(any::<u8>(), 0..40),
    ]
}

fn step() -> impl Strategy<Value = Step> {
    let bytes = || proptest::collection::vec(prop_oneof![any::<u8>(), Just(0xFF), Just(0xEE)], 0..40);
    let adu = proptest::collection::vec(any::<u8>(), 0..12).prop_map(|mut pdu| {
        if let Some(function) = pdu.first_mut() {
            *function %= 18;
        }
        let mut adu = vec![0, 0, 0, 0, 0, pdu.len() as u8 + 1, 1];
        adu.append(&mut pdu);
        adu
    });
    prop_oneof![
        6 => (0..400_000_u64).prop_map(Step::Time),
        6 => (0..4_u8, text()).prop_map(|(conn, text)| Step::Command(conn, text)),
        3 => (0..4_u8, prop_oneof![adu, bytes()]).prop_map(|(conn, bytes)| Step::Modbus(conn, bytes)),
        2 => (0..3_u8, 0..4_u8).prop_map(|(kind, conn)| Step::Open(kind, conn)),
        1 => (0..3_u8, 0..4_u8).prop_map(|(kind, conn)| Step::Close(kind, conn)),
        3 => (0..7_u8, bytes()).prop_map(|(port, bytes)| Step::PortBytes(port, bytes)),
        3 => (0..7_u8).prop_map(Step::Frame),
        2 => (0..4_u16, proptest::collection::vec(any::<u8>(), 0..9)).prop_map(|(id, data)| Step::Can(id, data)),
        2 => (0..10_u16, bytes()).prop_map(|(peer, bytes)| Step::Datagram(peer, bytes)),
        1 => (0..7_u8).prop_map(Step::Up),
        1 => (0..7_u8).prop_map(Step::Down),
        3 => (0..7_u8).prop_map(Step::Sent),
        2 => any::<u8>().prop_map(Step::Knob),
    ]
}

fn everything() -> SimConfig {
    let realtime = stream_recipe(
        Mode::Realtime,
        system(&["DigitalOutputCommand[1..3]"]),
        system(&["RobotState[1..32]"]),
    );
    let own = stream_recipe(Mode::User, user(&[Byte, Float]), user(&[Float, Byte]));
    let on_can = can_recipe(Mode::User, vec![can(1, user(&[Byte; 3]))], vec![can(2, user(&[Byte; 3]))]);
    let port = |name: &str, bus, recipe| SimPort {
        name: name.to_owned(),
        bus,
        recipe: Some(recipe),
        cycle: Duration::from_millis(4),
    };
    let mut config = SimConfig {
        recipes: vec![realtime, own, on_can],
        ports: vec![
            port("line", rs485(), 1),
            port("can", SimBus::Can { bitrate: 500_000 }, 2),
            port("server", SimBus::UdpServer, 0),
            port("tcp", SimBus::TcpClient { to: String::new() }, 0),
            port("udp", SimBus::UdpClient { to: String::new() }, 0),
            port("system", rs485(), 0),
        ],
        ..SimConfig::default()
    };
    for (name, script) in [
        ("a", "loop { let x = comm_recv(\"line\"); comm_send(\"line\", [x[1], x[0]]); }"),
        (
            "b",
            "loop { movej([1, 0, 0, 0, 0, 0], 3); movej([0, 0, 0, 0, 0, 0], 3); comm_send(\"can\", [1, 2, 3]); }",
        ),
        ("c", "wait_ms(30); let x = comm_recv(\"can\"); set(\"DO[1]\", x[1] > 9); throw `${x}`;"),
    ] {
        config = with_program(config, name, script);
    }
    config = with_program(
        config,
        "d",
        "loop { let p = []; for n in 8..14 { p.push(get(`RobotState[${n}]`)); } p[2] += 0.05; \
         try { movel(p, 1.5); } catch { movej([0.3, -1.2, 1.9, 0.7, 1.5, -0.1], 3); } \
         if comm_recv(\"line\", 0.02).is_empty() { call(\"c\"); } }",
    );
    config.functions.start = Some("d".to_owned());
    for ((_, function), nth) in Function::ALL.into_iter().zip(1..) {
        config.functions.inputs.push(FunctionInput { item: target(&format!("FDI[{nth}]")), function });
    }
    for ((_, state), nth) in ShownState::ALL.into_iter().zip(1..) {
        config.functions.outputs.push(FunctionOutput { item: target(&format!("FDO[{nth}]")), state });
    }
    config
}

fn apply(cell: &mut TestController, step: Step) {
    act(cell, step);
    cell.drain();
}

fn act(cell: &mut TestController, step: Step) {
    let address = |nth: u8| Ipv4Addr::new(10, 0, 0, nth % 3).into();
    let conn = |kind: u8, nth: u8| ConnId(u64::from(kind) * 100 + u64::from(nth));
    let now = cell.now;
    match step {
        Step::Time(micros) => cell.run(Duration::from_micros(micros)),
        Step::Command(nth, bytes) => {
            cell.input(ControllerInput::CommandBytes { conn: conn(0, nth), bytes: &bytes });
        }
        Step::Modbus(nth, bytes) => {
            cell.input(ControllerInput::ModbusBytes { conn: conn(1, nth), bytes: &bytes });
        }
        Step::Open(kind, nth) => cell.input(match kind {
            0 => ControllerInput::CommandOpened { conn: conn(0, nth), from: address(nth) },
            1 => ControllerInput::ModbusOpened { conn: conn(1, nth), from: address(nth) },
            _ => ControllerInput::StateOpened { conn: conn(2, nth), from: address(nth) },
        }),
        Step::Close(kind, nth) => cell.input(match kind {
            0 => ControllerInput::CommandClosed { conn: conn(0, nth) },
            1 => ControllerInput::ModbusClosed { conn: conn(1, nth) },
            _ => ControllerInput::StateClosed { conn: conn(2, nth) },
        }),
        Step::PortBytes(port, bytes) => cell.port_bytes(port.into(), &bytes),
        Step::Frame(port) => {
            let frame = [0xFF, 0xFF, 7, 0, 0, 0x80, 0x3F, 0xEE, 0xEE];
            cell.port_bytes(port.into(), &frame);
        }
        Step::Can(id, data) => {
            let frame = CanFrame::new(CanId::Standard(id), &data).unwrap();
            cell.input(ControllerInput::PortCan { port: 1, frame });
        }
        Step::Datagram(nth, bytes) => {
            cell.input(ControllerInput::Udp2011 { peer: peer(nth), bytes: &bytes });
            if nth == 9 {
                cell.input(ControllerInput::Udp2011Unreachable { peer: peer(nth) });
            }
        }
        Step::Up(port) => cell.input(ControllerInput::PortUp { port: port.into() }),
        Step::Down(port) => cell.input(ControllerInput::PortDown { port: port.into() }),
        Step::Sent(port) => cell.input(ControllerInput::PortSent { port: port.into() }),
        Step::Knob(nth) => {
            let link = [Link::Command, Link::State, Link::Modbus][usize::from(nth) % 3];
            let c = &mut cell.controller;
            match nth % 25 {
                0 => c.mute(link),
                1 => c.unmute(link),
                2 => c.refuse(link),
                3 => c.accept(link),
                4 => c.disconnect(link),
                5 => c.delay_answers(link, Duration::from_millis(u64::from(nth))),
                6 => c.answer_modbus_with((nth > 100).then_some(Exception::DeviceBusy)),
                7 => c.cut_next_state_packet(usize::from(nth) * 10),
                8 => c.close_port(3),
                9 => c.restart(now),
                10 => c.emergency_stop(now),
                11 => c.protective_stop(now),
                12 => c.collide(now, nth),
                13 | 14 => c.clear_stop(now),
                15 => c.command_clients(match nth % 3 {
                    0 => CommandClients::Many,
                    1 => CommandClients::RefuseSecond,
                    _ => CommandClients::DropFirst,
                }),
                16 => c.delay_transitions(Duration::from_millis(u64::from(nth) * 30)),
                17 if nth > 128 => drop(c.corrupt("RobotState[8]", f32::NAN)),
                17 => drop(c.heal("RobotState[8]")),
                18 => c.restart_cleared(now),
                19 | 20 => {
                    let input = target(&format!("FDI[{}]", nth / 25 % 7 + 1));
                    c.force(input, 1.0).unwrap();
                    c.force(input, 0.0).unwrap();
                }
                21 if nth > 128 => c.release_safety(),
                21 => c.hold_safety(now, if nth > 60 { SafetyHold::Fail } else { SafetyHold::Config }),
                22 if nth > 128 => c.enter_reduced(now),
                22 => c.leave_reduced(now),
                23 => c.force_item("drive_error[3]", nth.into()).unwrap(),
                _ => {
                    let _ = c.assign_recipe(now, 5, (nth > 128).then_some(1));
                }
            }
        }
        // As a runtime that the system has not let run.
        Step::Late(micros) => cell.now += Duration::from_micros(micros),
        Step::Read(nth, address, count) => {
            let request = [0, 7, 0, 0, 0, 6, 1, 3, 0, address, 0, count];
            cell.input(ControllerInput::ModbusBytes { conn: conn(1, nth), bytes: &request });
        }
    }
}

/// Steps of a controller that is mostly read from.
fn calm_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        12 => (0..4_u8, prop_oneof![Just((0, 118)), (0..118_u8, 1..8_u8)])
            .prop_map(|(conn, (address, count))| Step::Read(conn, address, count)),
        3 => prop_oneof![0..2_000_u64, 0..200_000_u64].prop_map(Step::Late),
        1 => (0..5_u8).prop_map(|step| Step::Knob(step * 25 + 19)),
        1 => (0..4_u8, 0..4_u8).prop_map(|(conn, bit)| {
            Step::Modbus(conn, vec![0, 1, 0, 0, 0, 6, 1, 5, 0, 192 + bit, if bit < 2 { 0xFF } else { 0 }, 0])
        }),
        4 => step(),
    ]
}

/// All that can be seen of a controller.
fn seen(cell: &TestController) -> String {
    let controller = &cell.controller;
    let events: Vec<_> = controller.events_since(0).collect();
    let (registers, counters) = (controller.registers(), controller.counters());
    format!(
        "{:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {events:?} {counters:?}",
        cell.received,
        cell.closed,
        cell.sent,
        cell.packets,
        registers.image(),
        registers.arm(),
        registers.status(),
        controller.machine(),
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn nothing_that_happens_breaks_the_controller(steps in proptest::collection::vec(step(), 1..120)) {
        let config = everything();
        let outputs = config.functions.outputs.clone();
        let mut cell = robot(&config);
        cell.run_ms(1);
        for (kind, nth) in [(0, 0), (1, 0), (2, 0)] {
            apply(&mut cell, Step::Open(kind, nth));
        }
        for step in steps {
            apply(&mut cell, step);
            let machine = cell.controller.machine();
            let runs = machine.program() != proto_core::wire::state::ProgramState::Stopped;
            prop_assert_eq!(runs, cell.controller.program_name().is_some());
            let may_move = matches!(machine.safety(), SafetyState::Run | SafetyState::Reduce);
            prop_assert!(may_move || !machine.program_runs(), "{:?}", machine);
            for output in &outputs {
                // The controller does nothing any more after a shutdown.
                let shown = cell.controller.registers().value(output.item) == 1.0;
                prop_assert!(cell.shut_down || shown == machine.is_in(output.state), "{:?}", output);
            }
            let arm = cell.controller.registers().arm();
            prop_assert!(arm.position.iter().chain(&arm.pose).chain(&arm.torque).all(|item| item.is_finite()));
            cell.packets.clear();
            cell.sent.clear();
        }
    }

    #[test]
    fn a_controller_that_looks_only_if_it_must_is_as_one_that_always_does(
        steps in proptest::collection::vec(calm_step(), 1..160),
        is_calm in any::<bool>(),
    ) {
        let config = if is_calm { SimConfig::default() } else { everything() };
        let (mut cell, mut twin) = (robot(&config), robot(&config));
        twin.controller.quiet.forbid();
        for cell in [&mut cell, &mut twin] {
            cell.controller.record_events();
            cell.run_ms(1);
            for (kind, nth) in [(0, 0), (1, 0), (1, 1), (2, 0)] {
                apply(cell, Step::Open(kind, nth));
            }
        }
        for step in steps {
            // Knobs are turned between two calls as well.
            let is_knob = matches!(step, Step::Knob(_) | Step::Late(_));
            for cell in [&mut cell, &mut twin] {
                act(cell, step.clone());
            }
            if !is_knob {
                prop_assert_eq!(cell.drain(), twin.drain());
            }
            prop_assert_eq!(seen(&cell), seen(&twin));
            for cell in [&mut cell, &mut twin] {
                cell.packets.clear();
                cell.sent.clear();
                cell.received.clear();
            }
        }
    }
}
