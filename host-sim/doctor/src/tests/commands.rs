//! Commands that came to nothing, and what the controller's states say of them.

use super::*;

/// A panel that gives a command.
const PANEL: &str = "controller = { address = \"127.0.0.1\" }
    [[recipe]]
    name = \"r\"
    kind = \"stream\"
    mode = \"user\"
    [recipe.input]
    head = [255]
    tail = [254]
    fields = [{ name = \"button\", type = \"byte\", commands = { 1 = \"run(pick.jspf)\" } }]
    [recipe.output]
    head = [255]
    tail = [254]
    fields = [{ name = \"joint\", type = \"float\", from = \"RobotState[8]\" }]
    [[port]]
    name = \"panel\"
    bus = \"rs485\"
    recipe = \"r\"";

#[track_caller]
fn refused(change: impl FnOnce(&mut StatePacket), cause: Cause, words: &[&str]) {
    let mut bench = Bench::new(PANEL);
    bench.pass(100);
    for link in [LinkId::STATE, LinkId::COMMAND] {
        bench.up(link);
    }
    bench.states(change);
    bench.bytes(&[255, 0, 254]);
    bench.bytes(&[255, 1, 254]);
    bench.pass(10);
    bench.input(Input::LinkBytes { link: LinkId::COMMAND, bytes: b"run fail" });
    bench.pass(500);
    bench.says(cause, words);
}

#[test]
fn a_refused_command_has_its_reason() {
    refused(
        |packet| packet.operation_mode = 0,
        Cause::Manual,
        &["port panel: run(pick.jspf) refused 0 s ago: the controller is in manual mode"],
    );
    for safety in [4, 5] {
        let off = |packet: &mut StatePacket| (packet.robot_state, packet.safety_state) = (4, safety);
        refused(off, Cause::PowerOff, &["refused 0 s ago: the arm is powered off"]);
    }
    refused(|packet| packet.robot_state = 5, Cause::Disabled, &["refused 0 s ago: the arm is not enabled"]);
    refused(|packet| packet.robot_state = 1, Cause::Starting, &["not ready (Initialize)"]);
    refused(|packet| packet.safety_state = 9, Cause::SafetyStop, &["has stopped the robot (Stop0)"]);
    refused(|packet| packet.program_state = 2, Cause::ProgramRuns, &["a program runs"]);
    refused(|_| (), Cause::ProgramName, &["in remote mode, powered and enabled", "no program pick.jspf"]);
}

/// A panel whose button stops the robot as long as it is pressed, after the controller's reply.
fn stopped(states: Option<u8>) -> Bench {
    let mut bench = Bench::new(&PANEL.replace(
        "type = \"byte\", commands = { 1 = \"run(pick.jspf)\" }",
        "type = \"byte\", bits = 0, commands = { level = \"stop\" }",
    ));
    bench.pass(100);
    bench.up(LinkId::COMMAND);
    if let Some(program) = states {
        bench.up(LinkId::STATE);
        bench.states(|packet| packet.program_state = program);
    }
    bench.bytes(&[255, 1, 254]);
    bench.pass(10);
    bench.bytes(&[255, 0, 254]);
    bench.input(Input::LinkBytes { link: LinkId::COMMAND, bytes: b"stop fail" });
    bench
}

#[test]
fn a_stop_that_has_nothing_to_stop_is_no_fault() {
    for (states, cause, severity, words) in [
        (Some(0), Cause::NothingToDo, Severity::Note, "stop refused 0 s ago: no program runs"),
        (Some(1), Cause::NothingToDo, Severity::Note, "the program is stopping already"),
        (Some(2), Cause::CommandFailed, Severity::Fault, "stop failed 0 s ago"),
        (None, Cause::NothingToDo, Severity::Note, "Most often no program runs"),
    ] {
        let bench = stopped(states);
        bench.says(cause, &[words]);
        assert_eq!(bench.of_ports()[0].severity, severity, "{states:?}");
    }
}

#[test]
fn a_command_that_failed_is_told_with_its_age_for_a_minute() {
    let mut bench = stopped(Some(2));
    let lives = |bench: &mut Bench, seconds: u64| {
        for _ in 0..seconds * 20 {
            bench.bytes(&[255, 0, 254]);
            bench.pass(50);
        }
    };
    lives(&mut bench, 44);
    bench.says(Cause::CommandFailed, &["stop failed 44 s ago"]);
    lives(&mut bench, 15);
    bench.says(Cause::CommandFailed, &["stop failed 59 s ago"]);
    lives(&mut bench, 2);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn a_command_without_a_reply_is_told_with_its_age_for_a_minute() {
    let mut bench = Bench::new(PANEL);
    bench.pass(1_100);
    bench.up(LinkId::COMMAND);
    bench.bytes(&[255, 0, 254]);
    bench.bytes(&[255, 1, 254]);
    let lives = |bench: &mut Bench, seconds: u64| {
        for _ in 0..seconds * 20 {
            bench.bytes(&[255, 1, 254]);
            bench.pass(50);
        }
    };
    lives(&mut bench, 12);
    bench.says(Cause::NoReply, &["no reply to run(pick.jspf), given 11 s ago"]);
    lives(&mut bench, 50);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn a_reply_in_unknown_words_is_told_with_them_for_a_minute() {
    let mut bench = Bench::new(PANEL);
    bench.pass(1_100);
    bench.up(LinkId::COMMAND);
    bench.bytes(&[255, 0, 254]);
    let other = |bench: &mut Bench| {
        bench.input(Input::LinkAcked { link: LinkId::COMMAND, left: 0 });
        bench.input(Input::LinkBytes { link: LinkId::COMMAND, bytes: b"teach mode\r\n" });
    };
    // Of no command.
    other(&mut bench);
    bench.bytes(&[255, 1, 254]);
    bench.pass(10);
    assert_eq!(bench.of_ports(), []);
    other(&mut bench);
    let lives = |bench: &mut Bench, seconds: u64| {
        for _ in 0..seconds * 20 {
            bench.bytes(&[255, 1, 254]);
            bench.pass(50);
        }
    };
    lives(&mut bench, 5);
    bench.says(Cause::OtherReply, &["run(pick.jspf) answered", "5 s ago: \"teach mode\""]);
    // The end of its time changes nothing.
    lives(&mut bench, 50);
    bench.says(Cause::OtherReply, &["55 s ago"]);
    lives(&mut bench, 6);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn a_controller_that_would_refuse_is_told_before_a_command() {
    let mut bench = Bench::new(PANEL);
    bench.pass(100);
    bench.up(LinkId::STATE);
    bench.states(|packet| packet.operation_mode = 0);
    bench.says_also(Cause::Manual, &["controller: the controller is in manual mode"]);
    bench.states(|_| ());
    assert!(bench.findings().iter().all(|finding| finding.place != FindingPlace::Controller));
}
