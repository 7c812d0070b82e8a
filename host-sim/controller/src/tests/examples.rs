//! The specification's six worked examples against the controller's own ports, byte for byte
//! (proto-core/docs/wire/recipes.md section 8).

use super::*;
use ScalarType::Byte;

const POSE: [(&str, f64); 6] = [
    ("RobotState[8]", -0.543_689),
    ("RobotState[9]", 0.576_287),
    ("RobotState[10]", 1.232_353),
    ("RobotState[11]", -1.570_197),
    ("RobotState[12]", -0.607_912),
    ("RobotState[13]", -0.458_957),
];

/// The values above are rounded to six places; these are the exact ones of the capture.
fn captured_pose() -> SimConfig {
    let bytes = [
        0x39, 0x2F, 0x0B, 0xBF, 0x86, 0x87, 0x13, 0x3F, 0xBF, 0xBD, 0x9D, 0x3F, 0x37, 0xFC, 0xC8, 0xBF, 0x17,
        0xA0, 0x1B, 0xBF, 0x59, 0xFC, 0xEA, 0xBE,
    ];
    let mut config = SimConfig::default();
    for (nth, (name, rounded)) in POSE.iter().enumerate() {
        let exact = f32::from_le_bytes(bytes[4 * nth..4 * nth + 4].try_into().unwrap());
        assert!((f64::from(exact) - rounded).abs() < 1e-6);
        config = with_initial(config, &[(name, f64::from(exact))]);
    }
    config
}

#[test]
fn example_1_rs485_user_defined() {
    let recipe = stream_recipe(Mode::User, user(&[Byte; 3]), user(&[Byte; 3]));
    let script = r#"
        let list1 = comm_recv("p");
        comm_send("p", [125, 125, 125]);
        wait_ms(1000);
    "#;
    let mut cell = robot(&with_program(one_port(rs485(), recipe), "echo.jspf", script));
    let client = cell.command_client();
    assert_eq!(cell.ask(client, "run(echo.jspf)"), "run start");
    cell.run_ms(50);
    assert_eq!(cell.sent, []);

    cell.port_bytes(0, &[0xFF, 0xFF, 1, 2, 3, 0xEE, 0xEE]);
    cell.run_ms(5);
    assert_eq!(cell.controller.program_variables()["list1"], serde_json::json!([1, 2, 3]));
    assert_eq!(cell.sent.len(), 1);
    assert_eq!(cell.sent[0].2, Out::Bytes(vec![0xFF, 0xFF, 0x7D, 0x7D, 0x7D, 0xFE, 0xFE]));
}

#[test]
fn example_2_rs485_system() {
    let recipe =
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..11]"]));
    let config = SimConfig { initial: captured_pose().initial, ..one_port(rs485(), recipe) };
    let mut cell = robot(&config);
    cell.run_ms(40);
    assert_eq!(cell.sent.len(), 10, "one each 4 ms");
    let frame = [
        0xFF, 0xFF, 0x39, 0x2F, 0x0B, 0xBF, 0x86, 0x87, 0x13, 0x3F, 0xBF, 0xBD, 0x9D, 0x3F, 0x37, 0xFC, 0xC8,
        0xBF, 0xFE, 0xFE,
    ];
    for (nth, (at, _, out)) in cell.sent.iter().enumerate() {
        assert_eq!(*at, Instant::from_millis(1_004 + 4 * nth as u64), "on the grid");
        assert_eq!(*out, Out::Bytes(frame.to_vec()));
    }
    assert!(!cell.coil(192));
    cell.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
    assert!(cell.coil(192), "DO1 is on at once");
    assert!(!cell.coil(193));
    cell.port_bytes(0, &[0xFF, 0xFF, 0x00, 0xEE, 0xEE]);
    assert!(!cell.coil(192));
}

#[test]
fn example_3_can_user_defined() {
    let recipe = can_recipe(Mode::User, vec![can(1, user(&[Byte; 3]))], vec![can(2, user(&[Byte; 3]))]);
    let script = r#"let list1 = comm_recv("p"); comm_send("p", 2, [125, 125, 125]);"#;
    let bus = SimBus::Can { bitrate: 500_000 };
    let mut cell = robot(&with_program(one_port(bus, recipe), "echo.jspf", script));
    let client = cell.command_client();
    assert_eq!(cell.ask(client, "run(echo.jspf)"), "run start");
    let frame = CanFrame::new(CanId::Standard(1), &[1, 2, 3]).unwrap();
    cell.input(ControllerInput::PortCan { port: 0, frame });
    cell.run_ms(5);
    assert_eq!(cell.controller.program_variables()["list1"], serde_json::json!([1, 1, 2, 3]));
    let answer = CanFrame::new(CanId::Standard(2), &[0x7D, 0x7D, 0x7D]).unwrap();
    assert_eq!(cell.sent.iter().map(|sent| sent.2.clone()).collect::<Vec<_>>(), [Out::Can(answer)]);
    assert_eq!(cell.ask(client, "isprogfinish"), "1");
}

#[test]
fn example_4_can_system() {
    let output = [(2, "RobotState[8..9]"), (3, "RobotState[10..11]"), (4, "RobotState[12..13]")];
    let recipe = can_recipe(
        Mode::Realtime,
        vec![can(1, system(&["DigitalOutputCommand[1]"]))],
        output.iter().map(|(id, names)| can(*id, system(&[names]))).collect(),
    );
    let captured = [0xEF, 0x54, 0xEF, 0x3E, 0xA7, 0xE7, 0xD1, 0x3E];
    let float = |at: usize| f64::from(f32::from_le_bytes(captured[at..at + 4].try_into().unwrap()));
    assert!((float(0) - 0.467_445).abs() < 1e-6 && (float(4) - 0.409_970).abs() < 1e-6);
    let config = one_port(SimBus::Can { bitrate: 500_000 }, recipe);
    let config = with_initial(config, &[("RobotState[8]", float(0)), ("RobotState[9]", float(4))]);
    let mut cell = robot(&config);
    cell.run_ms(8);
    let ids: Vec<_> = cell
        .sent
        .iter()
        .map(|sent| match &sent.2 {
            Out::Can(frame) => (sent.0, frame.id()),
            other => panic!("{other:?}"),
        })
        .collect();
    let (first, second) = (Instant::from_millis(1_004), Instant::from_millis(1_008));
    let all: Vec<_> =
        [first, second].into_iter().flat_map(|at| [2, 3, 4].map(|id| (at, CanId::Standard(id)))).collect();
    assert_eq!(ids, all);
    assert_eq!(cell.sent[0].2, Out::Can(CanFrame::new(CanId::Standard(2), &captured).unwrap()));

    let frame = CanFrame::new(CanId::Standard(1), &[1]).unwrap();
    cell.input(ControllerInput::PortCan { port: 0, frame });
    assert!(cell.coil(192));
}

#[test]
fn example_5_udp_server() {
    let recipe =
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..13]"]));
    let config = SimConfig { initial: captured_pose().initial, ..one_port(SimBus::UdpServer, recipe) };
    let mut cell = robot(&config);
    cell.run_ms(20);
    assert_eq!(cell.sent, [], "nobody has asked yet");
    cell.input(ControllerInput::Udp2011 { peer: peer(5000), bytes: b"hello" });
    cell.run_ms(8);
    let frame = [
        0xFF, 0xFF, 0x39, 0x2F, 0x0B, 0xBF, 0x86, 0x87, 0x13, 0x3F, 0xBF, 0xBD, 0x9D, 0x3F, 0x37, 0xFC, 0xC8,
        0xBF, 0x17, 0xA0, 0x1B, 0xBF, 0x59, 0xFC, 0xEA, 0xBE, 0xFE, 0xFE,
    ];
    let sent: Vec<_> = cell.sent.iter().map(|sent| sent.2.clone()).collect();
    assert_eq!(sent, vec![Out::Datagram(peer(5000), frame.to_vec()); 2]);
    cell.input(ControllerInput::Udp2011 { peer: peer(5000), bytes: &[0xFF, 0xFF, 0x01, 0xEE, 0xEE] });
    assert!(cell.coil(192));
    assert_eq!(cell.counters("p").wrong_datagrams, 1, "hello");
}

#[test]
fn example_6_tcp_and_udp_client() {
    for bus in [
        SimBus::TcpClient { to: "127.0.0.1:50000".to_owned() },
        SimBus::UdpClient { to: "127.0.0.1:50000".to_owned() },
    ] {
        let recipe = stream_recipe(
            Mode::Realtime,
            system(&["DigitalOutputCommand[1]"]),
            system(&["RobotState[8..13]"]),
        );
        let config = SimConfig { initial: captured_pose().initial, ..one_port(bus, recipe) };
        let mut cell = robot(&config);
        cell.run_ms(12);
        assert_eq!(cell.sent.len(), 3);
        cell.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
        assert!(cell.coil(192));

        cell.input(ControllerInput::PortDown { port: 0 });
        cell.sent.clear();
        cell.run_ms(10);
        assert_eq!(cell.sent, [], "nothing is sent, and nothing is kept for later");
        cell.input(ControllerInput::PortUp { port: 0 });
        cell.run_ms(4);
        assert_eq!(cell.sent.len(), 1);
        assert_eq!(cell.sent[0].0.as_micros() % 4_000, 0, "the grid is the old one");
    }
}

#[test]
fn every_example_file_makes_a_controller_whose_programs_run() {
    let mut controllers = 0;
    for path in recipe_test_kit::examples() {
        if !path.to_string_lossy().ends_with("-controller.toml") {
            continue;
        }
        let config =
            recipe_config::file::load_controller(&path, &[]).unwrap_or_else(|error| panic!("{error}"));
        controllers += 1;
        for program in &config.programs {
            let mut cell = robot(&config);
            let c = cell.command_client();
            assert_eq!(cell.ask(c, &format!("run({})", program.name)), "run start", "{}", path.display());
            cell.run_ms(1_000);
            assert_eq!(cell.controller.machine().error(), None, "{}: {}", path.display(), program.name);
        }
    }
    assert!(controllers >= 8, "{controllers}");
}
