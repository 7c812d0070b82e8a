//! The server's timelines: docs/wire/command.md section 5.

use std::prelude::rust_2024::*;
use std::{format, vec};

use proptest::prelude::*;

use super::at;
use crate::command::{
    Action, CommandServer, Keyword, MAX_COMMAND, Percent, Request, ServerEvent, UnknownCommand,
};
use crate::time::Instant;

fn show(event: &ServerEvent<'_>) -> String {
    match event {
        ServerEvent::Request(Request::Run { program, speed: None }) => format!("run {program}"),
        ServerEvent::Request(Request::Run { program, speed: Some(speed) }) => {
            format!("run {program} at {speed}")
        }
        ServerEvent::Request(Request::Speed(Some(speed))) => format!("speed {speed}"),
        ServerEvent::Request(Request::Speed(None)) => "speed ?".into(),
        ServerEvent::Request(request) => request.keyword().word().to_string(),
        ServerEvent::Unknown(UnknownCommand::Text(text)) => format!("?{}", String::from_utf8_lossy(text)),
        ServerEvent::Unknown(UnknownCommand::TooLong) => "too long".into(),
    }
}

fn receive(server: &mut CommandServer, now: Instant, mut bytes: &[u8]) -> Vec<String> {
    let mut events = vec![];
    while let Some(event) = server.receive(now, &mut bytes) {
        events.push(show(&event));
    }
    assert!(bytes.is_empty(), "None means that everything was taken");
    events
}

fn poll(server: &mut CommandServer, now: Instant) -> Vec<String> {
    receive(server, now, &[])
}

/// The events for `bytes` that arrive at once, followed by a long silence.
fn whole(bytes: &[u8]) -> Vec<String> {
    let mut server = CommandServer::new();
    let mut events = receive(&mut server, at(0), bytes);
    events.extend(poll(&mut server, at(1000)));
    events
}

#[test]
fn a_bare_keyword_without_a_terminator_is_complete_after_20_ms() {
    let mut server = CommandServer::new();
    assert_eq!(server.deadline(), None);
    assert!(receive(&mut server, at(5), b"state").is_empty());
    assert_eq!(server.deadline(), Some(at(25)));
    assert!(poll(&mut server, at(24)).is_empty());
    assert_eq!(poll(&mut server, at(25)), ["state"]);
    assert_eq!(server.deadline(), None);
    assert!(poll(&mut server, at(500)).is_empty());
}

#[test]
fn every_bare_keyword_ends_by_silence_and_no_other_beginning_does() {
    for keyword in Keyword::ALL.into_iter().filter(|keyword| keyword.is_bare()) {
        let word = keyword.word().as_bytes();
        for cut in 1..word.len() {
            let mut server = CommandServer::new();
            assert!(receive(&mut server, at(0), &word[..cut]).is_empty());
            let beginning = &keyword.word()[..cut];
            assert_eq!(server.deadline(), Some(at(10_000)), "{beginning:?} is only a beginning");
            assert!(poll(&mut server, at(9_999)).is_empty());
            assert!(receive(&mut server, at(9_999), &word[cut..]).is_empty());
            assert_eq!(server.deadline(), Some(at(10_019)));
            assert_eq!(poll(&mut server, at(10_019)), [keyword.word()]);
        }
    }
    for beginning in ["power", "run", "speed", "run(", "run(a.jspf", "speed(50", "poweron(", "st"] {
        let mut server = CommandServer::new();
        assert!(receive(&mut server, at(0), beginning.as_bytes()).is_empty());
        assert_eq!(server.deadline(), Some(at(10_000)), "{beginning}");
    }
}

#[test]
fn no_keyword_is_the_beginning_of_another() {
    for one in Keyword::ALL {
        for other in Keyword::ALL.into_iter().filter(|other| *other != one) {
            assert!(!other.word().starts_with(one.word()), "{one:?} {other:?}");
        }
    }
}

#[test]
fn a_closing_parenthesis_completes_a_command_at_once() {
    let mut server = CommandServer::new();
    assert_eq!(receive(&mut server, at(0), b"speed(50)"), ["speed 50"]);
    assert_eq!(server.deadline(), None);
    assert_eq!(receive(&mut server, at(0), b"run(a.jspf,30)"), ["run a.jspf at 30"]);
    assert_eq!(receive(&mut server, at(0), b"poweron()"), ["poweron"]);
    assert_eq!(receive(&mut server, at(0), b"\r\n").len(), 0);
}

#[test]
fn commands_in_one_segment_are_taken_apart() {
    assert_eq!(whole(b"poweron\r\nenable\r\n"), ["poweron", "enable"]);
    assert_eq!(whole(b"run(a.jspf)stop\n"), ["run a.jspf", "stop"]);
    assert_eq!(whole(b"run(a.jspf)stop"), ["run a.jspf", "stop"]);
    assert_eq!(whole(b"\r\n\r\n \t\n\0state\0\0stop\r"), ["state", "stop"]);
    assert_eq!(whole(b"pause()resume()  shutdown ( ) \r\n"), ["pause", "resume", "shutdown"]);
    assert_eq!(
        whole(b"speed(0)speed(100.5)speed(x)speed(12.5)"),
        ["speed ?", "speed ?", "speed ?", "speed 12.5"]
    );
}

#[test]
fn names_are_taken_as_written_without_their_quotes() {
    assert_eq!(whole(b"run(\"program/a.jspf\",70)"), ["run program/a.jspf at 70"]);
    assert_eq!(whole(b"run(1.jspf,70)"), ["run 1.jspf at 70"]);
    assert_eq!(whole(b"run( my program.jspf , 70 )"), ["run my program.jspf at 70"]);
    assert_eq!(whole(b"run(a.jspf,101)"), ["run a.jspf"]);
    assert_eq!(whole(b"run(a.jspf,)"), ["run a.jspf"]);
    assert_eq!(whole(b"run(a.jspf,5,6)"), ["run a.jspf"]);
    assert_eq!(whole("run(抓取.jspf)".as_bytes()), ["run 抓取.jspf"]);
    assert_eq!(whole(b"run()"), ["run "]);
}

#[test]
fn what_is_no_command_is_unknown() {
    assert_eq!(whole(b"dance\n"), ["?dance"]);
    assert_eq!(whole(b"State\n"), ["?State"]);
    assert_eq!(whole(b"run\n"), ["?run"]);
    assert_eq!(whole(b"speed\n"), ["?speed"]);
    assert_eq!(whole(b"state(5)"), ["?state(5)"]);
    assert_eq!(whole(b"run(a.jspf\n"), ["?run(a.jspf"]);
    assert_eq!(whole(b"stop)state\n"), ["?stop)state"], "nothing was open, so nothing closes");
    assert_eq!(whole(b"run(\xFF)"), ["?run(\u{FFFD})"]);
    assert_eq!(whole(b"power\n"), ["?power"]);
}

#[test]
fn a_text_that_cannot_become_a_command_is_given_up_after_100_ms() {
    let mut server = CommandServer::new();
    assert!(receive(&mut server, at(0), b"dance").is_empty());
    assert_eq!(server.deadline(), Some(at(100)));
    assert!(poll(&mut server, at(99)).is_empty());
    assert_eq!(poll(&mut server, at(100)), ["?dance"]);
    // Two adjacent keywords are not two commands: the second arrived within the gap.
    assert!(receive(&mut server, at(200), b"state").is_empty());
    assert!(receive(&mut server, at(219), b"stop").is_empty());
    assert_eq!(poll(&mut server, at(319)), ["?statestop"]);
    assert!(receive(&mut server, at(400), b"stop").is_empty());
    assert_eq!(poll(&mut server, at(420)), ["stop"]);
    let mut server = CommandServer::new();
    assert!(receive(&mut server, at(0), b"(").is_empty());
    assert_eq!(poll(&mut server, at(100)), ["?("]);
}

#[test]
fn silence_counts_even_if_the_next_byte_is_seen_first() {
    let mut server = CommandServer::new();
    assert!(receive(&mut server, at(0), b"state").is_empty());
    // The driver was late: it passes bytes before it polls.
    assert_eq!(receive(&mut server, at(30), b"stop\n"), ["state", "stop"]);
}

#[test]
fn empty_parentheses_that_come_late_belong_to_the_keyword_before() {
    let mut server = CommandServer::new();
    assert!(receive(&mut server, at(0), b"poweron").is_empty());
    assert_eq!(poll(&mut server, at(20)), ["poweron"]);
    assert!(receive(&mut server, at(40), b"(").is_empty());
    assert_eq!(server.deadline(), Some(at(10_040)));
    assert!(receive(&mut server, at(900), b")\r\n").is_empty());
    assert_eq!(receive(&mut server, at(901), b"()"), ["?()"]);
}

#[test]
fn beginnings_that_no_byte_can_complete_are_not_waited_for() {
    let full = [b"run(".as_slice(), &[b'a'; MAX_COMMAND - 4]].concat();
    for dead in [&b"run(a("[..], b"run(\xFF", b"run(\xE6\x20", b"stat ", b"po wer", &full] {
        let mut server = CommandServer::new();
        assert!(receive(&mut server, at(0), dead).is_empty());
        assert_eq!(poll(&mut server, at(100)).len(), 1, "{}", dead.escape_ascii());
    }
    for alive in [&b"run (a, 5"[..], b"run(\xE6\x8A", b"stat", b"state ( ", &full[..MAX_COMMAND - 1]] {
        let mut server = CommandServer::new();
        assert!(receive(&mut server, at(0), alive).is_empty());
        assert_eq!(server.deadline(), Some(at(10_000)), "{}", alive.escape_ascii());
    }
}

#[test]
fn a_beginning_is_given_up_after_ten_seconds_of_silence() {
    let mut server = CommandServer::new();
    // One byte per second still makes a command.
    let mut time = 0;
    for byte in b"run(a.jspf,50" {
        assert!(receive(&mut server, at(time), &[*byte]).is_empty());
        time += 1_000;
    }
    assert_eq!(receive(&mut server, at(time), b")"), ["run a.jspf at 50"]);
    assert!(receive(&mut server, at(20_000), b"run(a.jspf").is_empty());
    assert!(poll(&mut server, at(29_999)).is_empty());
    assert_eq!(poll(&mut server, at(30_000)), ["?run(a.jspf"]);
    assert_eq!(receive(&mut server, at(30_001), b"stop\n"), ["stop"]);
    // Nobody polled in between.
    assert!(receive(&mut server, at(40_000), b"run(a.jspf").is_empty());
    assert_eq!(receive(&mut server, at(50_000), b"stop\n"), ["?run(a.jspf", "stop"]);
}

#[test]
fn parentheses_after_a_text_that_was_given_up_are_a_text_of_their_own() {
    let mut server = CommandServer::new();
    assert!(receive(&mut server, at(0), b"dance").is_empty());
    assert_eq!(poll(&mut server, at(100)), ["?dance"]);
    assert_eq!(receive(&mut server, at(200), b"()"), ["?()"]);
}

#[test]
fn only_spaces_and_tabs_are_blanks() {
    assert_eq!(whole(b"run( \ta\t ,\t5 )"), ["run a at 5"]);
    assert_eq!(whole(b"run(\x0Ba\x0C)"), ["run \x0Ba\x0C"]);
    assert_eq!(whole("run(\u{A0}a,\u{A0}5)".as_bytes()), ["run \u{A0}a"]);
    assert_eq!(whole(b"state\x0B()"), ["?state\x0B()"]);
}

#[test]
fn a_command_that_is_too_long_is_answered_once_and_dropped_to_its_end() {
    let exactly = [b"run(".as_slice(), &[b'a'; MAX_COMMAND - 5], b")"].concat();
    assert_eq!(exactly.len(), MAX_COMMAND);
    let name = "a".repeat(MAX_COMMAND - 5);
    assert_eq!(whole(&exactly), [format!("run {name}")]);

    let longer = [b"run(".as_slice(), &[b'a'; MAX_COMMAND - 4], b")stop)\nstate\n"].concat();
    assert_eq!(whole(&longer), ["too long", "state"]);

    let mut server = CommandServer::new();
    assert_eq!(receive(&mut server, at(0), &[b'x'; 5000]), ["too long"]);
    assert!(receive(&mut server, at(99), b"stop").is_empty(), "still the same flood");
    assert_eq!(server.deadline(), Some(at(199)));
    assert!(poll(&mut server, at(199)).is_empty());
    assert_eq!(server.deadline(), None);
    assert_eq!(receive(&mut server, at(199), b"stop\n"), ["stop"]);

    assert_eq!(receive(&mut server, at(300), &[b'x'; 5000]), ["too long"]);
    assert_eq!(receive(&mut server, at(400), b"state\n"), ["state"], "100 ms of silence, never polled");
}

#[test]
fn a_reset_forgets_the_connection_and_keeps_the_settings() {
    let mut server = CommandServer::new();
    server.keyword_gap = crate::time::Duration::from_millis(3);
    assert_eq!(receive(&mut server, at(0), &[b'x'; 300]), ["too long"]);
    server.reset();
    assert!(receive(&mut server, at(0), b"enable").is_empty());
    assert_eq!(poll(&mut server, at(3)), ["enable"]);
}

#[test]
fn events_carry_typed_requests() {
    let mut server = CommandServer::new();
    let mut bytes = &b"disable\nspeed(25)"[..];
    let event = server.receive(at(0), &mut bytes);
    assert_eq!(event, Some(ServerEvent::Request(Request::Do(Action::Disable))));
    let event = server.receive(at(0), &mut bytes);
    assert_eq!(event, Some(ServerEvent::Request(Request::Speed(Percent::new(25.0)))));
}

/// Fragments of valid and invalid sessions.
fn conversation() -> impl Strategy<Value = Vec<u8>> {
    let piece = prop_oneof![
        prop::sample::select(Keyword::ALL.to_vec()).prop_map(|keyword| keyword.word().as_bytes().to_vec()),
        prop::sample::select(vec!["\r\n", "\n", "\0", "()", "(a.jspf,5)", "(", ")", " ", ",", "\"", "("])
            .prop_map(|text| text.as_bytes().to_vec()),
        prop::collection::vec(any::<u8>(), 0..300),
    ];
    prop::collection::vec(piece, 0..12).prop_map(|pieces| pieces.concat())
}

proptest! {
    #[test]
    fn cuts_change_nothing(bytes in conversation(), cuts in prop::collection::vec(0usize..3000, 0..6)) {
        let mut cuts: Vec<usize> = cuts.into_iter().map(|cut| cut.min(bytes.len())).collect();
        cuts.extend([0, bytes.len()]);
        cuts.sort_unstable();
        let mut server = CommandServer::new();
        let mut events = vec![];
        for piece in cuts.windows(2) {
            events.extend(receive(&mut server, at(0), &bytes[piece[0]..piece[1]]));
        }
        events.extend(poll(&mut server, at(1000)));
        prop_assert_eq!(events, whole(&bytes));
    }

    #[test]
    fn single_bytes_change_nothing(bytes in conversation()) {
        let mut server = CommandServer::new();
        let mut events = vec![];
        for byte in &bytes {
            events.extend(receive(&mut server, at(0), &[*byte]));
        }
        events.extend(poll(&mut server, at(1000)));
        prop_assert_eq!(events, whole(&bytes));
    }

    #[test]
    fn after_any_garbage_and_a_pause_the_next_command_is_heard(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let mut server = CommandServer::new();
        receive(&mut server, at(0), &bytes);
        receive(&mut server, at(0), b"\n");
        prop_assert_eq!(receive(&mut server, at(1000), b"stop\n"), ["stop"]);
    }

    #[test]
    fn polling_at_any_time_says_nothing_before_the_deadline(bytes in conversation(), early in 0u64..1000) {
        let mut server = CommandServer::new();
        receive(&mut server, at(0), &bytes);
        if server.deadline().is_none_or(|deadline| at(early) < deadline) {
            prop_assert!(poll(&mut server, at(early)).is_empty());
        } else {
            let quiet = poll(&mut server, at(early));
            prop_assert!(quiet.len() <= 1);
        }
    }
}
