//! Programs that never wait: everything else keeps its timing.

use super::*;

/// The UDP server and a serial line, both with a cycle of 4 ms, and a program.
fn config(script: &str) -> SimConfig {
    let recipe =
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..11]"]));
    let mut config = one_port(SimBus::UdpServer, recipe);
    config.ports.push(SimPort { name: "line".to_owned(), bus: rs485(), ..config.ports[0].clone() });
    with_program(config, "t", script)
}

const SCRIPTS: [&str; 5] = [
    "while !get(\"DI[1]\") {}",
    "let n = 0; while n < 1 { if n == 0 { n += 0; } if get(\"DI[1]\") { n = 1; } }",
    "fn f(x) { x + 1 } let n = 0; loop { n = f(n) % 9; if n == 8 && get(\"DI[1]\") { break; } }",
    "let a = []; for i in 0..900 { a.push(i); } loop { let b = a.filter(|x| x > 5); if get(\"DI[1]\") { break; } }",
    "while !get(\"DI[1]\") { wait_ms(0); set(\"WordOutputReg[1]\", 1); }",
];

#[test]
fn servers_streams_and_ports_keep_their_time() {
    for script in SCRIPTS {
        let mut cell = robot(&config(script));
        let c = cell.command_client();
        let m = cell.modbus_client();
        cell.state_client();
        cell.input(ControllerInput::Udp2011 { peer: peer(1), bytes: &[] });
        let begin = cell.now;
        assert_eq!(cell.ask(c, "run(t)"), "run start", "{script}");
        for _ in 0..1_000 {
            cell.run_ms(1);
            assert_eq!(cell.ask(c, "isprogfinish"), "0", "{script}");
            assert_eq!(cell.modbus(m, &[3, 0, 2, 0, 1]), [3, 2, 0, 2], "{script}");
        }
        let after = |at: Instant| at.saturating_since(begin).as_micros();
        let on = |port: usize| cell.sent.iter().filter(move |sent| sent.1 == port).map(|sent| after(sent.0));
        let grid: Vec<u64> = (1..=250).map(|cycle| cycle * 4_000).collect();
        assert_eq!(on(usize::MAX).collect::<Vec<_>>(), grid, "{script}");
        assert_eq!(on(1).collect::<Vec<_>>(), grid, "{script}");
        let packets: Vec<_> = cell.packets.iter().map(|packet| after(packet.0)).collect();
        assert_eq!(packets, (1..=10).map(|nth| nth * 100_000).collect::<Vec<_>>(), "{script}");
        // And the program sees the input that it waits for.
        cell.controller.force(target("DI[1]"), 1.0).unwrap();
        cell.run_ms(100);
        assert_eq!(cell.ask(c, "isprogfinish"), "1", "{script}");
        assert_eq!(cell.controller.machine().error(), None, "{script}");
    }
}

#[test]
fn a_slice_is_a_millisecond_of_a_few_calls() {
    let count = "let n = 0; loop { n += 1; set(\"WordOutputReg[1]\", n); }";
    let mut cell = robot(&config(count));
    let c = cell.command_client();
    cell.ask(c, "run(t)");
    let in_a_slice = cell.value("WordOutputReg[1]");
    assert!((5.0..=10.0).contains(&in_a_slice), "{in_a_slice}");
    for slice in 2..=100_u32 {
        cell.run(Duration::from_micros(999));
        let before = cell.value("WordOutputReg[1]");
        cell.run(Duration::from_micros(1));
        let done = cell.value("WordOutputReg[1]") - before;
        assert!((5.0..=10.0).contains(&done), "{done} in slice {slice}");
    }
    // A pause prevents the next slice; a stop ends the program at once.
    assert_eq!(cell.order(c, "pause"), "pause success");
    let held = cell.value("WordOutputReg[1]");
    cell.run_ms(1_000);
    assert_eq!(cell.value("WordOutputReg[1]"), held);
    assert_eq!(cell.ask(c, "resume"), "resume success");
    cell.run_ms(2);
    assert!(cell.value("WordOutputReg[1]") > held);
    assert_eq!(cell.order(c, "stop"), "stop success");
    assert_eq!(cell.controller.program_name(), None);
}

#[test]
fn a_busy_program_is_the_same_however_often_the_model_is_called() {
    let script = r#"
        let n = 0;
        loop {
            n += 1;
            if n % 7 == 0 { set("WordOutputReg[1]", n % 60000); }
            if n % 1000 == 0 { comm_send("line", [n % 256]); }
            if get("DI[1]") { log(n); wait_ms(0.3); }
        }
    "#;
    let run = |ticks: bool| {
        let mut config = config(script);
        let parts = SimParts::Stream { input: None, output: part(&[255], &[254], user(&[ScalarType::Byte])) };
        config.recipes.push(SimRecipe { name: "own".to_owned(), mode: Mode::User, parts });
        config.ports[1].recipe = Some(1);
        let mut cell = robot(&config);
        let c = cell.command_client();
        cell.ask(c, "run(t)");
        for step in 0..1_500_u32 {
            if step == 700 {
                cell.controller.force(target("DI[1]"), 1.0).unwrap();
            }
            if ticks {
                cell.run(Duration::from_micros(300));
                cell.input(ControllerInput::Tick);
                cell.run(Duration::from_micros(700));
            } else {
                cell.run_ms(1);
            }
        }
        let sent: Vec<_> = cell.sent.iter().filter(|sent| sent.1 == 1).cloned().collect();
        assert!(sent.len() > 3, "{sent:?}");
        let log: Vec<_> = cell.controller.program_log().map(str::to_owned).collect();
        (sent, log, cell.controller.program_variables())
    };
    assert_eq!(run(false), run(true));
    assert_eq!(run(false), run(false));
}
