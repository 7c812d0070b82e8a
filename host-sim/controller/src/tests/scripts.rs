//! What programs can call, and the texts of their errors.

use super::*;
use ScalarType::{Byte, Float, Word};

fn user_port() -> SimConfig {
    one_port(rs485(), stream_recipe(Mode::User, user(&[Byte, Word]), user(&[Float, Byte])))
}

fn runs(config: SimConfig, script: &str) -> (TestController, ConnId) {
    let mut cell = robot(&with_program(config, "main.jspf", script));
    let c = cell.command_client();
    assert_eq!(cell.ask(c, "run(main.jspf)"), "run start");
    (cell, c)
}

/// The text of the error that the program ends with.
#[track_caller]
fn error_of(config: SimConfig, script: &str) -> String {
    let (mut cell, c) = runs(config, script);
    cell.run_ms(5_000);
    assert_eq!(cell.ask(c, "isprogfinish"), "1", "{script}");
    cell.ask(c, "getlasterror").trim_end().to_owned()
}

fn log(cell: &TestController) -> Vec<String> {
    cell.controller.program_log().map(str::to_owned).collect()
}

#[test]
fn a_receive_has_a_time_limit() {
    let script = r#"
        let first = comm_recv("p", 0.25);
        let second = comm_recv("p", 0.25);
        let third = comm_recv("p", 0);
        log(first.is_empty());
    "#;
    let (mut cell, c) = runs(user_port(), script);
    let frame = |bytes: [u8; 3]| [&[0xFF, 0xFF], &bytes[..], &[0xEE, 0xEE]].concat();
    cell.run_ms(249);
    assert!(!cell.controller.program_variables().contains_key("first"));
    cell.run_ms(1);
    assert_eq!(cell.controller.program_variables()["first"], serde_json::json!([]));
    // A pause stretches the time, and a frame ends it.
    cell.run_ms(100);
    assert_eq!(cell.order(c, "pause"), "pause success");
    cell.run_ms(10_000);
    assert_eq!(cell.order(c, "resume"), "resume success");
    cell.run_ms(140);
    cell.port_bytes(0, &frame([7, 1, 1]));
    cell.run_ms(1);
    let variables = cell.controller.program_variables();
    assert_eq!(
        (&variables["second"], &variables["third"]),
        (&serde_json::json!([7, 257]), &serde_json::json!([]))
    );
    assert_eq!((cell.ask(c, "isprogfinish").as_str(), log(&cell)), ("1", vec!["true".to_owned()]));
    for (time, wrong) in [("-1", "-1"), ("1e7", "10000000"), ("0.0/0.0", "NaN")] {
        let error = error_of(user_port(), &format!("comm_recv(\"p\", {time});"));
        assert!(error.contains(&format!("comm_recv takes 0 to 1000000 s, not {wrong}")), "{error}");
    }
    assert!(error_of(user_port(), "comm_recv(\"q\", 1);").contains("there is no port q"));
}

#[test]
fn a_line_is_followed_and_waits_for_its_arrival() {
    let joints = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1];
    let start: Vec<_> = (1..).zip(joints).map(|(nth, value)| (format!("RobotState[{nth}]"), value)).collect();
    let start: Vec<_> = start.iter().map(|(name, value)| (name.as_str(), *value)).collect();
    let at_work = || with_initial(SimConfig::default(), &[&start[..], &[("RobotState[22]", 0.1)]].concat());
    let script = r#"
        let pose = [];
        for n in 8..14 { pose.push(get(`RobotState[${n}]`)); }
        pose[1] -= 0.2;
        pose[2] += 0.1;
        movel(pose, 0.1);
        set("FloatOutputReg[1]", get("tcp_pose[2]") - pose[1]);
        pose[1] += 0.2;
        pose[2] -= 0.1;
        movel(pose, 0.1);
    "#;
    let (mut cell, c) = runs(at_work(), script);
    let begin = [cell.value("RobotState[9]"), cell.value("RobotState[10]")];
    let (mut ms, mut fastest) = (0, 0.0_f32);
    while cell.ask(c, "isprogfinish") == "0" {
        cell.run_ms(10);
        ms += 10;
        let (y, z) = (cell.value("RobotState[9]") - begin[0], cell.value("RobotState[10]") - begin[1]);
        assert!((y + 2.0 * z).abs() < 1e-4, "{y} {z} is beside the line");
        let arm = cell.controller.registers().arm();
        fastest = fastest.max(arm.tcp_velocity[1].hypot(arm.tcp_velocity[2]));
        assert!(ms < 20_000, "it never ends");
    }
    // 0.2236 m twice, on average at 8/15 of the speed.
    assert!((8_300..8_450).contains(&ms), "{ms}");
    assert!((0.099..0.1001).contains(&fastest), "{fastest}");
    assert!(cell.value("FloatOutputReg[1]").abs() < 1e-5);
    assert_eq!(cell.controller.machine().error(), None);
    // The speed of programs acts on lines too.
    let mut cell = robot(&with_program(at_work(), "main.jspf", script));
    let c = cell.command_client();
    cell.ask(c, "run(main.jspf,50)");
    cell.run_ms(ms);
    assert_eq!(cell.ask(c, "isprogfinish"), "0");
    cell.run_ms(ms + 20);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");

    for (call, text) in [
        ("movel([5, 0, 0, 0, 0, 0], 0.1);", "movel: the arm does not reach the line 0."),
        ("movel([0, 0, 0, 0, 0, 0], 3);", "movel: speed 3 m/s is not within (0, 2]"),
        ("movel([0, 0, 0], 0.1);", "movel takes 6 values of a pose, not 3"),
    ] {
        let error = error_of(at_work(), call);
        assert!(error.contains(text) && error.ends_with("(line 1, position 1)"), "{error}");
    }
}

#[test]
fn a_line_ends_at_the_shown_pose_wherever_the_base_is() {
    // The configured pose shifts the base frame.
    let joints = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1];
    let mut config = SimConfig::default();
    for (nth, value) in (1..).zip(joints) {
        config = with_initial(config, &[(&format!("RobotState[{nth}]"), value)]);
    }
    let pose = [1.5, -0.25, 0.75, 0.5, -0.5, 2.0];
    for (nth, value) in (8..).zip(pose) {
        config = with_initial(config, &[(&format!("RobotState[{nth}]"), value)]);
    }
    let (mut cell, c) = runs(config, "movel([1.4, -0.2, 0.8, 0.7, -0.6, 2.1], 0.5);");
    cell.run_ms(3_000);
    assert_eq!(
        (cell.ask(c, "isprogfinish").as_str(), cell.ask(c, "getlasterror").as_str()),
        ("1", "0:no error\n")
    );
    for (nth, wanted) in (8..).zip([1.4, -0.2, 0.8, 0.7, -0.6, 2.1]) {
        let there = cell.value(&format!("RobotState[{nth}]"));
        // Shifted angles may be a whole turn away.
        let apart = if nth < 11 { there - wanted } else { (there - wanted).sin() };
        assert!(apart.abs() < 1e-5, "RobotState[{nth}] is {there}, not {wanted}");
    }
}

#[test]
fn every_error_of_the_interpreter_has_its_place() {
    for (script, end) in [
        ("fn f(x) { f(x + 1) } f(0);", "Stack overflow (line 1, position 22)"),
        ("let a = []; loop { a.push(1); }", "too large (line 1, position 22)"),
        ("let a = \"x\"; loop { a += a; }", "too large (line 1, position 23)"),
        ("let x = y;", "Variable not found: y (line 1, position 9)"),
        ("1 / 0", "Division by zero: 1 / 0 (line 1, position 3)"),
        ("throw;", "Runtime error (line 1, position 1)"),
        ("call(5);", "Function not found: call (i64) (line 1, position 1)"),
    ] {
        let error = error_of(SimConfig::default(), script);
        assert!(error.ends_with(end), "{error}");
    }
}

fn with_others(main: &str) -> (TestController, ConnId) {
    let mut config =
        with_program(SimConfig::default(), "inner.jspf", "let x = [1];\nlet inside = 5; log(x[3]);");
    config = with_program(config, "middle.jspf", "\n  call(\"inner.jspf\");");
    config = with_program(config, "good.jspf", "let x = 9; wait_ms(50); set(\"WordOutputReg[1]\", x);");
    config = with_program(config, "again.jspf", "call(\"again.jspf\");");
    config = with_program(config, "late.jspf", "loop { try { wait_ms(10); } catch { } }");
    runs(config, main)
}

#[test]
fn a_program_calls_another() {
    let (mut cell, c) = with_others("let x = 1; call(\"good.jspf\"); call(\"/programs/good.jspf\"); log(x);");
    cell.run_ms(10);
    assert_eq!(cell.controller.program_name(), Some("main.jspf"));
    let variables = cell.controller.program_variables();
    assert_eq!((&variables["x"], &variables["good.jspf: x"]), (&serde_json::json!(1), &serde_json::json!(9)));
    cell.run_ms(80);
    assert_eq!(cell.ask(c, "isprogfinish"), "0");
    assert_eq!(cell.value("WordOutputReg[1]"), 9.0);
    cell.run_ms(10);
    assert_eq!((cell.ask(c, "isprogfinish").as_str(), log(&cell)), ("1", vec!["1".to_owned()]), "its own x");
    assert_eq!(cell.controller.counters().programs_started, 1);
    // A stop reaches a called program, which cannot catch it.
    let (mut cell, c) = with_others("try { call(\"late.jspf\"); } catch { } log(\"not here\");");
    cell.run_ms(100);
    assert_eq!(cell.order(c, "stop"), "stop success");
    assert_eq!((cell.controller.machine().error(), log(&cell)), (None, vec![]));
}

#[test]
fn errors_of_called_programs_have_both_names_and_both_places() {
    let text = |main: &str| {
        let (mut cell, c) = with_others(main);
        cell.run_ms(10);
        cell.ask(c, "getlasterror").trim_end().to_owned()
    };
    assert_eq!(
        text("call(\"inner.jspf\");"),
        "1002:main.jspf: Runtime error: in inner.jspf: Array index 3 out of bounds: only 1 element in array \
         (line 2, position 23) (line 1, position 1)"
    );
    assert_eq!(
        text("let a = 1;\ncall(\"middle.jspf\");"),
        "1002:main.jspf: Runtime error: in middle.jspf: Runtime error: in inner.jspf: Array index 3 out of \
         bounds: only 1 element in array (line 2, position 23) (line 2, position 3) (line 2, position 1)"
    );
    let missing = text("call(\"missing.jspf\");");
    assert!(
        missing.contains("call: there is no program missing.jspf; there are inner.jspf, mid"),
        "{missing}"
    );
    let deep = text("call(\"again.jspf\");");
    assert!(deep.starts_with("1002:main.jspf: ") && deep.ends_with("(line 1, position 1)"), "{deep}");
    assert!(deep.contains("in again.jspf"), "{deep}");
    let (mut cell, c) = with_others("try { call(\"inner.jspf\"); } catch (e) { log(e); }");
    cell.run_ms(10);
    assert_eq!(cell.ask(c, "getlasterror"), "0:no error\n");
    assert!(log(&cell)[0].starts_with("in inner.jspf: Array index 3"), "{:?}", log(&cell));
}

#[test]
fn nested_programs_are_bounded() {
    let mut config = SimConfig::default();
    for nth in 1..=9 {
        let script =
            format!("fn f(n) {{ if n > 0 {{ f(n - 1) }} else {{ call(\"p{}\") }} }} f(20);", nth + 1);
        config = with_program(config, &format!("p{nth}"), &script);
    }
    config = with_program(config, "p10", "log(\"too deep\");");
    let (mut cell, c) =
        runs(config, "try { call(\"p2\"); log(\"good\"); } catch (e) { log(e); } call(\"p1\");");
    cell.run_ms(1_000);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    let error = cell.controller.machine().error().unwrap().message.clone();
    assert!(error.contains("in p1: ") && error.len() < 320, "{error}");
    let lines = log(&cell);
    assert!(lines.len() == 1 && lines[0].contains("in p2: "), "{lines:?}");
    // Exactly the bound is good.
    let mut config = with_program(SimConfig::default(), "p8", "log(\"deep\");");
    for nth in 1..=7 {
        config = with_program(config, &format!("p{nth}"), &format!("call(\"p{}\");", nth + 1));
    }
    let (mut cell, _) = runs(config, "call(\"p1\");");
    cell.run_ms(100);
    assert_eq!((cell.controller.machine().error(), log(&cell)), (None, vec!["deep".to_owned()]));
}

#[test]
fn a_program_raises_an_error() {
    let error = error_of(SimConfig::default(), "wait_ms(5);\n  raise(\"no part in the gripper\");");
    assert_eq!(error, "1002:main.jspf: Runtime error: no part in the gripper (line 2, position 3)");
    let (cell, _) = runs(SimConfig::default(), "try { raise(7); } catch (e) { log(`caught ${e}`); }");
    assert_eq!(log(&cell), ["caught 7"]);
}

#[test]
fn states_are_read_by_name() {
    let script = r#"
        let states = [get("robot_state"), get("program_state"), get("safety_state"), get("mode"), get("speed")];
        let flags = [get("powered"), get("running"), get("error"), get("emergency_stop"), get("remote")];
        let packet = [get("joint_position[2]"), get("digital_inputs[3]"), get("error_code")];
        for name in ["robot_states", "joint_position[8]", "joint_position", "reserved_656", "mode[1]"] {
            try { get(name); log("read " + name); } catch (e) { log(e); }
        }
        try { set("robot_state", 5); } catch (e) { log(e); }
    "#;
    let config = with_initial(SimConfig::default(), &[("DI[3]", 1.0), ("RobotState[2]", -0.5)]);
    let mut cell = robot(&with_program(config, "main.jspf", script));
    let c = cell.command_client();
    cell.ask(c, "run(main.jspf,70)");
    cell.run_ms(10);
    assert_eq!(cell.controller.machine().error(), None);
    let variables = cell.controller.program_variables();
    assert_eq!(variables["states"], serde_json::json!([6, 2, 5, 2, 70.0]));
    assert_eq!(variables["flags"], serde_json::json!([true, true, false, false, true]));
    assert_eq!(variables["packet"], serde_json::json!([-0.5, 1, 0]));
    let lines = log(&cell);
    assert!(lines[0].starts_with("robot_states: a system variable is written"), "{lines:?}");
    assert_eq!(lines[1], "joint_position[8]: there is no such item; allowed: [1]..[6]");
    assert_eq!(lines[2], "joint_position: which of them is missing, such as [1]; allowed: [1]..[6]");
    assert_eq!(lines[3], "reserved_656: reserved in the state packet: it has no meaning");
    assert!(lines[5].starts_with("robot_state: a system variable is written"), "{lines:?}");
}

#[test]
fn every_kind_of_value_is_logged() {
    let script = "log(2.5); log(2.0); log(7); log(true); log(\"x\"); log([1, 2.5]); log(()); print(0.5); \
                  log(8.0, 2.0); let l = [ln(1.0), log(100.0, 10.0)]; for x in [1] { log(x); }";
    let (mut cell, _) = runs(SimConfig::default(), script);
    cell.run_ms(5);
    assert_eq!(cell.controller.machine().error(), None);
    assert_eq!(log(&cell), ["2.5", "2.0", "7", "true", "x", "[1, 2.5]", "", "0.5", "1"]);
    assert_eq!(cell.controller.program_variables()["l"], serde_json::json!([0.0, 2.0]));
}

#[test]
fn function_pointers_are_still_called() {
    let (cell, _) = runs(
        SimConfig::default(),
        "let f = |x| x + 1; log(f.call(4)); fn twice(x) { 2 * x } log(Fn(\"twice\").call(4));",
    );
    assert_eq!((cell.controller.machine().error(), log(&cell)), (None, vec!["5".to_owned(), "8".to_owned()]));
}

#[test]
fn long_errors_keep_their_place() {
    let long = "x".repeat(1_500);
    let cases = [
        (format!("\n\n   throw \"{long}\";"), "(line 3, position 4)"),
        (format!("\nraise(\"{long}\");"), "(line 2, position 1)"),
        (format!("\n get(\"{long}\");"), "(line 2, position 2)"),
        (
            format!("fn deep(n) {{ if n == 0 {{ throw \"{long}\"; }} deep(n - 1); }}\n\ndeep(9);"),
            "position 26, in function deep called at line 1, position 1538, in function deep called at line 1, \
             position 1538, ...)",
        ),
        (
            "fn f(x) { x[3] }\n\nf([1]);".to_owned(),
            "(line 1, position 13, in function f called at line 3, position 1)",
        ),
        ("let f = |x| x / 0;\n f.call(1);".to_owned(), "in a closure called at line 2, position 4)"),
        (
            "let b = []; for i in 0..500 { b.push(i); }\nlet a = #{ };\nfor i in 0..900 { a[`${i}`] = b; }"
                .to_owned(),
            "(line 3, position 29)",
        ),
    ];
    for (script, place) in cases {
        let error = error_of(SimConfig::default(), &script);
        assert!(error.ends_with(place), "{error}");
        assert!(error.len() <= 320, "a client takes no more: {}", error.len());
    }
    // Names do not cut it either.
    let name = "n".repeat(240);
    let mut cell =
        robot(&with_program(SimConfig::default(), &name, &format!("throw \"{}\"", "\u{e4}".repeat(900))));
    let c = cell.command_client();
    assert_eq!(cell.ask(c, &format!("run({name})")), "run start");
    let error = cell.ask(c, "getlasterror");
    assert!(error.ends_with("(line 1, position 1)\n") && error.len() <= 320, "{error}");
}
