//! Port 2000's texts, version 1.
//!
//! Don't change me: controllers and clients in the field use these bytes. A change that needs
//! another expectation here is a new dialect and gets its own column.

use proto_core::command::{Action, ActionOutcome, Percent, Reply, Request, StateCodes};
use proto_core::wire::dialect::Dialect;

#[track_caller]
fn sent(request: Request<'_>, v2_3: &[u8], v2_6: &[u8]) {
    for (dialect, expected) in [(Dialect::V2_3, v2_3), (Dialect::V2_6, v2_6)] {
        let mut out = [0xA5; 64];
        let len = request.encode(&dialect, &mut out).unwrap();
        assert_eq!(out[..len].escape_ascii().to_string(), expected.escape_ascii().to_string());
        assert!(out[len..].iter().all(|&byte| byte == 0xA5));
        assert_eq!(Request::parse(expected), Ok(request));
    }
}

#[track_caller]
fn answered(reply: Reply<'_>, v2_3: &[u8], v2_6: &[u8]) {
    for (dialect, expected) in [(Dialect::V2_3, v2_3), (Dialect::V2_6, v2_6)] {
        let mut out = [0xA5; 64];
        let len = reply.encode(&dialect, &mut out).unwrap();
        assert_eq!(out[..len].escape_ascii().to_string(), expected.escape_ascii().to_string());
        assert!(out[len..].iter().all(|&byte| byte == 0xA5));
    }
}

#[test]
fn requests() {
    let speed = Percent::new(70.0);
    sent(Request::Run { program: "1.jspf", speed: None }, b"run(1.jspf)", b"run(\"1.jspf\")\r\n");
    sent(
        Request::Run { program: "program/a.jspf", speed },
        b"run(program/a.jspf,70)",
        b"run(\"program/a.jspf\",70)\r\n",
    );
    sent(Request::Speed(Percent::new(0.5)), b"speed(0.5)", b"speed(0.5)\r\n");
    sent(Request::Do(Action::Stop), b"stop", b"stop()\r\n");
    sent(Request::Do(Action::Pause), b"pause", b"pause()\r\n");
    sent(Request::Do(Action::Resume), b"resume", b"resume()\r\n");
    sent(Request::Do(Action::PowerOn), b"poweron", b"poweron()\r\n");
    sent(Request::Do(Action::PowerOff), b"poweroff", b"poweroff()\r\n");
    sent(Request::Do(Action::Enable), b"enable", b"enable()\r\n");
    sent(Request::Do(Action::Disable), b"disable", b"disable()\r\n");
    sent(Request::Do(Action::Shutdown), b"shutdown", b"shutdown()\r\n");
    sent(Request::State, b"state", b"state()\r\n");
    sent(Request::IsProgFinish, b"isprogfinish", b"isprogfinish()\r\n");
    sent(Request::GetLastError, b"getlasterror", b"getlasterror()\r\n");
}

#[test]
fn replies() {
    let did = |action, outcome| Reply::Did { action, outcome };
    answered(Reply::Run(ActionOutcome::Success), b"run start", b"run success\r\n");
    answered(Reply::Run(ActionOutcome::Fail), b"run fail", b"run fail\r\n");
    answered(Reply::SpeedSet(Percent::new(50.0)), b"set success", b"set speed 50%\r\n");
    answered(Reply::SpeedSet(None), b"set success", b"set success\r\n");
    answered(Reply::SpeedRefused, b"set fail", b"set fail\r\n");
    answered(did(Action::Stop, ActionOutcome::Success), b"stop success", b"stop success\r\n");
    answered(did(Action::Stop, ActionOutcome::Fail), b"stop fail", b"stop fail\r\n");
    answered(did(Action::Pause, ActionOutcome::Success), b"pause success", b"pause success\r\n");
    answered(did(Action::Resume, ActionOutcome::Fail), b"resume fail", b"resume fail\r\n");
    answered(did(Action::PowerOn, ActionOutcome::Success), b"poweron success", b"poweron success\r\n");
    answered(did(Action::PowerOff, ActionOutcome::Fail), b"poweroff fail", b"poweroff fail\r\n");
    answered(did(Action::Enable, ActionOutcome::Success), b"enable success", b"enable success\r\n");
    answered(did(Action::Disable, ActionOutcome::Fail), b"disable fail", b"disable fail\r\n");
    answered(did(Action::Shutdown, ActionOutcome::Success), b"shutdown success", b"shutdown success\r\n");
    answered(Reply::Already(Action::PowerOn), b"already poweron", b"already poweron\r\n");
    answered(Reply::Already(Action::PowerOff), b"already poweroff", b"already poweroff\r\n");
    answered(Reply::Already(Action::Enable), b"already enable", b"already enable\r\n");
    answered(Reply::Already(Action::Disable), b"already disable", b"already disable\r\n");
    let codes = StateCodes { robot: 6, program: 0, safety: 5, mode: 2 };
    answered(Reply::State(codes), b"6:0:5:2", b"6:0:5:2\r\n");
    answered(Reply::ProgramFinished(true), b"1", b"1\r\n");
    answered(Reply::ProgramFinished(false), b"0", b"0\r\n");
    let error = Reply::LastError { id: 0x2B0A, message: b"joint 3 over limit" };
    answered(error, b"2B0A:joint 3 over limit\n", b"2B0A:joint 3 over limit\r\n");
    answered(Reply::UnknownCommand, b"unknown command", b"unknown command\r\n");
    answered(Reply::ScriptFinish, b"script finish", b"script finish\r\n");
}
