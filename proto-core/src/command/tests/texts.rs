//! Requests and replies as texts: docs/wire/command.md sections 2 to 4.

use std::prelude::rust_2024::*;

use proptest::prelude::*;

use crate::command::{
    Action, ActionOutcome, EncodeError, Keyword, MAX_COMMAND, NoTextSpace, ParseError, Percent, Reply,
    ReplyKind, Request, StateCodes,
};
use crate::wire::dialect::Dialect;

fn percent(value: f32) -> Option<Percent> {
    Some(Percent::new(value).expect("a valid speed"))
}

#[test]
fn strict_reading_refuses_what_a_controller_would_let_pass() {
    let speed = Request::parse_strict(b"run(a.jspf,500)");
    assert_eq!(speed, Err(ParseError::InvalidSpeed));
    assert_eq!(Request::parse_strict(b"speed(0)"), Err(ParseError::InvalidSpeed));
    assert_eq!(Request::parse_strict(b"run()"), Err(ParseError::NoProgram));
    assert_eq!(Request::parse_strict(b"run(\"\",5)"), Err(ParseError::NoProgram));
    assert_eq!(Request::parse_strict(b"run(a.jspf)"), Ok(Request::Run { program: "a.jspf", speed: None }));
    assert_eq!(Request::parse_strict(b"stop"), Ok(Request::Do(Action::Stop)));
}

#[test]
fn every_refusal_names_its_reason() {
    let refused = |text: &[u8]| Request::parse(text).expect_err("not a command");
    assert_eq!(refused(b" \r\n"), ParseError::Empty);
    assert_eq!(refused(b"jump"), ParseError::UnknownWord);
    assert_eq!(refused(b"run(a(b))"), ParseError::Parentheses);
    assert_eq!(refused(b"run(a) b"), ParseError::Parentheses);
    assert_eq!(refused(b"speed"), ParseError::MissingArgument { keyword: Keyword::Speed });
    assert_eq!(refused(b"state(1)"), ParseError::UnexpectedArgument { keyword: Keyword::State });
    assert_eq!(refused(b"run(\xC3)"), ParseError::NotText { at: 4 });
    assert_eq!(refused(&[b'a'; MAX_COMMAND + 1]), ParseError::TooLong { len: MAX_COMMAND + 1 });
    assert_eq!(refused(b"speed").to_string(), "speed needs an argument, as in speed(...)");
    assert!(refused(b"jump").to_string().ends_with("shutdown, state, isprogfinish, getlasterror"));
}

#[test]
fn what_cannot_be_written_is_refused() {
    let mut out = [0xA5; 600];
    let encode = |program, out: &mut [u8]| Request::Run { program, speed: None }.encode(&Dialect::V2_3, out);
    assert_eq!(encode("", &mut out), Err(EncodeError::ProgramName));
    assert_eq!(encode(" a", &mut out), Err(EncodeError::ProgramName));
    for (program, byte) in [("a)b", b')'), ("a,b", b','), ("a\nb", b'\n'), ("\"a\"", b'"'), ("a(b", b'(')] {
        assert_eq!(encode(program, &mut out), Err(EncodeError::ProgramByte { byte }), "{program}");
    }
    let long = "a".repeat(MAX_COMMAND);
    assert_eq!(encode(&long, &mut out), Err(EncodeError::TooLong { len: MAX_COMMAND + 5 }));
    let short = NoTextSpace { needed: 6, available: 5 };
    assert_eq!(encode("a", &mut out[..5]), Err(EncodeError::NoSpace(short)));
    assert_eq!(Request::Speed(None).encode(&Dialect::V2_3, &mut out), Err(EncodeError::NoSpeed));
}

#[test]
fn nothing_is_written_behind_the_end() {
    let mut out = [0xA5; 32];
    let len = Reply::UnknownCommand.encode(&Dialect::V2_6, &mut out).unwrap();
    assert_eq!(&out[..len], b"unknown command\r\n");
    assert!(out[len..].iter().all(|&byte| byte == 0xA5));
    let needed = NoTextSpace { needed: 17, available: 16 };
    assert_eq!(Reply::UnknownCommand.encode(&Dialect::V2_6, &mut out[..16]), Err(needed));
}

#[test]
fn replies_are_read_in_both_dialects_forms() {
    use Keyword::{Do, GetLastError, IsProgFinish, Run, Speed, State};
    let success = Some(Reply::Run(ActionOutcome::Success));
    assert_eq!(Reply::parse(Run, b"run start"), success);
    assert_eq!(Reply::parse(Run, b"run success\r\n"), success);
    assert_eq!(Reply::parse(Run, b"run fail\n"), Some(Reply::Run(ActionOutcome::Fail)));
    assert_eq!(Reply::parse(Speed, b"set success"), Some(Reply::SpeedSet(None)));
    assert_eq!(Reply::parse(Speed, b"set speed 50%\r\n"), Some(Reply::SpeedSet(percent(50.0))));
    assert_eq!(Reply::parse(Speed, b"set speed 0%"), None);
    assert_eq!(Reply::parse(Speed, b"set speed 5"), None);
    assert_eq!(Reply::parse(Speed, b"set fail"), Some(Reply::SpeedRefused));
    let codes = StateCodes { robot: 6, program: 0, safety: 5, mode: 2 };
    assert_eq!(Reply::parse(State, b"6:0:5:2"), Some(Reply::State(codes)));
    assert_eq!(Reply::parse(State, b"6:0:99:2\r\n"), Some(Reply::State(StateCodes { safety: 99, ..codes })));
    for bad in ["6:0:5", "6:0:5:", "6:0:5:2:1", "6:0:5:256", ":0:5:2", "6::5:2", "6:0: 5:2", "a:0:5:2", ""] {
        assert_eq!(Reply::parse(State, bad.as_bytes()), None, "{bad}");
    }
    assert_eq!(Reply::parse(IsProgFinish, b"1"), Some(Reply::ProgramFinished(true)));
    assert_eq!(Reply::parse(IsProgFinish, b"0\n"), Some(Reply::ProgramFinished(false)));
    assert_eq!(Reply::parse(IsProgFinish, b"10"), None);
    let error = Reply::LastError { id: 0x1F4, message: b"joint 3: limit" };
    assert_eq!(Reply::parse(GetLastError, b"1f4:joint 3: limit\n"), Some(error));
    assert_eq!(Reply::parse(GetLastError, b"0x1F4:joint 3: limit"), Some(error));
    assert_eq!(Reply::parse(GetLastError, b"0:"), Some(Reply::LastError { id: 0, message: b"" }));
    assert_eq!(Reply::parse(GetLastError, b"123456789:x"), None);
    assert_eq!(Reply::parse(GetLastError, b"no error"), None);
    assert_eq!(Reply::parse(Do(Action::Stop), b"stop fail").map(|r| r.kind()), Some(ReplyKind::Fail));
    assert_eq!(Reply::parse(Do(Action::Stop), b"pause fail"), None);
    assert_eq!(Reply::parse(Do(Action::PowerOn), b"poweroff success"), None);
    assert_eq!(Reply::parse(State, b"unknown command\r\n"), Some(Reply::UnknownCommand));
    let already = Reply::parse(Do(Action::Enable), b"already enable\r\n");
    assert_eq!(already, Some(Reply::Already(Action::Enable)));
    assert_eq!(already.map(|reply| reply.kind()), Some(ReplyKind::Success));
    assert_eq!(Reply::parse(Do(Action::Enable), b"already disable"), None);
    assert_eq!(Reply::parse(Do(Action::Enable), b"already"), None);
    assert_eq!(Reply::parse(Run, b"already run"), None, "it may be another program");
    let fail = Reply::Did { action: Action::Enable, outcome: ActionOutcome::Fail };
    assert_eq!(Reply::parse(Do(Action::Enable), b"Error: cannot enable"), Some(fail));
    assert_eq!(Reply::parse(Do(Action::Enable), b"Error: cannot disable"), None);
    assert_eq!(Reply::parse(Run, b"script error"), Some(Reply::Run(ActionOutcome::Fail)));
}

#[test]
fn an_errors_message_cannot_break_the_reply() {
    let mut out = [0xA5; 64];
    let reply = Reply::LastError { id: 0xAB, message: b"line 1\nline 2" };
    let len = reply.encode(&Dialect::V2_3, &mut out).unwrap();
    assert_eq!(&out[..len], b"AB:line 1 line 2\n");
}

fn any_request() -> impl Strategy<Value = (String, u8, f32)> {
    ("[a-zA-Z0-9_./\u{4e00}-\u{4eff}-]{1,40}", 0u8..13, 0.01f32..100.0)
}

proptest! {
    #[test]
    fn every_request_survives_every_dialect((name, which, speed) in any_request(), with_speed: bool) {
        let speed = Percent::new(speed);
        let request = match Keyword::ALL[usize::from(which)] {
            Keyword::Run => Request::Run { program: &name, speed: speed.filter(|_| with_speed) },
            Keyword::Speed => Request::Speed(speed),
            Keyword::Do(action) => Request::Do(action),
            Keyword::State => Request::State,
            Keyword::IsProgFinish => Request::IsProgFinish,
            Keyword::GetLastError => Request::GetLastError,
        };
        for dialect in Dialect::ALL {
            let mut out = [0xA5; 300];
            let len = request.encode(&dialect, &mut out).unwrap();
            prop_assert_eq!(Request::parse(&out[..len]), Ok(request));
            prop_assert_eq!(Request::parse_strict(&out[..len]), Ok(request));
        }
    }

    #[test]
    fn every_reply_survives_every_dialect(
        id: u32, message in "[!-~\u{e9}]([ -~]{0,60}[!-~])?", codes: [u8; 4], speed in 0.01f32..100.0,
    ) {
        let mut replies: Vec<(Keyword, Reply<'_>)> = Vec::new();
        for outcome in [ActionOutcome::Success, ActionOutcome::Fail] {
            replies.push((Keyword::Run, Reply::Run(outcome)));
            for action in Action::ALL {
                replies.push((Keyword::Do(action), Reply::Did { action, outcome }));
            }
        }
        replies.extend(Action::ALL.map(|action| (Keyword::Do(action), Reply::Already(action))));
        let [robot, program, safety, mode] = codes;
        replies.push((Keyword::Speed, Reply::SpeedSet(Percent::new(speed))));
        replies.push((Keyword::Speed, Reply::SpeedRefused));
        replies.push((Keyword::State, Reply::State(StateCodes { robot, program, safety, mode })));
        replies.push((Keyword::IsProgFinish, Reply::ProgramFinished(true)));
        replies.push((Keyword::IsProgFinish, Reply::ProgramFinished(false)));
        replies.push((Keyword::GetLastError, Reply::LastError { id, message: message.as_bytes() }));
        replies.push((Keyword::State, Reply::UnknownCommand));
        replies.push((Keyword::State, Reply::ScriptFinish));
        for dialect in Dialect::ALL {
            for (keyword, reply) in &replies {
                let mut out = [0xA5; 300];
                let len = reply.encode(&dialect, &mut out).unwrap();
                let expected = match reply {
                    // The reply does not contain the speed in this dialect.
                    Reply::SpeedSet(_) if dialect == Dialect::V2_3 => Reply::SpeedSet(None),
                    other => *other,
                };
                prop_assert_eq!(Reply::parse(*keyword, &out[..len]), Some(expected));
            }
        }
    }

    #[test]
    fn garbage_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..600), which in 0usize..13) {
        let _ = Request::parse(&bytes);
        let _ = Request::parse_strict(&bytes);
        let _ = Reply::parse(Keyword::ALL[which], &bytes);
    }
}
