//! The page for people.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use recipe_test_kit::http::Response;
use recipe_test_kit::{PATIENCE, until};

use crate::board::{QemuBoard, panel};
use crate::stream::Events;

/// It needs no key, so a board that has none yet shows it too.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn the_page_is_the_built_one_and_is_not_sent_to_who_has_it() {
    let board = QemuBoard::new(&panel(500));
    let page = board.client.request("GET /", "", b"").must_be(200);
    assert!(page.body == recipe_console::PAGE, "{} bytes", page.body.len());
    let etag = recipe_console::ETAG;
    for (name, value) in [
        ("Content-Type", "text/html; charset=utf-8"),
        ("Content-Encoding", "gzip"),
        ("Content-Security-Policy", recipe_console::POLICY),
        ("ETag", etag),
        ("Cache-Control", "no-cache"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
    ] {
        assert_eq!(page.field(name), Some(value), "{name}");
    }
    let held = board.client.request("GET /", &format!("If-None-Match: {etag}"), b"").must_be(304);
    assert_eq!((held.field("ETag"), held.body.len()), (Some(etag), 0));
    let other = board.client.request("GET /", "If-None-Match: \"00000000\"", b"").must_be(200);
    assert_eq!(other.body.len(), page.body.len());
    // Its head alone.
    let head = board.client.request("HEAD /", "", b"");
    let len = page.body.len().to_string();
    assert_eq!((head.status, head.field("Content-Length"), head.body.len()), (200, Some(&*len), 0));
    board.client.request("POST /", "Content-Type: application/json", b"").must_be(405);
    board.client.request("GET /?x=1", "", b"").must_be(400);
    board.client.request("GET /index.html", "", b"").must_be(404);
    let elsewhere = recipe_test_kit::http::Client { host: "evil.test".to_owned(), ..board.client.clone() };
    elsewhere.request("GET /", "", b"").must_be(421);
}

/// Three at once, each read in small pieces, while others are served.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn three_pages_at_once_are_whole() {
    let board = QemuBoard::claimed(&panel(500));
    // A place is free a moment after its answer; a connection that finds none is reset.
    let is_alone = || (connections(&board)? == 1).then_some(());
    until("all others have ended", is_alone);
    let ask = || {
        let mut stream = board.client.narrow_connection().unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(&board.client.bytes("GET /", "", b"")).unwrap();
        (stream, Vec::new())
    };
    let mut pages: Vec<(TcpStream, Vec<u8>)> = (0..3).map(|_| ask()).collect();
    // The fourth place is for others.
    until("a status besides", || board.client.try_get("status"));
    // An answer is cut off after ten seconds, and QEMU's network loses packets where its host has no time for it.
    let mut again = 3;
    let mut is_open = true;
    while is_open {
        is_open = false;
        for (stream, bytes) in &mut pages {
            let mut piece = [0; 1000];
            match stream.read(&mut piece) {
                Ok(count) => {
                    bytes.extend_from_slice(&piece[..count]);
                    is_open |= count > 0;
                }
                Err(error) => {
                    let console = until("why", || board.client.try_get("info")).json()["console"].clone();
                    eprintln!("after {} bytes: {error}: {console}", bytes.len());
                    assert!(again > 0, "pages are cut off again and again");
                    again -= 1;
                    (*stream, *bytes) = ask();
                    is_open = true;
                }
            }
        }
    }
    for (_, bytes) in pages {
        let page = Response::parse(&bytes).unwrap().must_be(200);
        assert!(page.body == recipe_console::PAGE, "{} bytes", page.body.len());
    }
}

/// While a page waits for its client, streams go on.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_client_that_does_not_read_its_page_holds_up_nobody() {
    let board = QemuBoard::claimed(&panel(500));
    let mut silent = board.client.narrow_connection().unwrap();
    silent.write_all(&board.client.bytes("GET /", "", b"")).unwrap();
    let mut events = Events::of(&board, "");
    let begun = Instant::now();
    for _ in 0..10 {
        events.next();
    }
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
    drop(silent);
    // Its place is free again.
    until("one connection is left", || (connections(&board)? == 2).then_some(()));
}

/// How many there are, with the one that asks.
fn connections(board: &QemuBoard) -> Option<u64> {
    board.client.try_get("info")?.json()["console"]["connections"].as_u64()
}
