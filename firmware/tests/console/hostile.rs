//! Clients that mean no good, or are slow: refused and counted, and the others are served meanwhile.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use recipe_api::key::Key;
use recipe_test_kit::{PATIENCE, until};
use serde_json::Value;

use crate::board::{KEY, QemuBoard, panel};
use crate::stream::Events;

/// What the board counts. A connection that finds all places taken, for as long as others end, is reset: then the
/// client tries again.
fn console(board: &QemuBoard) -> Value {
    until("an answer", || {
        let nonce = board.client.try_request("GET /api/v1/nonce", "", b"")?.json();
        let line = "GET /api/v1/info";
        let fields = board.client.signature(nonce["nonce"].as_str()?, line, b"");
        Some(board.client.try_request(line, &fields, b"")?.must_be(200).json()["console"].clone())
    })
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn wrong_and_repeated_signatures_are_refused_and_counted() {
    let mut board = QemuBoard::claimed(&panel(500));
    let body = b"{\"confirm_s\": 60}";
    let line = "POST /api/v1/apply";
    let json = "Content-Type: application/json";
    let fields = format!("{}\n{json}", board.client.signature(&board.client.nonce(), line, body));
    let done = board.client.request(line, &fields, body).must_be(409);
    assert!(done.text().contains("no stored revision waits"), "{}", done.text());
    let again = board.client.request(line, &fields, body).must_be(401);
    assert!(again.text().contains("this nonce was used"), "{}", again.text());
    // The next one is in the answer.
    let next = done.field("Next-Nonce").unwrap().to_owned();
    let fields = board.client.signature(&next, "GET /api/v1/status", b"");
    board.client.request("GET /api/v1/status", &fields, b"").must_be(200);
    // Another body than the one that was signed, another path, and the key itself.
    let fields = format!("{}\n{json}", board.client.signature(&board.client.nonce(), line, body));
    let other = board.client.request(line, &fields, b"{\"confirm_s\": 61}").must_be(401);
    assert!(other.text().contains("not the one that was signed"), "{}", other.text());
    let fields = board.client.signature(&board.client.nonce(), "GET /api/v1/info", b"");
    board.client.request("GET /api/v1/status", &fields, b"").must_be(401);
    let bearer = format!("Authorization: Bearer {KEY}");
    board.client.request("GET /api/v1/status", &bearer, b"").must_be(401);
    let counted = console(&board)["requests"].clone();
    assert_eq!((&counted["replayed"], &counted["wrong_key"]), (&1.into(), &1.into()), "{counted}");
    board.client.key = Some(Key::new([7; 16]));
    for _ in 0..4 {
        board.client.get("status").must_be(401);
    }
    board.client.key = Key::parse(KEY);
    let wait = board.client.get("status").must_be(429);
    assert!((1..=60).contains(&wait.field("Retry-After").unwrap().parse::<u32>().unwrap()));
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn requests_that_are_none_are_refused() {
    let board = QemuBoard::claimed(&panel(500));
    let host = &board.client.host;
    let status = |text: &str| {
        let answer = board.client.exchange(text.as_bytes()).unwrap();
        recipe_test_kit::http::Response::parse(&answer).map(|answer| answer.status)
    };
    assert_eq!(status("\r\n\r\n"), Some(400));
    assert_eq!(status("\u{16}\u{3}\u{1}\r\n\r\n"), Some(400), "a client that speaks TLS");
    assert_eq!(status("GET / HTTP/1.0\r\n\r\n"), Some(505));
    assert_eq!(status("GET /api/v1/info HTTP/1.1\r\n\r\n"), Some(400));
    for other in ["evil.test", "10.0.0.1", "rgw-123457"] {
        assert_eq!(status(&format!("GET /api/v1/nonce HTTP/1.1\r\nHost: {other}\r\n\r\n")), Some(421));
    }
    assert_eq!(status("GET /api/v1/nonce HTTP/1.1\r\nHost: RGW-123456:80\r\n\r\n"), Some(200));
    let long = "x".repeat(3_000);
    assert_eq!(status(&format!("GET /api/v1/info HTTP/1.1\r\nHost: {host}\r\nX: {long}\r\n\r\n")), Some(431));
    let post = format!("POST /api/v1/apply HTTP/1.1\r\nHost: {host}\r\n");
    assert_eq!(status(&format!("{post}Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n")), Some(411));
    let type_ = "Content-Type: application/json\r\n";
    assert_eq!(status(&format!("{post}{type_}Content-Length: 257\r\n\r\n")), Some(413));
    assert_eq!(status(&format!("{post}Origin: http://evil.test\r\n\r\n")), Some(403));
    // A second request in the same bytes is not looked at.
    let nonce = format!("GET /api/v1/nonce HTTP/1.1\r\nHost: {host}\r\n\r\n");
    let both = board.client.exchange(format!("{nonce}{nonce}").as_bytes()).unwrap();
    assert_eq!(String::from_utf8_lossy(&both).matches("HTTP/1.1 200").count(), 1);
    assert!(console(&board)["requests"]["unfit"].as_u64().unwrap() >= 1);
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn stalled_clients_hold_their_places_for_seconds_and_nobody_elses() {
    let board = QemuBoard::claimed(&panel(500));
    let half = format!("GET /api/v1/info HTTP/1.1\r\nHost: {}\r\n", board.client.host);
    let stalled = || {
        let mut stream = TcpStream::connect(board.client.to).unwrap();
        let _ = stream.write_all(half.as_bytes());
        stream
    };
    // One that has a place: it is neither answered nor reset.
    let placed = || {
        until("a place", || {
            let stream = stalled();
            stream.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
            let waits = stream.peek(&mut [0]).is_err_and(|error| error.kind() == ErrorKind::WouldBlock);
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
            waits.then_some(stream)
        })
    };
    // Three of four: the fourth place is for the others.
    let mut silent = [placed(), placed(), placed()];
    let begun = Instant::now();
    console(&board);
    console(&board);
    assert!(begun.elapsed() < Duration::from_secs(3), "others are served: {:?}", begun.elapsed());
    for stream in &mut silent {
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 408 "), "{answer}");
    }
    assert!(console(&board)["counters"]["incomplete"].as_u64().unwrap() >= 3);
    // All four: whoever comes is refused by the network, and served after some seconds.
    let _all = [stalled(), stalled(), stalled(), stalled()];
    board.until_reached();
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn streams_leave_two_places() {
    let board = QemuBoard::claimed(&panel(500));
    let (_first, mut second) = (Events::of(&board, ""), Events::of(&board, ""));
    let refused = board.client.get("stream").must_be(503);
    assert!(refused.text().contains("too many streams"), "{}", refused.text());
    let begun = Instant::now();
    assert_eq!(console(&board)["streams"], 2);
    assert_eq!(console(&board)["streams"], 2);
    assert!(begun.elapsed() < Duration::from_secs(4), "others are served: {:?}", begun.elapsed());
    assert!(second.next().1.is_object());
    assert_eq!(console(&board)["counters"]["turned_away"], 1);
}
