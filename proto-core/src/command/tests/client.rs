//! The client's timelines: docs/wire/command.md section 6.

use std::prelude::rust_2024::*;
use std::{format, vec};

use proptest::prelude::*;

use super::at;
use crate::command::{
    Action, ActionOutcome, ClientEvent, CommandClient, EncodeError, Keyword, MAX_REPLY, ParseError, Reply,
    StartError, StateCodes,
};
use crate::time::Instant;
use crate::wire::dialect::Dialect;

fn show(event: &ClientEvent<'_>) -> String {
    match event {
        ClientEvent::Reply { kind, text, .. } => format!("{kind:?} {}", String::from_utf8_lossy(text)),
        ClientEvent::ScriptFinish => "finish".into(),
        ClientEvent::Unsolicited { text, beside } => {
            let to = match beside {
                None => "?",
                Some(false) => "?older: ",
                Some(true) => "?beside: ",
            };
            format!("{to}{}", String::from_utf8_lossy(text))
        }
        ClientEvent::Timeout => "timeout".into(),
    }
}

fn receive(client: &mut CommandClient, now: Instant, mut bytes: &[u8]) -> Vec<String> {
    let mut events = vec![];
    while let Some(event) = client.receive(now, &mut bytes) {
        events.push(show(&event));
    }
    assert!(bytes.is_empty(), "None means that everything was taken");
    events
}

#[track_caller]
fn asking(text: &str) -> CommandClient {
    let mut client = CommandClient::new();
    client.start(at(0), text.as_bytes(), &Dialect::V2_3, &mut [0; 300]).expect("a command");
    client
}

#[test]
fn a_command_is_written_in_the_dialects_form() {
    let mut out = [0xA5; 64];
    for (dialect, text, expected) in [
        (Dialect::V2_3, "poweron", "poweron"),
        (Dialect::V2_6, "poweron", "poweron()\r\n"),
        (Dialect::V2_3, "run(\"a.jspf\", 50)", "run(a.jspf,50)"),
        (Dialect::V2_6, "run(a.jspf,50.0)", "run(\"a.jspf\",50)\r\n"),
        (Dialect::V2_6, "speed(12.5)", "speed(12.5)\r\n"),
    ] {
        let len = CommandClient::new().start(at(0), text.as_bytes(), &dialect, &mut out).unwrap();
        assert_eq!(core::str::from_utf8(&out[..len]), Ok(expected));
    }
}

#[test]
fn what_cannot_be_sent_leaves_the_client_idle() {
    let mut client = CommandClient::new();
    let mut start = |text: &str, out: &mut [u8]| {
        let result = client.start(at(0), text.as_bytes(), &Dialect::V2_3, out);
        assert!(result.is_ok() || !client.busy() || result == Err(StartError::Busy));
        result
    };
    let mut out = [0; 300];
    assert_eq!(start("jump", &mut out), Err(StartError::Command(ParseError::UnknownWord)));
    assert_eq!(start("speed(200)", &mut out), Err(StartError::Command(ParseError::InvalidSpeed)));
    assert!(matches!(start("stop", &mut out[..3]), Err(StartError::Encode(EncodeError::NoSpace(_)))));
    assert_eq!(start("stop", &mut out), Ok(4));
    assert_eq!(start("stop", &mut out), Err(StartError::Busy));
}

#[test]
fn a_text_reply_is_complete_with_its_last_byte() {
    for (command, reply, event) in [
        ("poweron", "poweron success", "Success poweron success"),
        ("stop", "stop fail", "Fail stop fail"),
        ("run(a)", "run start", "Success run start"),
        ("run(a)", "run success", "Success run success"),
        ("speed(5)", "set success", "Success set success"),
        ("speed(5)", "set speed 5%", "Success set speed 5%"),
        ("isprogfinish", "1", "Value 1"),
        ("getlasterror", "1F:stalled\n", "Value 1F:stalled"),
        ("state", "unknown command", "UnknownCommand unknown command"),
    ] {
        for terminator in ["", "\r\n", "\n", "\0"] {
            let mut client = asking(command);
            assert_eq!(receive(&mut client, at(1), reply.as_bytes()), [event]);
            assert!(receive(&mut client, at(1), terminator.as_bytes()).is_empty());
            assert!(!client.busy());
            assert_eq!(client.deadline(), None, "{command} {terminator:?}");
        }
    }
}

#[test]
fn a_reply_that_could_go_on_is_complete_at_a_terminator_or_after_20_ms() {
    let mut client = asking("state");
    assert!(receive(&mut client, at(1), b"6:0:5:2").is_empty());
    assert_eq!(client.deadline(), Some(at(21)));
    assert!(receive(&mut client, at(20), b"").is_empty());
    assert_eq!(receive(&mut client, at(21), b""), ["Value 6:0:5:2"]);

    assert_eq!(receive(&mut asking("state"), at(1), b"6:0:5:2\r\n"), ["Value 6:0:5:2"]);

    let mut client = asking("state");
    assert!(receive(&mut client, at(1), b"6:0:9").is_empty());
    assert_eq!(client.deadline(), Some(at(10_000)), "not a reply yet, however long it takes");
    assert!(receive(&mut client, at(500), b"9:2").is_empty());
    assert_eq!(receive(&mut client, at(520), b""), ["Value 6:0:99:2"]);
}

#[test]
fn replies_are_typed() {
    let mut client = asking("state");
    let event = client.receive(at(0), &mut &b"4:0:99:1\n"[..]);
    let codes = StateCodes { robot: 4, program: 0, safety: 99, mode: 1 };
    assert!(matches!(event, Some(ClientEvent::Reply { reply: Reply::State(c), .. }) if c == codes));
    let mut client = asking("pause");
    let event = client.receive(at(0), &mut &b"pause fail"[..]);
    let fail = Reply::Did { action: Action::Pause, outcome: ActionOutcome::Fail };
    assert!(matches!(event, Some(ClientEvent::Reply { reply, .. }) if reply == fail));
}

#[test]
fn an_error_without_its_terminator_is_complete_after_100_ms() {
    let mut client = asking("getlasterror");
    assert!(receive(&mut client, at(1), b"2B:servo ").is_empty());
    assert!(receive(&mut client, at(80), b"alarm").is_empty());
    assert_eq!(client.deadline(), Some(at(180)));
    assert_eq!(receive(&mut client, at(180), b""), ["Value 2B:servo alarm"]);
}

#[test]
fn a_blank_before_a_message_does_not_end_it_early() {
    let mut client = asking("getlasterror");
    assert!(receive(&mut client, at(1), b"hellorun start 1F:joint").is_empty());
    assert_eq!(receive(&mut client, at(21), b""), ["?older: hello", "?run start"]);
    assert_eq!(client.deadline(), Some(at(101)));
    assert!(receive(&mut client, at(100), b"").is_empty());
    assert_eq!(receive(&mut client, at(101), b""), ["Value 1F:joint"]);
}

#[test]
fn a_message_that_is_too_long_is_cut_and_its_rest_dropped() {
    let mut client = asking("getlasterror");
    let long = [b"1:".as_slice(), &[b'm'; 1000], b"\nscript finish"].concat();
    let events = receive(&mut client, at(1), &long);
    assert_eq!(events, [format!("Value 1:{}", "m".repeat(MAX_REPLY - 2)), "finish".into()]);
    assert_eq!(client.dropped_bytes(), 1002 - MAX_REPLY as u32 + 1);
}

#[test]
fn a_finished_script_is_told_apart_from_replies() {
    let mut client = asking("state");
    assert_eq!(
        receive(&mut client, at(1), b"script finish6:0:5:2script finish\r\n"),
        ["finish", "Value 6:0:5:2", "finish"]
    );
    let mut client = asking("stop");
    assert_eq!(receive(&mut client, at(1), b"stop successscript finish"), ["Success stop success", "finish"]);
    let mut idle = CommandClient::new();
    assert!(receive(&mut idle, at(1), b"script fin").is_empty());
    idle.start(at(2), b"stop", &Dialect::V2_3, &mut [0; 16]).unwrap();
    assert_eq!(receive(&mut idle, at(3), b"ishstop fail"), ["finish", "Fail stop fail"]);
}

#[test]
fn a_late_reply_is_not_taken_for_the_next_one() {
    let mut client = asking("poweron");
    assert_eq!(client.deadline(), Some(at(10_000)));
    assert!(receive(&mut client, at(9_999), b"").is_empty());
    assert_eq!(receive(&mut client, at(10_000), b""), ["timeout"]);
    assert_eq!(client.deadline(), None);
    client.start(at(10_001), b"state", &Dialect::V2_3, &mut [0; 16]).unwrap();
    let events = receive(&mut client, at(10_002), b"poweron success6:0:5:2\n");
    assert_eq!(events, ["?poweron success", "Value 6:0:5:2"]);
}

#[test]
fn bytes_from_before_the_request_are_not_its_reply() {
    let mut client = CommandClient::new();
    assert!(receive(&mut client, at(0), b"stop succ").is_empty());
    client.start(at(1), b"stop", &Dialect::V2_3, &mut [0; 16]).unwrap();
    assert_eq!(receive(&mut client, at(2), b"stop fail"), ["Fail stop fail"]);
}

#[test]
fn unknown_texts_are_reported_and_do_not_hide_the_reply() {
    let mut client = asking("enable");
    assert_eq!(
        receive(&mut client, at(1), b"welcome\r\nenable success"),
        ["?older: welcome", "Success enable success"]
    );
    let mut client = asking("enable");
    assert!(receive(&mut client, at(1), b">enable success").is_empty());
    assert_eq!(client.deadline(), Some(at(21)));
    assert_eq!(receive(&mut client, at(21), b""), ["?older: >", "Success enable success"]);
    let mut client = asking("enable");
    assert_eq!(receive(&mut client, at(1), b"enable suc\r\n"), ["?older: enable suc"]);
    assert!(client.busy());
}

#[test]
fn what_is_so_already_is_done() {
    for word in ["poweron", "poweroff", "enable", "disable", "stop"] {
        let text = format!("already {word}");
        let success = format!("Success {text}");
        for piece in 1..text.len() {
            let mut client = asking(word);
            let (first, rest) = text.as_bytes().split_at(piece);
            assert!(receive(&mut client, at(1), first).is_empty());
            assert_eq!(client.deadline(), Some(at(10_000)), "the beginning of a reply");
            assert_eq!(receive(&mut client, at(2), rest), [&*success], "complete with its last byte");
            assert!(!client.busy());
        }
    }
    // The reply to another command does not end the request.
    let mut client = asking("poweron");
    assert_eq!(
        receive(&mut client, at(1), b"already poweroffalready enable"),
        ["?already poweroff", "?already enable"]
    );
    assert!(client.busy());
    assert_eq!(receive(&mut client, at(2), b"already poweron"), ["Success already poweron"]);
}

#[test]
fn a_text_that_names_the_command_and_a_failure_is_a_failure() {
    for (command, text) in [
        ("poweron", "poweron error"),
        ("poweron", "Error: PowerOn, the brake is open"),
        ("enable", "could not enable (FAILED)"),
        ("run(a)", "error 5: cannot run a.jspf"),
        ("run(a)", "script error"),
        ("speed(5)", "speed error"),
        ("speed(5)", "set: failed"),
    ] {
        let mut client = asking(command);
        let line = format!("{text}\r\n");
        assert_eq!(receive(&mut client, at(1), line.as_bytes()), [format!("Fail {text}")]);
        assert!(!client.busy());
        let mut client = asking(command);
        let found =
            [receive(&mut client, at(1), text.as_bytes()), receive(&mut client, at(21), b"")].concat();
        assert_eq!(found, [format!("Fail {text}")], "without a terminator");
    }
}

#[test]
fn other_words_end_no_request() {
    for (command, text) in [
        ("poweron", "the robot has power"),
        ("poweron", "error: no brake"),
        ("poweron", "poweron refused"),
        ("poweron", "poweron errors: 0"),
        ("poweron", "enable error"),
        ("poweron", "script error"),
        ("state", "state error"),
    ] {
        let mut client = asking(command);
        let line = format!("{text}\n");
        let to = if text == "script error" { "?" } else { "?older: " };
        assert_eq!(receive(&mut client, at(1), line.as_bytes()), [format!("{to}{text}")]);
        assert!(client.busy(), "{text}");
        assert_eq!(receive(&mut client, at(9_999), b""), [""; 0]);
        assert_eq!(receive(&mut client, at(10_000), b""), ["timeout"]);
    }
    assert_eq!(receive(&mut CommandClient::new(), at(1), b"welcome\n"), ["?welcome"]);
}

#[test]
fn other_words_belong_to_the_request_that_they_name_or_to_the_oldest_without_any() {
    let two = || {
        let mut client = asking("resume");
        client.start_beside(at(5), b"stop", &Dialect::V2_3, &mut [0; 16]).unwrap();
        client
    };
    let mut client = two();
    assert_eq!(
        receive(&mut client, at(6), b"stopping to stop, not to resume\n"),
        ["?beside: stopping to stop, not to resume"]
    );
    assert_eq!(receive(&mut client, at(6), b"busy\nbusy\n"), ["?older: busy", "?busy"]);
    let mut client = two();
    assert_eq!(
        receive(&mut client, at(6), b"busy\nbusy\nbusy\n"),
        ["?older: busy", "?beside: busy", "?busy"]
    );
    assert!(client.busy() && client.busy_beside());
    assert_eq!(receive(&mut client, at(7), b"resume success"), ["Success resume success"]);
    assert_eq!(receive(&mut client, at(7), b"busy\n"), ["?busy"], "what is left has had its words");
    let mut client = two();
    assert_eq!(
        receive(&mut client, at(6), b"error: stop before resume\n"),
        ["Fail error: stop before resume"]
    );
    assert!(client.busy() && !client.busy_beside(), "the first that it names");
    // Sent by the controller before it received the stop.
    let mut client = asking("resume");
    assert!(receive(&mut client, at(4), b"stop error").is_empty());
    client.start_beside(at(5), b"stop", &Dialect::V2_3, &mut [0; 16]).unwrap();
    assert_eq!(receive(&mut client, at(24), b""), ["?older: stop error"]);
}

#[test]
fn an_abort_forgets_everything() {
    let mut client = asking("getlasterror");
    receive(&mut client, at(1), b"1:half a mess");
    client.abort();
    assert_eq!(client.deadline(), None);
    client.start(at(2), b"state", &Dialect::V2_3, &mut [0; 16]).unwrap();
    assert_eq!(receive(&mut client, at(2), b"0:0:0:0\n"), ["Value 0:0:0:0"]);
}

#[test]
fn a_flood_is_handed_on_in_bounded_pieces() {
    let mut client = asking("stop");
    let events = receive(&mut client, at(1), &[b'#'; 1000]);
    assert_eq!(events.len(), 3);
    let texts: Vec<&str> = events.iter().map(|event| event.trim_start_matches("?older: ")).collect();
    assert!(texts.iter().all(|text| text.trim_start_matches('?').len() == MAX_REPLY));
    assert_eq!(receive(&mut client, at(2), b"\nstop success").last().unwrap(), "Success stop success");
}

fn conversation() -> impl Strategy<Value = Vec<u8>> {
    let piece = prop_oneof![
        prop::sample::select(vec![
            "script finish",
            "stop success",
            "stop fail",
            "run start",
            "run success",
            "set speed 50%",
            "set success",
            "unknown command",
            "6:0:5:2",
            "1",
            "0",
            "1F:stalled",
            "\r\n",
            "\n",
            "\0",
            " ",
            "sto",
            "set speed ",
            ":",
        ])
        .prop_map(|text| text.as_bytes().to_vec()),
        prop::collection::vec(any::<u8>(), 0..400),
    ];
    prop::collection::vec(piece, 0..10).prop_map(|pieces| pieces.concat())
}

fn any_client() -> impl Strategy<Value = CommandClient> {
    prop::sample::select(Keyword::ALL.to_vec()).prop_map(|keyword| match keyword {
        Keyword::Run => asking("run(a.jspf)"),
        Keyword::Speed => asking("speed(50)"),
        other => asking(other.word()),
    })
}

proptest! {
    #[test]
    fn cuts_change_nothing(client in any_client(), bytes in conversation(), cuts in prop::collection::vec(0usize..4000, 0..6)) {
        let mut cuts: Vec<usize> = cuts.into_iter().map(|cut| cut.min(bytes.len())).collect();
        cuts.extend([0, bytes.len()]);
        cuts.sort_unstable();
        let mut one = client.clone();
        let mut expected = receive(&mut one, at(1), &bytes);
        expected.extend(receive(&mut one, at(1000), &[]));
        let mut other = client;
        let mut events = vec![];
        for piece in cuts.windows(2) {
            events.extend(receive(&mut other, at(1), &bytes[piece[0]..piece[1]]));
        }
        events.extend(receive(&mut other, at(1000), &[]));
        prop_assert_eq!(events, expected);
    }

    #[test]
    fn single_bytes_change_nothing(client in any_client(), bytes in conversation()) {
        let mut one = client.clone();
        let expected = receive(&mut one, at(1), &bytes);
        let mut other = client;
        let mut events = vec![];
        for byte in &bytes {
            events.extend(receive(&mut other, at(1), &[*byte]));
        }
        prop_assert_eq!(events, expected);
    }

    #[test]
    fn every_request_ends_exactly_once(client in any_client(), bytes in conversation()) {
        let mut client = client;
        let mut events = receive(&mut client, at(1), &bytes);
        while let Some(deadline) = client.deadline() {
            events.extend(receive(&mut client, deadline, &[]));
        }
        let ends = events.iter().filter(|event| !event.starts_with('?') && *event != "finish").count();
        prop_assert_eq!(ends, 1, "{:?}", events);
        prop_assert!(!client.busy());
    }
}
