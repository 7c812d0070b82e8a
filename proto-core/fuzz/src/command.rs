//! Port 2000, both sides: any bytes in any pieces at any time (docs/wire/command.md).

use proto_core::command::{
    ClientEvent, CommandClient, CommandServer, EncodeError, Keyword, Reply, ReplyKind, Request, ServerEvent,
    UnknownCommand,
};
use proto_core::time::Instant;
use proto_core::wire::dialect::Dialect;

use crate::reference_command::{Asked, Client, Command, Event, Heard, Server, Turn};
use crate::source::{Source, cut};

/// Bytes of a connection that one input may lead to.
const LONGEST: usize = 2_000;

/// What is sent on port 2000, rightly or wrongly.
const TEXTS: [&[u8]; 16] = [
    b"run(",
    b"run(a.jspf,50)",
    b"run(\"b c\")",
    b"speed(",
    b"speed(12.5)",
    b"stop",
    b"poweron",
    b"state",
    b"isprogfinish",
    b"getlasterror",
    b"()",
    b"( )",
    b")",
    b"\r\n",
    b" ",
    b"\0",
];
/// And answered.
const REPLIES: [&[u8]; 24] = [
    b"run start",
    b"run fail",
    b"set success",
    b"set speed 50%",
    b"stop success",
    b"stop fail",
    b"6:0:5:2",
    b"1",
    b"0",
    b"1F:joint 3\n",
    b"0x2b0a:",
    b"unknown command",
    b"script finish",
    b"\r\n",
    b"set speed ",
    b"getlasterror success",
    b"already stop",
    b"already poweron",
    b"already poweroff",
    b"script error",
    b"Error: cannot stop\n",
    b"poweron refused\n",
    b"FAILED to run: set speed\n",
    b"busy\n",
];

/// The time a byte stands for, in microseconds: around 20 ms and 100 ms, and long.
fn wait(input: &mut Source<'_>) -> u64 {
    let byte = u64::from(input.u8());
    match byte {
        0..64 => byte * 1_000,
        64..128 => 19_968 + byte - 64,
        128..192 => 99_968 + byte - 128,
        192..240 => byte * 10_000,
        _ => byte * 500_000,
    }
}

/// The server.
pub(crate) fn run_server(input: &[u8]) {
    let mut input = Source::new(input);
    let how = input.u8();
    let (mut server, mut expected) = (CommandServer::new(), Server::default());
    let (mut now, mut received) = (1_000_000, 0);
    while !input.is_empty() && received < LONGEST {
        let op = input.u8();
        let bytes = match op % 4 {
            0 => TEXTS[usize::from(op >> 4)],
            1 => input.take(1 + usize::from(op >> 2)),
            2 => {
                now += wait(&mut input);
                continue;
            }
            _ => &[],
        };
        received += bytes.len() + 1;
        if bytes.is_empty() {
            serve(&mut server, &mut expected, now, &[]);
        }
        for chunk in cut(bytes, how) {
            serve(&mut server, &mut expected, now, chunk);
        }
    }
}

fn serve(server: &mut CommandServer, expected: &mut Server, now: u64, chunk: &[u8]) {
    let (mut rest, mut heard) = (chunk, Vec::new());
    // Silence can end one command without taking a byte.
    let mut free = true;
    loop {
        let before = rest.len();
        let Some(event) = server.receive(Instant::from_micros(now), &mut rest) else { break };
        assert!(
            rest.len() < before || std::mem::take(&mut free),
            "a command was found and nothing was taken"
        );
        heard.push(match event {
            ServerEvent::Unknown(UnknownCommand::Text(text)) => Heard::Unknown(text.to_vec()),
            ServerEvent::Unknown(UnknownCommand::TooLong) => Heard::TooLong,
            ServerEvent::Request(request) => {
                again(&request);
                Heard::Command(plain(&request))
            }
        });
    }
    assert!(rest.is_empty(), "None means that all was taken");
    assert_eq!(heard, expected.receive(now, chunk));
    assert_eq!(server.deadline().map(Instant::as_micros), expected.deadline());
}

fn plain(request: &Request<'_>) -> Command {
    match *request {
        Request::Run { program, speed } => {
            Command::Run { name: program.to_owned(), speed: speed.map(|speed| speed.value()) }
        }
        Request::Speed(speed) => Command::Speed(speed.map(|speed| speed.value())),
        Request::Do(action) => Command::Bare(action.word()),
        Request::State => Command::Bare("state"),
        Request::IsProgFinish => Command::Bare("isprogfinish"),
        Request::GetLastError => Command::Bare("getlasterror"),
    }
}

/// What was read can be written in each dialect and read again, or is refused.
fn again(request: &Request<'_>) {
    for dialect in [Dialect::V2_3, Dialect::V2_6] {
        let mut out = [0xA5; 300];
        match request.encode(&dialect, &mut out) {
            Ok(len) => {
                assert_eq!(Request::parse(&out[..len]), Ok(*request));
                assert_eq!(Command::read(&out[..len]), Some(plain(request)));
                assert!(Request::parse_strict(&out[..len]).is_ok());
                assert!(request.encode(&dialect, &mut out[..len - 1]).is_err());
            }
            Err(EncodeError::ProgramName | EncodeError::ProgramByte { .. } | EncodeError::TooLong { .. }) => {
                assert!(matches!(request, Request::Run { .. }));
            }
            Err(EncodeError::NoSpeed) => assert_eq!(*request, Request::Speed(None)),
            Err(error) => panic!("{request:?}: {error}"),
        }
    }
}

/// The client.
pub(crate) fn run_client(input: &[u8]) {
    let mut input = Source::new(input);
    let how = input.u8();
    let (mut client, mut expected) = (CommandClient::new(), Client::default());
    let (mut now, mut received) = (1_000_000, 0);
    while !input.is_empty() && received < LONGEST {
        let op = input.u8();
        received += 1;
        let bytes = match op % 8 {
            0 => {
                let turn = if op & 8 == 0 { Turn::InTurn } else { Turn::Beside };
                ask(&mut client, &mut expected, now, TEXTS[usize::from(op >> 4)], turn);
                continue;
            }
            1 => REPLIES[usize::from(op >> 4)],
            2 => REPLIES[usize::from(op >> 3) % REPLIES.len()],
            3 | 4 => input.take(1 + usize::from(op >> 3)),
            5 => {
                now += wait(&mut input);
                continue;
            }
            6 => {
                client.abort();
                expected.abort();
                continue;
            }
            _ => &[],
        };
        received += bytes.len();
        if bytes.is_empty() {
            hear(&mut client, &mut expected, now, &[]);
        }
        for chunk in cut(bytes, how) {
            hear(&mut client, &mut expected, now, chunk);
        }
    }
}

fn ask(client: &mut CommandClient, expected: &mut Client, now: u64, text: &[u8], turn: Turn) {
    let mut out = [0xA5; 300];
    let at = Instant::from_micros(now);
    let (busy, started) = match turn {
        Turn::InTurn => (client.busy(), client.start(at, text, &Dialect::V2_6, &mut out)),
        Turn::Beside => (client.busy_beside(), client.start_beside(at, text, &Dialect::V2_6, &mut out)),
    };
    let word = match Command::read(text) {
        Some(Command::Run { .. }) => "run",
        Some(Command::Speed(_)) => "speed",
        Some(Command::Bare(word)) => word,
        None => return assert!(started.is_err()),
    };
    assert_eq!(started.is_ok(), !busy);
    if let Ok(len) = started {
        assert!(out[..len].starts_with(word.as_bytes()) && out[..len].ends_with(b")\r\n"));
        match turn {
            Turn::InTurn => expected.start(now, word),
            Turn::Beside => expected.start_beside(now, word),
        }
    }
}

fn hear(client: &mut CommandClient, expected: &mut Client, now: u64, chunk: &[u8]) {
    let word = |request: &Option<Asked>| request.as_ref().map(|asked| asked.word.clone());
    let mut words = [word(&expected.waiting), word(&expected.beside)];
    let (mut rest, mut events) = (chunk, Vec::new());
    // What silence ends, and a timeout, take no bytes: one a text that was held.
    let mut free = 2 + 320;
    loop {
        let before = rest.len();
        let Some(event) = client.receive(Instant::from_micros(now), &mut rest) else { break };
        if rest.len() == before {
            free -= 1;
            assert!(free > 0, "no end of events");
        }
        events.push(match event {
            ClientEvent::ScriptFinish => Event::ScriptFinish,
            ClientEvent::Unsolicited { text, beside } => {
                let turn = beside.map(|beside| if beside { Turn::Beside } else { Turn::InTurn });
                Event::Unsolicited(text.to_vec(), turn)
            }
            ClientEvent::Timeout => Event::Timeout,
            ClientEvent::Reply { beside, kind, reply, text } => {
                let word = words[usize::from(beside)].as_deref();
                reply_again(word.expect("only a request is answered"), kind, &reply, text);
                // What is left is the older one.
                words = if beside { [words[0].take(), None] } else { [words[1].take(), None] };
                Event::Reply(if beside { Turn::Beside } else { Turn::InTurn }, text.to_vec())
            }
        });
    }
    assert!(rest.is_empty(), "None means that all was taken");
    assert_eq!(events, expected.receive(now, chunk));
    assert_eq!(client.busy(), expected.waiting.is_some());
    assert_eq!(client.busy_beside(), expected.beside.is_some());
    assert_eq!(client.dropped_bytes(), expected.dropped);
    assert_eq!(client.deadline().map(Instant::as_micros), expected.deadline());
}

fn says_failure(text: &[u8]) -> bool {
    let text = text.to_ascii_lowercase();
    text.windows(4).any(|letters| letters == b"fail") || text.windows(5).any(|letters| letters == b"error")
}

/// A reply's kind, and that it can be written and read again.
fn reply_again(word: &str, kind: ReplyKind, reply: &Reply<'_>, text: &[u8]) {
    let keyword = Keyword::from_word(word).expect("a keyword was asked");
    let expected = match text {
        b"unknown command" => ReplyKind::UnknownCommand,
        _ if ["state", "isprogfinish", "getlasterror"].contains(&word) => ReplyKind::Value,
        _ if says_failure(text) => ReplyKind::Fail,
        _ => ReplyKind::Success,
    };
    assert_eq!((kind, reply.kind()), (expected, expected));
    assert_eq!(Reply::parse(keyword, text), Some(*reply));
    for dialect in [Dialect::V2_3, Dialect::V2_6] {
        let mut out = [0xA5; 400];
        let len = reply.encode(&dialect, &mut out).expect("every reply fits");
        let read = Reply::parse(keyword, &out[..len]).expect("what was written can be read");
        // The older form does not say the speed, and control characters become blanks.
        match (reply, read) {
            (Reply::SpeedSet(_), Reply::SpeedSet(_)) => {}
            (Reply::LastError { id, .. }, Reply::LastError { id: again, .. }) => assert_eq!(*id, again),
            (reply, read) => assert_eq!(*reply, read),
        }
    }
}

pub(crate) fn server_seeds() -> Vec<Vec<u8>> {
    let bytes = |bytes: &[u8]| [&[(bytes.len() as u8 - 1) << 2 | 1], bytes].concat();
    let mut seeds = Vec::new();
    for how in [0, 1, 70] {
        let all: Vec<u8> = (0..16).map(|nth| nth << 4).collect();
        seeds.push([&[how], &all[..]].concat());
        for text in [
            &b"poweron\r\nenable\r\n"[..],
            b"run(a.jspf)stop\n",
            b"pause()resume()  shutdown ( ) \r\n",
            b"speed(0)speed(100.5)speed(x)speed(1e1)",
            b"run(a.jspf,5,6)run( my program , 70 )run()",
            b"State\nrun\nstate(5)\nrun(a\nrun(\xFF)stop)state\n",
            b"run(\x0Ba\x0B)run(\xC2\xA0a,\xC2\xA05)",
        ] {
            seeds.push([&[how], &bytes(text)[..]].concat());
        }
    }
    // A keyword, silence, its parentheses; a text that nothing can make a command, silence.
    for (text, later) in [
        (&b"poweron"[..], &b"()"[..]),
        (b"poweron", b"( "),
        (b"dance", b"()"),
        (b"power", b"off"),
        (b"run(a(", b"b)"),
        (b"run(\xE6\x8A", b"\x93)"),
        (b"run(\xFF", b")"),
        (b"stat ", b"e"),
        (b"run ", b"(a)"),
    ] {
        for time in [63 + 32, 64 + 32, 127 + 32, 128 + 32, 255] {
            seeds.push([&[0], &bytes(text)[..], &[2, time, 3], &bytes(later), &[2, time, 3, 0xD0]].concat());
        }
    }
    let long = bytes(&[b'a'; 64]);
    let name = [&[0x00][..], &bytes(&[b'a'; 62])].concat();
    seeds.push(
        [&[0], &long[..], &long, &long, &long, &bytes(b"a"), &long, &[2, 158, 3, 0x70, 2, 160, 0x70, 0xD0]]
            .concat(),
    );
    seeds.push([&[0], &name[..], &long, &long, &long, &[2, 160, 3, 0xC0]].concat());
    seeds
}

pub(crate) fn client_seeds() -> Vec<Vec<u8>> {
    let bytes = |bytes: &[u8]| [&[(bytes.len() as u8 - 1) << 3 | 3], bytes].concat();
    let ask = |nth: u8| nth << 4;
    let beside = |nth: u8| nth << 4 | 8;
    let answer = |nth: u8| nth << 4 | 1;
    let mut seeds = Vec::new();
    for how in [0, 1, 70] {
        // Each request with each answer, and some silence.
        for request in [1, 2, 4, 5, 6, 7, 8, 9] {
            let all: Vec<u8> = (0..16).flat_map(|nth| [ask(request), answer(nth), 5, 97, 7]).collect();
            seeds.push([&[how], &all[..]].concat());
        }
        seeds.push(
            [
                &[how, ask(7)][..],
                &bytes(b"6:0:5:256 1:2:3:4:5 "),
                &[5, 96, 7],
                &bytes(b"6:0:5"),
                &bytes(b":2x"),
            ]
            .concat(),
        );
        seeds.push([&[how, ask(9)][..], &bytes(b"0x123456789:x\n"), &bytes(b"1F:a"), &[5, 160, 7]].concat());
        seeds.push(
            [
                &[how, ask(5)][..],
                &bytes(b"hello script finish"),
                &bytes(b"foostop successbar\r\n"),
                &[5, 255, 7],
            ]
            .concat(),
        );
        seeds.push(
            [
                &[how, ask(4)][..],
                &bytes(b"set speed 12.5%set speed 101%"),
                &[5, 97, 7, ask(4)],
                &bytes(b"set speed 00000000000000001%"),
            ]
            .concat(),
        );
    }
    // A stop beside each of them, its reply first, last, glued, and one that both could get.
    for request in [1, 4, 5, 6, 7, 8, 9] {
        for replies in [&[4, 0, 3, 6, 7][..], &[0, 4], &[11, 11], &[6, 13, 4], &[10, 4, 5], &[12, 4, 4]] {
            let replies: Vec<u8> = replies.iter().map(|&nth| answer(nth)).collect();
            seeds
                .push([&[0, ask(request), beside(5)][..], &replies, &[5, 97, 7, ask(5), 5, 255, 7]].concat());
        }
    }
    // What is so already, and words that the client does not know, of each request and of two.
    for (nth, request) in [(16, 5), (17, 6), (18, 6), (19, 1), (20, 5), (21, 6), (22, 1), (22, 4), (23, 6)] {
        let answer = |nth: u8| nth << 3 | 2;
        seeds.push(vec![0, ask(request), answer(nth), 5, 97, 7, answer(nth), 5, 97, 7, 5, 255, 7]);
        let two = [ask(6), beside(5), answer(nth), answer(23), answer(23), answer(nth), answer(16)];
        seeds.push([&[0][..], &two, &[5, 97, 7, 5, 255, 7]].concat());
    }
    // The beginning of a reply when the time is up.
    seeds.push([&[0, ask(7)][..], &bytes(b"10"), &[5, 255, 7]].concat());
    // A number that was held behind an unknown text.
    seeds.push([&[0, ask(8)][..], &bytes(b"xset speed 5%06:0:5:2"), &[5, 97, 7]].concat());
    let long = bytes(&[b'a'; 32]);
    seeds.push(
        [
            &[0, ask(9), answer(9)][..],
            &[ask(9)],
            &bytes(b"1:"),
            &long.repeat(11),
            &[5, 160, 7, ask(7), answer(6), 5, 97, 7],
        ]
        .concat(),
    );
    seeds.push([&[0, ask(9)][..], &long.repeat(11), &[5, 97, 7]].concat());
    seeds
}
