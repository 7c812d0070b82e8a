//! Port 2000: replies, states, and the right failure in each wrong state.

use proto_core::wire::state::OperationMode;

use super::*;

const LOOP: &str = "loop { wait_ms(10); }";

fn config() -> SimConfig {
    with_program(SimConfig::default(), "loop.jspf", LOOP)
}

#[test]
fn a_robot_is_powered_enabled_run_and_shut_down() {
    let mut cell = robot(&with_power(config(), Power::Off));
    let (c, d) = (cell.command_client(), cell.command_client());
    assert_eq!(cell.ask(c, "state"), "4:0:4:2");
    assert_eq!(cell.ask(c, "poweron"), "");
    assert_eq!(cell.ask(d, "state"), "4:0:4:2", "the transition takes time");
    assert_eq!(cell.ask(d, "poweron"), "poweron fail", "a transition is in progress");
    cell.run_ms(299);
    assert_eq!(cell.take(c), b"");
    cell.run_ms(1);
    assert_eq!(cell.take(c), b"poweron success");
    assert_eq!(cell.ask(c, "state"), "5:0:5:2");
    assert_eq!(cell.ask(c, "run(loop.jspf)"), "run fail");
    assert_eq!(cell.ask(c, "getlasterror"), "2001:run: the robot is not enabled\n");
    assert_eq!(cell.ask(c, "enable"), "");
    assert_eq!(cell.ask(d, "state"), "5:0:5:2");
    cell.run_ms(200);
    assert_eq!(cell.take(c), b"enable success");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    assert_eq!(cell.ask(c, "run(loop.jspf)"), "run start");
    assert_eq!(cell.ask(c, "state"), "6:2:5:2");
    assert_eq!(cell.ask(c, "isprogfinish"), "0");
    assert_eq!(cell.ask(c, "pause"), "");
    assert_eq!(cell.ask(d, "state"), "6:4:5:2");
    cell.run_ms(20);
    assert_eq!(cell.take(c), b"pause success");
    assert_eq!(cell.ask(c, "state"), "6:3:5:2");
    assert_eq!(cell.ask(c, "resume"), "resume success");
    assert_eq!(cell.ask(c, "state"), "6:2:5:2");
    assert_eq!(cell.ask(c, "stop"), "");
    assert_eq!(cell.ask(d, "state"), "6:1:5:2");
    assert_eq!(cell.ask(d, "isprogfinish"), "0");
    cell.run_ms(20);
    assert_eq!(cell.take(c), b"stop success");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");
    assert_eq!(cell.ask(c, "shutdown"), "shutdown fail");
    assert_eq!(cell.ask(c, "disable"), "");
    cell.run_ms(100);
    assert_eq!(cell.take(c), b"disable success");
    assert_eq!(cell.ask(c, "poweroff"), "");
    cell.run_ms(200);
    assert_eq!(cell.take(c), b"poweroff success");
    assert_eq!(cell.ask(c, "state"), "4:0:4:2");
    assert_eq!(cell.ask(c, "shutdown"), "shutdown success");
    assert!(!cell.shut_down, "the reply goes first");
    cell.run_ms(100);
    assert!(cell.shut_down);
    assert_eq!(cell.closed, [c, d]);
    assert_eq!(cell.drain(), Instant::NEVER);
    assert_eq!(cell.ask(c, "state"), "", "the controller is shut down");
}

/// The commands that succeed in each state, with the duration of their transitions.
#[test]
fn every_command_fails_in_every_wrong_state() {
    #[rustfmt::skip]
    let table: [(&str, &[&str], &str); 11] = [
        // The commands to get there, the command begun there, and those that succeed there.
        ("off",      &[],                                             "poweron shutdown"),
        ("powering", &["poweron.."],                                  "poweroff"),
        ("on",       &["poweron"],                                    "poweroff enable"),
        ("enabling", &["poweron", "enable.."],                        "poweroff disable"),
        ("enabled",  &["poweron", "enable"],                          "poweroff disable run"),
        ("running",  &["poweron", "enable", "run(loop.jspf)"],        "poweroff disable stop pause"),
        ("pausing",  &["poweron", "enable", "run(loop.jspf)", "pause.."], "poweroff disable stop"),
        ("paused",   &["poweron", "enable", "run(loop.jspf)", "pause"], "poweroff disable stop resume"),
        ("stopping", &["poweron", "enable", "run(loop.jspf)", "stop.."], "poweroff disable"),
        ("disabling", &["poweron", "enable", "disable.."],            "poweroff"),
        ("unpowering", &["poweron", "poweroff.."],                    ""),
    ];
    let commands = ["poweron", "poweroff", "enable", "disable", "run", "stop", "pause", "resume", "shutdown"];
    for (state, way, succeeding) in table {
        for command in commands {
            let mut cell = robot(&with_power(config(), Power::Off));
            let (c, other) = (cell.command_client(), cell.command_client());
            for step in way {
                match step.strip_suffix("..") {
                    Some(step) => assert_eq!(cell.ask(other, step), "", "{state}: {step}"),
                    None => assert!(!cell.order(c, step).contains("fail"), "{state}: {step}"),
                }
            }
            let before = cell.ask(c, "state");
            let text = if command == "run" { "run(loop.jspf)" } else { command };
            let asked = cell.now;
            let reply = cell.order(c, text);
            let good = succeeding.split(' ').any(|word| word == command);
            let expected = match (command, good) {
                ("run", true) => "run start".to_owned(),
                (_, true) => format!("{command} success"),
                (_, false) => format!("{command} fail"),
            };
            assert_eq!(reply, expected, "{command} while {state}");
            let takes = match command {
                "poweron" if good => 300,
                "poweroff" | "enable" if good => 200,
                "disable" if good => 100,
                "pause" | "stop" if good => 20,
                _ => 0,
            };
            assert_eq!(cell.now.saturating_since(asked).as_millis(), takes, "{command} while {state}");
            if !good {
                assert_eq!(cell.ask(c, "state"), before, "{command} while {state} changed something");
                let error = cell.ask(c, "getlasterror");
                assert!(error.starts_with(&format!("2001:{command}: ")), "{error}");
            }
        }
    }
}

#[test]
fn a_fault_stops_and_locks_until_it_is_cleared() {
    let mut cell = robot(&config());
    let c = cell.command_client();
    cell.ask(c, "run(loop.jspf)");
    cell.controller.emergency_stop(cell.now);
    assert_eq!(cell.ask(c, "state"), "6:1:9:2");
    assert_eq!(cell.ask(c, "getlasterror"), "3001:emergency stop\n");
    cell.run_ms(100);
    assert_eq!(cell.ask(c, "state"), "5:0:9:2");
    assert_eq!(cell.ask(c, "enable"), "enable fail");
    cell.controller.clear_stop(cell.now);
    assert_eq!(cell.ask(c, "state"), "5:0:6:2");
    assert_eq!(cell.ask(c, "enable"), "enable fail", "not while it recovers");
    cell.run_ms(200);
    assert_eq!(cell.order(c, "enable"), "enable success");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");

    cell.ask(c, "run(loop.jspf)");
    let collision_axis = 3;
    cell.controller.collide(cell.now, collision_axis);
    cell.run_ms(20);
    assert_eq!(cell.ask(c, "state"), "6:3:7:2");
    assert_eq!(cell.ask(c, "resume"), "resume fail");
    let s = cell.state_client();
    cell.run_ms(100);
    let packet = cell.packets.last().unwrap().1;
    assert_eq!((packet.collision, packet.collision_axis, packet.error_code), (1, 3, 0x3003));
    cell.input(ControllerInput::StateClosed { conn: s });
    cell.controller.clear_stop(cell.now);
    cell.run_ms(200);
    assert_eq!(cell.ask(c, "resume"), "resume success");
    assert_eq!(cell.ask(c, "state"), "6:2:5:2");

    cell.controller.protective_stop(cell.now);
    cell.run_ms(100);
    assert_eq!(cell.ask(c, "state"), "5:0:8:2");
}

#[test]
fn run_finds_programs_by_name_and_sets_the_speed() {
    let mut cell = robot(&with_program(config(), "done.jspf", "log(\"x\");"));
    let c = cell.command_client();
    assert_eq!(cell.ask(c, "run(nothing.jspf)"), "run fail");
    assert_eq!(cell.ask(c, "getlasterror"), "1001:run: there is no program nothing.jspf\n");
    assert_eq!(cell.ask(c, "run(\"program/done.jspf\",70)"), "run start");
    assert_eq!(cell.controller.machine().speed_percent(), 70.0);
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
    assert_eq!(cell.controller.program_log().collect::<Vec<_>>(), ["x"]);
    assert_eq!(cell.ask(c, "run(done.jspf,0)"), "run start", "an invalid speed is as good as none");
    assert_eq!(cell.controller.machine().speed_percent(), 70.0);
    assert_eq!(cell.ask(c, "speed(100)"), "set success");
    for wrong in ["speed(0)", "speed(100.1)", "speed(x)", "speed(-1)", "speed(nan)"] {
        assert_eq!(cell.ask(c, wrong), "set fail", "{wrong}");
    }
    assert_eq!(cell.controller.machine().speed_percent(), 100.0);
    cell.controller.set_mode(OperationMode::Manual);
    assert_eq!(cell.ask(c, "run(done.jspf)"), "run fail");
    assert_eq!(cell.ask(c, "getlasterror"), "2001:run: the robot is in manual mode\n");
    assert_eq!(cell.ask(c, "state"), "6:0:5:0");
}

#[test]
fn nothing_marks_the_end_of_a_command_and_pieces_are_joined() {
    let mut cell = robot(&config());
    let c = cell.command_client();
    for byte in b"state" {
        cell.input(ControllerInput::CommandBytes { conn: c, bytes: &[*byte] });
        cell.run_ms(1);
    }
    cell.run_ms(18);
    assert_eq!(cell.take(c), b"");
    cell.run_ms(2);
    assert_eq!(cell.take(c), b"6:0:5:2");
    // Two at once, the second without an end.
    cell.input(ControllerInput::CommandBytes { conn: c, bytes: b"isprogfinish()state" });
    assert_eq!(cell.take(c), b"1");
    cell.run_ms(20);
    assert_eq!(cell.take(c), b"6:0:5:2");
    // Other connections have their own buffers.
    let d = cell.command_client();
    cell.input(ControllerInput::CommandBytes { conn: c, bytes: b"sta" });
    assert_eq!(cell.ask(d, "te"), "unknown command");
    assert_eq!(cell.ask(c, "te"), "6:0:5:2");
    let long = "x".repeat(300);
    assert_eq!(cell.ask(c, &long), "unknown command");
    assert_eq!(cell.ask(c, "STATE"), "unknown command");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");
    assert_eq!(cell.controller.counters().command.refusals, 3);
}

#[test]
fn a_later_dialect_speaks_otherwise() {
    let config = with_program(with_dialect(config(), "v2.6"), "done.jspf", "wait_ms(30);");
    let mut cell = robot(&config);
    let (c, other) = (cell.command_client(), cell.command_client());
    assert_eq!(cell.ask(c, "run(done.jspf)"), "run success\r\n");
    assert_eq!(cell.ask(c, "speed(50)"), "set speed 50%\r\n");
    cell.run_ms(29);
    assert_eq!(cell.take(c), b"");
    cell.run_ms(1);
    assert_eq!(cell.take(c), b"script finish\r\n");
    assert_eq!(cell.take(other), b"", "only the one who started it is told");
    cell.state_client();
    cell.run_ms(100);
    assert_eq!(cell.packets[0].1.reserved_656[4], 50, "global speed at byte 660");
}

#[test]
fn a_later_dialect_says_what_is_so_already() {
    for (power, said) in [
        (Power::Off, ["poweron", "already poweroff", "enable fail", "disable fail"]),
        (Power::On, ["already poweron", "poweroff", "enable", "already disable"]),
        (Power::Enabled, ["already poweron", "poweroff", "already enable", "disable"]),
    ] {
        for (command, expected) in ["poweron", "poweroff", "enable", "disable"].into_iter().zip(said) {
            let mut cell = robot(&with_power(with_dialect(config(), "v2.6"), power));
            let c = cell.command_client();
            let answer = cell.ask(c, command);
            // What begins a transition is answered at its end.
            cell.run_ms(400);
            let later = String::from_utf8(cell.take(c)).unwrap();
            let expected = match expected == command {
                true => format!("{command} success\r\n"),
                false => format!("{expected}\r\n"),
            };
            assert_eq!([answer, later].concat(), expected, "{power:?}");
            let error = if expected.contains("fail") { "2001" } else { "0" };
            assert_eq!(cell.ask(c, "getlasterror").split(':').next(), Some(error), "nothing was refused");
            // The published description knows no such text.
            if expected.starts_with("already") {
                let mut cell = robot(&with_power(config(), power));
                let c = cell.command_client();
                assert_eq!(cell.ask(c, command), format!("{command} fail"));
            }
        }
    }
    // On, and on the way to another state.
    let mut cell = robot(&with_power(with_dialect(config(), "v2.6"), Power::On));
    let (c, d) = (cell.command_client(), cell.command_client());
    assert_eq!(cell.ask(c, "enable"), "");
    assert_eq!(cell.ask(d, "poweron"), "already poweron\r\n");
    assert_eq!(cell.ask(d, "enable"), "enable fail\r\n", "not yet");
}
