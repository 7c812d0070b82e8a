//! Programs inside the controller: time, motion, ports, errors, determinism.

use super::*;
use ScalarType::{Byte, Float, Word};

fn runs(config: SimConfig, script: &str) -> (TestController, ConnId) {
    let mut cell = robot(&with_program(config, "t", script));
    let c = cell.command_client();
    assert_eq!(cell.ask(c, "run(t)"), "run start");
    (cell, c)
}

fn user_port() -> SimConfig {
    one_port(rs485(), stream_recipe(Mode::User, user(&[Byte, Word]), user(&[Float, Byte])))
}

fn frame(values: [u8; 3]) -> Vec<u8> {
    [&[0xFF, 0xFF], &values[..], &[0xEE, 0xEE]].concat()
}

#[test]
fn waits_last_exactly_as_long_as_asked() {
    let (mut cell, c) =
        runs(SimConfig::default(), "for n in 0..1000 { wait_ms(3.5); set(\"WordOutputReg[1]\", n); }");
    cell.run(Duration::from_micros(3_500 * 500 - 1));
    assert_eq!(cell.value("WordOutputReg[1]"), 498.0);
    cell.run(Duration::from_micros(1));
    assert_eq!(cell.value("WordOutputReg[1]"), 499.0);
    cell.run(Duration::from_micros(3_500 * 500 - 1));
    assert_eq!(cell.ask(c, "isprogfinish"), "0");
    cell.run(Duration::from_micros(1));
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
}

#[test]
fn registers_and_io_are_read_and_outputs_written() {
    let config =
        with_initial(SimConfig::default(), &[("DI[3]", 1.0), ("FloatInputReg[2]", 0.5), ("AI_V[1]", 2.5)]);
    let script = r#"
        set("BitOutputReg[1]", 129);
        set("FloatOutputReg[32]", get("FloatInputReg[2]") + 1);
        set("DO[16]", get("DI[3]"));
        set("ToolDO[2]", true);
        set("FDO[1]", true);
        set("WordOutputReg[2]", get("AI_V[1]") * 1000);
        let shown = [get("__WordOutputReg_2"), get("DigitalSignalStatus[5]"), get("RobotState[1]")];
        for name in ["WordInputReg[1]", "DI[1]", "RobotState[1]", "ForceEnd[1]", "AI_C[1]"] {
            try { set(name, 1); log("written " + name); } catch (e) { log(e); }
        }
        for name in ["DI[17]", "Nothing[1]", "DO"] {
            try { get(name); log("read " + name); } catch (e) { log(e); }
        }
        try { set("WordOutputReg[1]", 65536) } catch (e) { log(e); }
        try { set("DO[1]", 2) } catch (e) { log(e); }
        try { set("ToolDO[1]", "x") } catch (e) { log(e); }
    "#;
    let (mut cell, _) = runs(config, script);
    cell.run_ms(10);
    assert_eq!(cell.controller.machine().error(), None);
    assert_eq!(cell.value("BitOutputReg[1]"), 129.0);
    assert_eq!(cell.value("FloatOutputReg[32]"), 1.5);
    assert_eq!((cell.value("DO[16]"), cell.value("ToolDO[2]"), cell.value("FDO[1]")), (1.0, 1.0, 1.0));
    assert_eq!(cell.controller.program_variables()["shown"], serde_json::json!([2_500, 128, 0.0]));
    let log: Vec<_> = cell.controller.program_log().collect();
    assert_eq!(log[0], "a program cannot write WordInputReg[1]");
    assert_eq!(log[1], "a program cannot write DI[1]");
    assert_eq!(log[5], "DI[17]: there is only DI[1..16]");
    assert!(log[6].starts_with("Nothing[1]: no such system variable"), "{}", log[6]);
    assert_eq!(log[8], "WordOutputReg[1] cannot be 65536");
    assert_eq!(log[9], "DO[1] cannot be 2");
    assert!(log.iter().all(|line| !line.starts_with("written") && !line.starts_with("read")), "{log:?}");
    assert_eq!(log.len(), 11);
}

#[test]
fn single_bits_of_variables_are_read_and_written() {
    let config = with_initial(
        SimConfig::default(),
        &[("BitInputReg[3].4", 1.0), ("BitOutputReg[2]", 129.0), ("DigitalOutputCommand[1].3", 1.0)],
    );
    let script = r#"
        let shown = [get("BitInputReg[3].4"), get("__BitInputReg_3.5"), get("BitInputReg[3]")];
        set("BitOutputReg[2].0", false);
        set("BitOutputReg[2].6", 1);
        set("DigitalOutputCommand[1].7", get("BitInputReg[3].4"));
        for name in ["BitInputReg[3].4", "BitOutputReg[2].8", "WordOutputReg[1].0"] {
            try { set(name, 1); log("written " + name); } catch (e) { log(e); }
        }
        try { set("BitOutputReg[2].1", 2) } catch (e) { log(e); }
    "#;
    let (mut cell, _) = runs(config, script);
    cell.run_ms(10);
    assert_eq!(cell.controller.machine().error(), None);
    assert_eq!(cell.controller.program_variables()["shown"], serde_json::json!([true, false, 16]));
    assert_eq!(cell.value("BitOutputReg[2]"), f64::from(0b1100_0000), "the other bits stay");
    assert_eq!(cell.value("DigitalOutputCommand[1]"), f64::from(0b1000_1000));
    assert_eq!([cell.value("DO[4]"), cell.value("DO[8]")], [1.0, 1.0]);
    assert_eq!(cell.value("BitOutputReg[2].6"), 1.0);
    let log: Vec<_> = cell.controller.program_log().collect();
    assert_eq!(
        log,
        [
            "a program cannot write BitInputReg[3].4",
            "BitOutputReg[2].8: BitOutputReg[2] has no bit 8; allowed: 0..=7",
            "WordOutputReg[1].0: WordOutputReg[1] is a word without bits",
            "BitOutputReg[2].1 cannot be 2",
        ]
    );
}

#[test]
fn speed_scales_motion_and_pause_holds_it() {
    let script = "movej([1.0, 0, 0, 0, 0, 0], 1.0);";
    let config = || with_initial(SimConfig::default(), &[("RobotState[1]", 0.0)]);
    let duration = |steps: &[(u64, &str)]| {
        let (mut cell, c) = runs(config(), script);
        let begin = cell.now;
        for (at, command) in steps {
            let at = begin + Duration::from_millis(*at);
            cell.run(at.saturating_since(cell.now));
            let reply = cell.order(c, command);
            assert!(reply.ends_with("success"), "{command}: {reply}");
        }
        while cell.ask(c, "isprogfinish") == "0" {
            cell.run_ms(1);
            assert!(cell.now < begin + Duration::from_secs(60), "it never ends");
        }
        cell.now.saturating_since(begin).as_millis()
    };
    // From HOME, joint 3 has the longest way.
    let whole = duration(&[]);
    assert!((2_900..3_000).contains(&whole), "{whole}");
    let slow = duration(&[(0, "speed(50)")]);
    assert!(slow.abs_diff(2 * whole) <= 50, "the ramp from 100 to 50 per cent takes 50 ms: {slow}");
    let paused = duration(&[(1_000, "pause"), (6_000, "resume")]);
    assert!(paused.abs_diff(whole + 5_000) <= 2, "{paused}");

    let (mut cell, c) = runs(config(), script);
    cell.run_ms(1_000);
    assert_eq!(cell.order(c, "pause"), "pause success");
    assert_eq!(cell.ask(c, "state"), "6:3:5:2");
    let held = cell.value("RobotState[1]");
    assert_eq!(cell.ask(c, "speed(10)"), "set success");
    cell.run_ms(5_000);
    assert_eq!(cell.value("RobotState[1]"), held);
    assert!(held > 0.05 && held < 0.5, "{held}");
    assert_eq!(cell.order(c, "stop"), "stop success");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");
    assert_eq!(cell.value("RobotState[1]"), held);
}

#[test]
fn reduced_speed_and_an_emergency_stop_reach_the_arm() {
    let (mut cell, c) = runs(SimConfig::default(), "movej([1.0, 0, 0, 0, 0, 0], 1.0);");
    cell.run_ms(1_000);
    let velocity = |cell: &TestController| cell.controller.registers().arm().velocity[2];
    let before = velocity(&cell);
    cell.controller.enter_reduced(cell.now);
    cell.run_ms(100);
    assert!(velocity(&cell) < 0.35 * before, "{} {before}", velocity(&cell));
    assert_eq!(cell.ask(c, "state"), "6:2:12:2");
    cell.controller.leave_reduced(cell.now);
    cell.run_ms(100);
    assert!(velocity(&cell) > 0.9 * before);
    cell.controller.emergency_stop(cell.now);
    cell.run_ms(25);
    assert_eq!(velocity(&cell), 0.0);
    cell.run_ms(100);
    assert_eq!(cell.ask(c, "state"), "5:0:9:2");
}

#[test]
fn a_pause_stretches_waits_too() {
    let (mut cell, c) = runs(SimConfig::default(), "wait_ms(100);");
    cell.run_ms(60);
    cell.ask(c, "pause");
    cell.run_ms(1_000);
    cell.ask(c, "resume");
    cell.run_ms(39);
    assert_eq!(cell.ask(c, "isprogfinish"), "0");
    cell.run_ms(1);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
}

#[test]
fn frames_wait_for_the_program_and_only_for_it() {
    let config =
        with_program(user_port(), "t", "let a = comm_recv(\"p\"); wait_ms(50); let b = comm_recv(\"p\");");
    let mut cell = robot(&config);
    cell.port_bytes(0, &frame([9, 9, 9]));
    assert_eq!(cell.counters("p").frames_without_program, 1);
    let c = cell.command_client();
    cell.ask(c, "run(t)");
    cell.port_bytes(0, &[frame([1, 2, 0]), frame([3, 4, 1])].concat());
    cell.run_ms(100);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    let variables = cell.controller.program_variables();
    assert_eq!(variables["a"], serde_json::json!([1, 2]), "not the one from before its start");
    assert_eq!(variables["b"], serde_json::json!([3, 260]));

    cell.ask(c, "run(t)");
    for nth in 0..70 {
        cell.port_bytes(0, &frame([nth, 0, 0]));
    }
    cell.run_ms(100);
    let variables = cell.controller.program_variables();
    assert_eq!((&variables["a"], &variables["b"]), (&serde_json::json!([0, 0]), &serde_json::json!([6, 0])));
    assert_eq!(cell.counters("p").inbox_overflows, 5, "69 frames for 64 places");
}

#[test]
fn sends_wait_for_the_line_and_report_errors() {
    let script = r#"
        for n in 0..3 { comm_send("p", [0.5, n]); }
        let errors = [];
        for values in [[1], [1, 2, 3], [1, 256], [1, 0.5], [1e300, 1]] {
            try { comm_send("p", values); } catch (e) { errors.push(e); }
        }
        try { comm_send("p", 1, [1, 2]); } catch (e) { errors.push(e); }
        try { comm_send("q", [1, 2]); } catch (e) { errors.push(e); }
    "#;
    let (mut cell, c) = runs(user_port(), script);
    cell.run_ms(10);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    let times: Vec<_> = cell.sent.iter().map(|sent| sent.0.as_micros() - 1_000_000).collect();
    assert_eq!(times, [0, 700, 1_400], "one after the other");
    assert_eq!(cell.sent[2].2, Out::Bytes(vec![0xFF, 0xFF, 0, 0, 0, 0x3F, 2, 0xFE, 0xFE]));
    let errors = cell.controller.program_variables()["errors"].to_string();
    for text in [
        "p: the frame has 2 fields, 1 values were given",
        "p: the frame has 2 fields, 3 values were given",
        "p: 256 does not fit in a byte (0..=255)",
        "p: 0.5 is not an integer, but a byte must be",
        "does not fit in a float",
        "p carries a stream recipe: comm_send takes no frame id",
        "there is no port q; there are p",
    ] {
        assert!(errors.contains(text), "{text}: {errors}");
    }
}

/// D28: true when the frame was sent, false when the port is not ready.
#[test]
fn a_send_says_whether_the_port_was_ready() {
    let script = r#"
        let sent = [comm_send("p", [0, 1])];
        sent.push(comm_send("p", [0, 2]));
        sent.push(comm_send("p", [0, 3]));
        for values in [[1], [1, 256]] {
            try { comm_send("p", values); } catch (e) { sent.push(e); }
        }
        comm_recv("p");
        sent.push(comm_send("p", [0, 4]));
        comm_recv("p");
    "#;
    let (mut cell, _) = runs(user_port(), script);
    let sent = |cell: &TestController| cell.controller.program_variables()["sent"].clone();
    cell.run(Duration::from_micros(800));
    cell.input(ControllerInput::PortDown { port: 0 });
    let wrong = ["p: the frame has 2 fields, 1 values were given", "p: 256 does not fit in a byte (0..=255)"];
    assert_eq!(
        sent(&cell),
        serde_json::json!([true, false, false, wrong[0], wrong[1]]),
        "the second is lost on the line; a wrong frame is an error, ready or not"
    );
    cell.input(ControllerInput::PortUp { port: 0 });
    cell.port_bytes(0, &frame([0, 0, 0]));
    cell.run_ms(5);
    assert_eq!(sent(&cell)[5], true);
    assert_eq!(cell.sent.len(), 3);
    assert_eq!(cell.controller.machine().error(), None);
}

#[test]
fn errors_stop_the_program_and_are_reported_everywhere() {
    let (mut cell, c) = runs(SimConfig::default(), "wait_ms(10);\nlet x = [1];\nlet y = x[5];");
    cell.state_client();
    cell.run_ms(100);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    let error = cell.ask(c, "getlasterror");
    assert!(error.starts_with("1002:t: ") && error.contains("line 3") && error.ends_with('\n'), "{error}");
    assert_eq!(cell.packets[0].1.error_code, 0x1002);
    assert_eq!(cell.controller.counters().programs_failed, 1);
    let (mut cell, c) = runs(SimConfig::default(), "comm_recv(\"nowhere\");");
    assert!(cell.ask(c, "getlasterror").contains("there is no port nowhere"));
    let (mut cell, c) = runs(SimConfig::default(), "movej([9, 0, 0, 0, 0, 0], 1);");
    assert!(cell.ask(c, "getlasterror").contains("joint 1: 9 rad is outside"));
}

#[test]
fn stop_ends_a_program_wherever_it_is() {
    for script in [
        "comm_recv(\"p\");",
        "wait_ms(100000);",
        "movej([1, 0, 0, 0, 0, 0], 0.1);",
        "loop { try { comm_recv(\"p\"); } catch { log(\"caught\"); } }",
    ] {
        let (mut cell, c) = runs(user_port(), script);
        cell.run_ms(500);
        assert_eq!(cell.order(c, "stop"), "stop success", "{script}");
        assert_eq!(cell.ask(c, "state"), "6:0:5:2", "{script}");
        assert_eq!(cell.controller.program_name(), None);
        assert_eq!(cell.controller.machine().error(), None);
        assert_eq!(cell.controller.program_log().count(), 0);
        assert_eq!(cell.ask(c, "run(t)"), "run start", "and again");
    }
}

#[test]
fn a_program_is_the_same_however_often_the_model_is_called() {
    let script = r#"
        let n = 0;
        for pass in 0..5 {
            movej([0.1 * pass, -1, -1, -1, 1, 0], 2.0);
            let got = comm_recv("p");
            n += got[0];
            comm_send("p", [get("RobotState[8]"), n]);
            wait_ms(7.25);
        }
    "#;
    let run = |ticks: bool| {
        let (mut cell, _) = runs(user_port(), script);
        for step in 0..6_000_u32 {
            if step % 997 == 0 {
                cell.port_bytes(0, &frame([(step / 997) as u8, 0, 0]));
            }
            if ticks {
                cell.input(ControllerInput::Tick);
            }
            cell.run_ms(1);
        }
        assert_eq!(cell.sent.len(), 5);
        let sent: Vec<_> = cell.sent.iter().map(|sent| (sent.0, sent.2.clone())).collect();
        (sent, cell.controller.program_variables(), cell.controller.counters().ports)
    };
    assert_eq!(run(false), run(true));
    assert_eq!(run(false), run(false));
}

#[test]
fn a_new_program_waits_until_the_old_ones_frame_was_sent() {
    let (mut cell, c) = runs(user_port(), "comm_send(\"p\", [0, 1]);");
    cell.line_time = Duration::from_millis(30);
    cell.sent.clear();
    cell.run_ms(30);
    cell.ask(c, "run(t)");
    assert_eq!(cell.sent.len(), 1);
    assert_eq!(cell.order(c, "stop"), "stop success");
    assert_eq!(cell.ask(c, "run(t)"), "run start");
    assert_eq!(cell.sent.len(), 1, "the line is still busy");
    cell.run_ms(10);
    assert_eq!(cell.sent.len(), 2);
    cell.run_ms(30);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
}
