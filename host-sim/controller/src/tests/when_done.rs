//! Port 2000: a command is answered at the end of its transition (D25).

use super::*;

const LOOP: &str = "loop { wait_ms(10); }";

fn enabled() -> (TestController, ConnId, ConnId) {
    clients(&with_program(SimConfig::default(), "t", LOOP))
}

fn with(power: Power) -> (TestController, ConnId, ConnId) {
    clients(&with_power(with_program(SimConfig::default(), "t", LOOP), power))
}

fn clients(config: &SimConfig) -> (TestController, ConnId, ConnId) {
    let mut cell = robot(config);
    let (a, b) = (cell.command_client(), cell.command_client());
    (cell, a, b)
}

fn got(cell: &mut TestController, conn: ConnId) -> String {
    String::from_utf8(cell.take(conn)).unwrap()
}

fn error(cell: &mut TestController, conn: ConnId) -> String {
    cell.ask(conn, "getlasterror").trim_end().to_owned()
}

#[test]
fn a_stop_and_a_pause_are_answered_when_the_arm_rests() {
    for (command, during, after) in [("pause", "6:4:5:2", "6:3:5:2"), ("stop", "6:1:5:2", "6:0:5:2")] {
        let move_it = "movej([1.0, 0, 0, 0, 0, 0], 1.0);";
        let (mut cell, a, b) = clients(&with_program(SimConfig::default(), "t", move_it));
        assert_eq!(cell.ask(a, "run(t)"), "run start");
        cell.run_ms(1_000);
        assert_eq!(cell.ask(a, command), "");
        cell.run_ms(99);
        assert_eq!((cell.ask(b, "state").as_str(), got(&mut cell, a).as_str()), (during, ""));
        cell.run_ms(1);
        assert_eq!(got(&mut cell, a), format!("{command} success"));
        assert_eq!(cell.ask(a, "state"), after);
    }
}

#[test]
fn further_commands_of_the_connection_are_answered_after_it_in_order() {
    let (mut cell, a, b) = with(Power::Off);
    cell.input(ControllerInput::CommandBytes {
        conn: a,
        bytes: b"poweron\nstate\nenable\nnonsense\nrun(t,50)\nisprogfinish\npause\nresume\nspeed(7)\nst",
    });
    assert_eq!(cell.ask(b, "state"), "4:0:4:2", "others are served");
    cell.run_ms(100);
    // A command that is completed by silence, while another one is pending.
    cell.input(ControllerInput::CommandBytes { conn: a, bytes: b"op" });
    cell.run_ms(30);
    cell.input(ControllerInput::CommandBytes { conn: a, bytes: b"state" });
    assert_eq!(got(&mut cell, a), "");
    cell.run_ms(170);
    assert_eq!(got(&mut cell, a), "poweron success5:0:5:2");
    cell.run_ms(199);
    assert_eq!(got(&mut cell, a), "");
    assert_eq!(cell.ask(b, "isprogfinish"), "1", "not run before it is enabled");
    cell.run_ms(1);
    assert_eq!(got(&mut cell, a), "enable successunknown commandrun start0");
    cell.run_ms(20);
    assert_eq!(got(&mut cell, a), "pause successresume successset success");
    cell.run_ms(20);
    assert_eq!(got(&mut cell, a), "stop success6:0:5:2");
    assert_eq!(cell.controller.machine().speed_percent(), 7.0);
}

#[test]
fn a_superseded_transition_fails_its_command_at_once() {
    // Power off while enabling, from another connection.
    let (mut cell, a, b) = with(Power::On);
    assert_eq!(cell.ask(a, "enable"), "");
    cell.run_ms(50);
    assert_eq!(cell.ask(b, "poweroff"), "");
    assert_eq!(got(&mut cell, a), "enable fail");
    assert_eq!(error(&mut cell, a), "2003:enable: another operation began before it was done");
    assert_eq!(cell.ask(a, "state"), "5:0:5:2");
    cell.run_ms(200);
    assert_eq!(got(&mut cell, b), "poweroff success");
    assert_eq!(cell.ask(a, "state"), "4:0:4:2");

    // Power off while powering on: the power is never on.
    assert_eq!(cell.ask(a, "poweron"), "");
    cell.run_ms(50);
    assert_eq!(cell.ask(b, "poweroff"), "");
    assert_eq!((got(&mut cell, a).as_str(), cell.ask(a, "state").as_str()), ("poweron fail", "4:0:4:2"));
    cell.run_ms(200);
    assert_eq!(got(&mut cell, b), "poweroff success");
    cell.run_ms(1_000);
    assert_eq!(cell.ask(a, "state"), "4:0:4:2");

    // Disable while enabling: the robot is never enabled.
    let (mut cell, a, b) = with(Power::On);
    cell.ask(a, "enable");
    cell.run_ms(50);
    cell.ask(b, "disable");
    assert_eq!((got(&mut cell, a).as_str(), cell.ask(a, "state").as_str()), ("enable fail", "5:0:5:2"));
    cell.run_ms(100);
    assert_eq!((got(&mut cell, b).as_str(), cell.ask(a, "state").as_str()), ("disable success", "5:0:5:2"));

    // Stop while pausing, power off while disabling.
    let (mut cell, a, b) = enabled();
    cell.ask(a, "run(t)");
    cell.ask(a, "pause");
    cell.ask(b, "stop");
    assert_eq!(got(&mut cell, a), "pause fail");
    cell.run_ms(20);
    assert_eq!(got(&mut cell, b), "stop success");
    cell.ask(a, "disable");
    cell.ask(b, "poweroff");
    assert_eq!(got(&mut cell, a), "disable fail");
    cell.run_ms(200);
    assert_eq!(got(&mut cell, b), "poweroff success");
}

#[test]
fn a_safety_stop_fails_commands_against_it_and_not_those_with_the_same_effect() {
    let (mut cell, a, b) = with(Power::On);
    cell.ask(a, "enable");
    cell.controller.emergency_stop(cell.now);
    cell.drain();
    assert_eq!(got(&mut cell, a), "enable fail");
    assert_eq!(error(&mut cell, b), "3001:emergency stop", "the cause is told, not its effect");
    assert_eq!(cell.ask(b, "state"), "5:0:9:2");

    let (mut cell, a, b) = enabled();
    cell.ask(a, "run(t)");
    cell.ask(a, "stop");
    cell.ask(b, "disable");
    cell.controller.emergency_stop(cell.now);
    cell.run_ms(100);
    assert_eq!((got(&mut cell, a).as_str(), got(&mut cell, b).as_str()), ("stop success", "disable success"));

    let (mut cell, a, _) = enabled();
    cell.ask(a, "run(t)");
    cell.ask(a, "pause");
    cell.controller.collide(cell.now, 1);
    cell.run_ms(20);
    assert_eq!(got(&mut cell, a), "pause success");
    assert_eq!(cell.ask(a, "resume"), "resume fail");
}

#[test]
fn a_disabled_robot_has_no_program_either() {
    for (command, state) in [("disable", "5:0:5:2"), ("poweroff", "4:0:4:2")] {
        let (mut cell, a, b) = enabled();
        cell.ask(a, "run(t)");
        // A program that takes long to stop.
        cell.controller.delay_transitions(Duration::from_secs(1));
        cell.ask(a, "stop");
        cell.controller.delay_transitions(Duration::ZERO);
        cell.ask(b, command);
        cell.run_ms(1_019);
        assert_eq!((got(&mut cell, a), got(&mut cell, b)), (String::new(), String::new()));
        cell.run_ms(1);
        assert_eq!(got(&mut cell, a), "stop success");
        assert_eq!(
            (got(&mut cell, b), cell.ask(b, "state")),
            (format!("{command} success"), state.to_owned())
        );
    }
}

#[test]
fn a_transition_over_its_limit_fails_and_continues() {
    let (mut cell, a, b) = with(Power::On);
    cell.controller.delay_transitions(Duration::from_secs(6));
    assert_eq!(cell.ask(a, "enable"), "");
    cell.run_ms(4_999);
    assert_eq!(got(&mut cell, a), "");
    cell.run_ms(1);
    assert_eq!(got(&mut cell, a), "enable fail");
    assert_eq!(error(&mut cell, b), "2003:enable: not done after 5 s");
    cell.run_ms(1_199);
    assert_eq!(cell.ask(b, "state"), "5:0:5:2");
    cell.run_ms(1);
    assert_eq!(cell.ask(b, "state"), "6:0:5:2");
    assert_eq!(got(&mut cell, a), "");
    // A stop is delayed too, and the delay remains after a restart.
    cell.controller.delay_transitions(Duration::from_secs(1));
    cell.ask(a, "run(t)");
    assert_eq!(cell.ask(a, "stop"), "");
    cell.run_ms(1_019);
    assert_eq!(got(&mut cell, a), "");
    cell.run_ms(1);
    assert_eq!(got(&mut cell, a), "stop success");
    cell.controller.restart(cell.now);
    cell.run_ms(700);
    let a = cell.command_client();
    cell.ask(a, "poweron");
    cell.run_ms(1_299);
    assert_eq!(got(&mut cell, a), "");
    cell.run_ms(1);
    assert_eq!(got(&mut cell, a), "poweron success");
}

#[test]
fn a_closed_connection_drops_its_waiting_commands_and_nothing_else() {
    let (mut cell, a, b) = with(Power::Off);
    cell.ask(a, "poweron");
    assert_eq!(cell.ask(a, "enable"), "");
    cell.input(ControllerInput::CommandClosed { conn: a });
    cell.run_ms(1_000);
    assert_eq!(got(&mut cell, a), "");
    assert_eq!(cell.ask(b, "state"), "5:0:5:2", "powered on, and never enabled");
    assert_eq!(cell.controller.deadline(), Instant::NEVER, "nothing waits any more");

    // A restart closes everything. Another client with the same number gets none of its answers.
    cell.ask(b, "enable");
    cell.ask(b, "state");
    cell.controller.restart(cell.now);
    cell.drain();
    assert_eq!(cell.closed, [b]);
    cell.input(ControllerInput::CommandOpened { conn: b, from: CLIENT_ADDRESS });
    cell.run_ms(10_000);
    assert_eq!(got(&mut cell, b), "");
    assert_eq!(cell.ask(b, "state"), "4:0:4:2");
    assert_eq!(cell.controller.deadline(), Instant::NEVER);

    // Shutdown while a command waits: its connection is closed with all others.
    assert_eq!(cell.ask(b, "poweron"), "");
    cell.input(ControllerInput::CommandClosed { conn: b });
    let (c, d) = (cell.command_client(), cell.command_client());
    assert_eq!(cell.order(c, "poweroff"), "poweroff success");
    cell.input(ControllerInput::CommandBytes { conn: c, bytes: b"shutdown\nstate\n" });
    assert_eq!(got(&mut cell, c), "shutdown success4:0:4:2");
    cell.run_ms(100);
    assert!(cell.shut_down && cell.closed.ends_with(&[c, d]), "{:?}", cell.closed);
}

#[test]
fn the_number_of_waiting_commands_is_bounded() {
    let (mut cell, a, b) = with(Power::Off);
    cell.ask(a, "poweron");
    for _ in 0..MAX_ORDERS {
        assert_eq!(cell.ask(a, "isprogfinish"), "");
    }
    assert_eq!(cell.closed, []);
    cell.run_ms(300);
    assert_eq!(got(&mut cell, a), format!("poweron success{}", "1".repeat(MAX_ORDERS)));
    // One more, in one piece with the rest: the waiting commands are not executed.
    let mut bytes = b"poweroff\nenable\n".to_vec();
    bytes.extend(b"isprogfinish\n".repeat(MAX_ORDERS));
    cell.input(ControllerInput::CommandBytes { conn: a, bytes: &bytes });
    assert_eq!(cell.closed, [a]);
    assert_eq!(cell.controller.counters().command.violations, 1);
    cell.run_ms(1_000);
    assert_eq!((got(&mut cell, a).as_str(), cell.ask(b, "state").as_str()), ("", "4:0:4:2"));
    // There is no bound if no command is pending.
    cell.input(ControllerInput::CommandBytes { conn: b, bytes: &b"isprogfinish\n".repeat(1_000) });
    assert_eq!(got(&mut cell, b).len(), 1_000);
}

#[test]
fn mute_and_delay_apply_at_the_end_of_the_transition() {
    let (mut cell, a, b) = with(Power::Off);
    cell.controller.mute(Link::Command);
    cell.ask(a, "poweron");
    cell.ask(a, "enable");
    cell.run_ms(400);
    cell.controller.unmute(Link::Command);
    assert_eq!(cell.ask(b, "state"), "5:0:5:2", "in order, mute or not");
    cell.run_ms(100);
    assert_eq!(got(&mut cell, a), "enable success", "only its own answer got lost");
    assert_eq!(cell.controller.counters().command.muted, 1);

    cell.controller.delay_answers(Link::Command, Duration::from_millis(250));
    cell.input(ControllerInput::CommandBytes { conn: a, bytes: b"disable\nstate\n" });
    cell.run_ms(349);
    assert_eq!(got(&mut cell, a), "");
    cell.run_ms(1);
    assert_eq!(got(&mut cell, a), "disable success5:0:5:2");
    // A client that disconnects before the delayed answer gets none, and nobody else gets it.
    cell.ask(a, "enable");
    cell.run_ms(300);
    cell.input(ControllerInput::CommandClosed { conn: a });
    cell.run_ms(1_000);
    assert_eq!((got(&mut cell, a), got(&mut cell, b)), (String::new(), String::new()));
    assert_eq!(cell.controller.deadline(), Instant::NEVER);
}

#[test]
fn a_late_call_still_answers() {
    let (mut cell, a, b) = with(Power::Off);
    cell.ask(a, "poweron");
    cell.ask(a, "enable");
    // After two seconds without a call, the transition is done, and the waiting command begins now.
    cell.now += Duration::from_secs(2);
    assert_eq!(cell.ask(b, "state"), "5:0:5:2");
    assert_eq!(got(&mut cell, a), "poweron success");
    cell.run_ms(200);
    assert_eq!(got(&mut cell, a), "enable success");
    // The same after more than a command's time limit: the transition is done.
    cell.ask(a, "disable");
    cell.now += Duration::from_secs(20);
    cell.drain();
    assert_eq!(got(&mut cell, a), "disable success");
}
