//! Servers that are broken, or mean it: everything ends in time, in little room, with one message.

use std::io::{Read, Write};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::time::{Duration, Instant};

use recipe_ctl::{Client, Failure, Stop, Watched};
use serde_json::json;

use crate::server::*;

const PATIENT: Duration = Duration::from_secs(60);

/// `info` fails, with these words.
#[track_caller]
fn refused(answer: impl Fn(&Asked) -> Reply + Send + Sync + 'static, words: &str) -> Server {
    let server = Server::start(answer);
    let message = message(recipe_ctl::info(&server.patient(false, PATIENT)));
    assert!(message.contains(words), "{message:?} has no {words:?}");
    server
}

#[track_caller]
fn message<T>(result: Result<T, Failure>) -> String {
    match result {
        Err(Failure::Refused(message)) => {
            assert!(!message.contains(char::is_control), "{message:?}");
            message
        }
        Err(other) => panic!("{other:?}"),
        Ok(_) => panic!("it was taken"),
    }
}

#[test]
fn garbage_is_no_answer() {
    refused(|_| Reply::Bytes(b"SSH-2.0-OpenSSH_9.6\r\n".to_vec()), "not one of HTTP/1.1");
    refused(|_| Reply::Bytes(Vec::new()), "no answer");
    refused(|_| Reply::Bytes(b"HTTP/1.1 200 OK\r\nContent".to_vec()), "ends within its head");
    refused(|_| Reply::Bytes(b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\n{}".to_vec()), "ends early");
    refused(|_| Reply::Bytes(b"HTTP/1.1 200 OK\r\n\r\n<html>".to_vec()), "no JSON");
    let chunked = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nfff\r\n{}";
    refused(|_| Reply::Bytes(chunked.to_vec()), "ends early");
    let lengths = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{}";
    refused(|_| Reply::Bytes(lengths.to_vec()), "not one of HTTP/1.1");
    let deep = "[".repeat(100_000);
    refused(move |_| bytes(200, "application/json", "", deep.as_bytes()), "no JSON");
}

#[test]
fn a_redirect_is_not_followed() {
    let server =
        refused(|_| document(302, "Location: http://127.0.0.1:9/api/v1/info\r\n", &json!({})), "status 302");
    assert_eq!(server.asked().len(), 1);
}

#[test]
fn what_never_ends_is_cut_off() {
    let endless = |head: &'static [u8], piece: &'static [u8]| {
        move |_: &Asked| {
            Reply::Write(Box::new(move |stream| {
                stream.write_all(head)?;
                let pieces = piece.repeat(1_000);
                loop {
                    stream.write_all(&pieces)?;
                }
            }))
        }
    };
    refused(endless(b"HTTP/1.1 200 OK\r\n", b"a: b\r\n"), "head is too long");
    refused(endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n"), "not one of HTTP/1.1");
    refused(endless(b"HTTP/1.1 200 OK\r\n\r\n", b"[[["), "longer than 1048576 bytes");
    let chunked = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n";
    refused(endless(chunked, b"1\r\n[\r\n"), "longer than 1048576 bytes");
    let server = Server::start(endless(ENDLESS, b"data: x"));
    let message = message(watch(&server.patient(false, PATIENT)).0);
    assert!(message.contains("an event that is too long"), "{message}");
}

#[test]
fn what_is_slow_ends_in_time() {
    let drip = |head: &'static [u8]| {
        move |_: &Asked| {
            Reply::Write(Box::new(move |stream| {
                for byte in head.iter().cycle() {
                    stream.write_all(&[*byte])?;
                    std::thread::sleep(Duration::from_millis(20));
                }
                Ok(())
            }))
        }
    };
    for head in [&b"HTTP/1.1 200 OK\r\na: "[..], b"HTTP/1.1 200 OK\r\n\r\n"] {
        let server = Server::start(drip(head));
        let started = Instant::now();
        let message = message(recipe_ctl::info(&server.patient(false, Duration::from_millis(300))));
        assert!(message.contains("no answer in time"), "{message}");
        assert!(started.elapsed() < Duration::from_secs(10), "{:?}", started.elapsed());
    }
    // A stream that falls silent.
    let server = Server::start(|_| {
        Reply::Write(Box::new(|stream| {
            stream.write_all(ENDLESS)?;
            stream.write_all(b"event: status\ndata: {}\n\n")?;
            std::thread::sleep(PATIENT);
            Ok(())
        }))
    });
    let (ended, printed) = watch(&server.patient(false, Duration::from_millis(300)));
    assert!(message(ended).contains("no answer in time"));
    assert_eq!(printed, "{}\n");
}

/// `status --watch --json`, and what it printed.
fn watch(client: &Client) -> (Result<(), Failure>, String) {
    let mut out = Vec::new();
    let ended = recipe_ctl::watch(client, &Watched::Status, true, WIDE, &mut out);
    (ended, String::from_utf8(out).unwrap())
}

#[test]
fn names_never_reach_a_terminal_as_they_came() {
    let nasty = "a\u{1b}]0;x\u{7}\u{9b}2J\u{202e}\r\n";
    let status = json!({
        "health": nasty,
        "controller": { "mode": { "name": nasty } },
        "ports": { nasty: { "state": nasty, "last_rejection": { "text": nasty, "bytes": nasty } } },
        "links": { nasty: { "state": nasty } },
    });
    let values = json!({ "values": { nasty: { "value": nasty, "owner": nasty } } });
    let revisions = json!({
        "kept": [{ "revision": 1, "from": nasty, "stored_at": nasty }],
        "last": { "revision": 1, "ended": nasty }, "failure": nasty,
    });
    let info =
        json!({ "name": nasty, "role": nasty, "version": nasty, "places": { "ports": { nasty: nasty } } });
    let doctor = json!({ "findings": [{ "severity": nasty, "place": nasty, "name": nasty, "seen": nasty, "likely": nasty, "text": nasty }] });
    let server = Server::start(move |asked| match asked.path.as_str() {
        "status" => ok(&status),
        "values" => ok(&values),
        "revisions" => ok(&revisions),
        "info" => ok(&info),
        "doctor" => ok(&doctor),
        _ => document(403, "", &json!({ "error": nasty })),
    });
    let client = server.client(false);
    let terminal = recipe_ctl::TableView { width: Some(80), is_terminal: true };
    for answer in [
        recipe_ctl::info(&client),
        recipe_ctl::status(&client, terminal),
        recipe_ctl::values(&client, &[], terminal),
        recipe_ctl::revisions(&client),
        recipe_ctl::doctor(&client, Duration::ZERO),
    ] {
        let answer = answer.unwrap();
        for text in [answer.text(terminal), answer.json()] {
            let own = ["\u{1b}[31m", "\u{1b}[32m", "\u{1b}[33m", "\u{1b}[0m"];
            let text = own.iter().fold(text, |text, own| text.replace(own, ""));
            let is_unfit = |c: char| c.is_control() && c != '\n' || c == '\u{202e}';
            assert!(!text.contains(is_unfit), "{text:?}");
        }
    }
    let message = message(recipe_ctl::metrics(&client));
    assert!(message.contains("\\u{1b}]0;x"), "{message}");
}

/// As a board does whose places are all taken, by a forwarded port.
#[test]
fn who_resets_connections_is_asked_again_but_not_to_change_something_twice() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    let asked = std::thread::spawn(move || {
        let mut methods = Vec::new();
        for (nth, stream) in listener.incoming().take(4).enumerate() {
            let mut stream = stream.unwrap();
            // What was not read when it is closed resets it.
            let mut method = [0; 4];
            while stream.peek(&mut method).unwrap() < method.len() {}
            methods.push(String::from_utf8(method.to_vec()).unwrap());
            if nth == 2 {
                let mut request = Vec::new();
                while !request.ends_with(b"\r\n\r\n") {
                    let mut byte = [0];
                    stream.read_exact(&mut byte).unwrap();
                    request.extend(byte);
                }
                stream
                    .write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 15\r\n\r\n{\"name\":\"cell\"}")
                    .unwrap();
            }
        }
        methods
    });
    let client = Client::new(at.to_string().parse().unwrap(), None, PATIENT, Stop::new()).unwrap();
    recipe_ctl::info(&client).unwrap();
    assert!(message(recipe_ctl::confirm(&client)).contains("reset"));
    assert_eq!(asked.join().unwrap(), ["GET ", "GET ", "GET ", "POST"]);
}

/// The same where reading needs the key: each time with another nonce, as one is used once.
#[test]
fn who_resets_what_is_signed_is_asked_again_with_another_nonce() {
    let (nonces, reads) = (AtomicU32::new(0), AtomicU32::new(0));
    let server = Server::start(move |asked| match (asked.path.as_str(), asked.signed_nonce()) {
        ("nonce", _) if nonces.fetch_add(1, Relaxed) == 0 => reset(b""),
        ("nonce", _) => ok(&json!({ "nonce": format!("{:032x}", nonces.load(Relaxed)) })),
        (_, None) => document(401, "", &json!({ "error": "it needs the key" })),
        (_, Some(_)) => match reads.fetch_add(1, Relaxed) {
            0 => reset(b""),
            1 => reset(b"HTTP/1.1 200 OK\r\nContent-Length: 15\r\n\r\n{\"name\""),
            _ => ok(&json!({ "name": "cell" })),
        },
    });
    let client = server.patient(true, PATIENT);
    recipe_ctl::info(&client).unwrap();
    let nonces: Vec<_> = server.asked().iter().filter_map(Asked::signed_nonce).collect();
    assert_eq!(nonces, [2, 3, 4].map(|nonce| format!("{nonce:032x}")));
}

/// Writes this, and resets the connection.
fn reset(piece: &'static [u8]) -> Reply {
    Reply::Write(Box::new(|stream| {
        stream.write_all(piece)?;
        Ok(rustix::net::sockopt::set_socket_linger(stream, Some(Duration::ZERO))?)
    }))
}
