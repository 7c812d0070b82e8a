//! Clients that mean no good. The console refuses them, stays small, and the gateway does not notice.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use recipe_test_kit::{PATIENCE, until};
use serde_json::{Value, json};

use crate::kit::*;

#[test]
fn wrong_keys_are_counted_and_then_not_looked_at() {
    let cell = Cell::new();
    let with = |key: &str| {
        let fields = format!("Authorization: Bearer {key}");
        request(cell.console, "POST /api/v1/confirm", &fields, "")
    };
    for nth in 0..5 {
        let refused = with(&format!("{nth}{}", &KEY[1..].replace('f', "e"))).must_be(401);
        assert!(refused.field("WWW-Authenticate").unwrap().contains("nonce="));
    }
    let wait = with(KEY).must_be(429);
    let seconds: u64 = wait.field("Retry-After").unwrap().parse().unwrap();
    assert!((1..=60).contains(&seconds));
    get(cell.console, "status").must_be(200);
    let info = get(cell.console, "info").json();
    assert_eq!(info["console"]["requests"]["wrong_key"], 5);
    assert!(!cell.gateway.errors().join("\n").contains(KEY), "a key is in the log");
}

#[test]
fn a_signed_request_counts_once() {
    let cell = Cell::new();
    let nonce = get(cell.console, "nonce").must_be(200).json()["nonce"].as_str().unwrap().to_owned();
    let body = r#"{"confirm_s": 60}"#;
    let fields = sign(&nonce, "POST", "/api/v1/apply", body);
    // Nothing waits: it is carried out, and refused for that.
    let done = request(cell.console, "POST /api/v1/apply", &fields, body).must_be(409);
    assert!(done.body.contains("no stored revision waits"), "{}", done.body);
    let again = request(cell.console, "POST /api/v1/apply", &fields, body).must_be(401);
    assert!(again.body.contains("this nonce was used"), "{}", again.body);
    // The next one is in the answer.
    let next = done.field("Next-Nonce").unwrap();
    let fields = sign(next, "GET", "/api/v1/status", "");
    request(cell.console, "GET /api/v1/status", &fields, "").must_be(200);
    // Another body than the one that was signed.
    let nonce = get(cell.console, "nonce").json()["nonce"].as_str().unwrap().to_owned();
    let fields = sign(&nonce, "POST", "/api/v1/apply", body);
    let other = request(cell.console, "POST /api/v1/apply", &fields, r#"{"confirm_s": 61}"#).must_be(401);
    assert!(other.body.contains("not the one that was signed"), "{}", other.body);
}

#[test]
fn other_hosts_and_pages_of_other_origins_are_refused() {
    let cell = Cell::new();
    for host in ["evil.test", "evil.test:80", "10.0.0.1"] {
        request(cell.console, "GET /api/v1/status", &format!("Host: {host}"), "").must_be(421);
    }
    let auth = format!("Authorization: Bearer {KEY}\nContent-Type: application/json");
    for from in ["Origin: http://evil.test", "Origin: null", "Sec-Fetch-Site: cross-site"] {
        request(cell.console, "POST /api/v1/rollback", &format!("{auth}\n{from}"), "").must_be(403);
        request(cell.console, "GET /api/v1/stream", from, "").must_be(403);
        // What a page of another origin asks for, its browser does not show it.
        let read = request(cell.console, "GET /api/v1/status", from, "").must_be(200);
        assert_eq!(read.field("Cross-Origin-Resource-Policy"), Some("same-origin"));
        assert!(!read.head.contains("Access-Control"), "{}", read.head);
    }
    let preflight = "Origin: http://evil.test\nAccess-Control-Request-Method: POST";
    let refused = request(cell.console, "OPTIONS /api/v1/apply", preflight, "").must_be(405);
    assert_eq!(refused.field("Allow"), Some("POST"));
    let own = format!("{auth}\nOrigin: http://{}\nSec-Fetch-Site: same-origin", cell.console);
    request(cell.console, "POST /api/v1/rollback", &own, "").must_be(409);
}

#[test]
fn requests_that_are_none_are_refused() {
    let cell = Cell::new();
    let status = |text: &str| parse(&send(cell.console, text.as_bytes()).unwrap()).status;
    let head = format!("Host: {}\r\n", cell.console);
    assert_eq!(status("\r\n\r\n"), 400);
    assert_eq!(status("\u{16}\u{3}\u{1}\r\n\r\n"), 400, "a client that speaks TLS");
    assert_eq!(status("GET / HTTP/1.0\r\n\r\n"), 505);
    assert_eq!(status("GET /api/v1/info HTTP/1.1\r\n\r\n"), 400);
    assert_eq!(
        status(&format!("POST /api/v1/apply HTTP/1.1\r\n{head}Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n")),
        411
    );
    assert_eq!(status(&format!("GET /api/v1/info HTTP/1.1\r\n{head}X: {}\r\n\r\n", "x".repeat(3_000))), 431);
    let put = format!("PUT /api/v1/config HTTP/1.1\r\n{head}Authorization: Bearer {KEY}\r\n");
    assert_eq!(status(&format!("{put}Content-Type: application/toml\r\nContent-Length: 65537\r\n\r\n")), 413);
    assert_eq!(status(&format!("{put}Content-Type: text/plain\r\nContent-Length: 1\r\n\r\nx")), 415);
    assert_eq!(status(&format!("{put}Content-Length: 1\r\nContent-Length: 2\r\n\r\nx")), 400);
    assert_eq!(status(&format!("{put}Expect: nothing\r\n\r\n")), 417);
    // A second request in the same bytes is not looked at.
    let two = format!("GET /api/v1/nonce HTTP/1.1\r\n{head}\r\nGET /api/v1/info HTTP/1.1\r\n{head}\r\n");
    assert_eq!(send(cell.console, two.as_bytes()).unwrap().matches("HTTP/1.1 200").count(), 1);
    // A client that waits before it sends its body.
    let mut stream = TcpStream::connect(cell.console).unwrap();
    let check = "Content-Type: application/toml\r\nContent-Length: 3\r\nExpect: 100-continue\r\n\r\n";
    write!(stream, "POST /api/v1/check HTTP/1.1\r\n{head}{check}").unwrap();
    let mut answer = [0; 25];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 100 Continue\r\n\r\n");
    stream.write_all(b"a=1").unwrap();
    let mut rest = String::new();
    stream.read_to_string(&mut rest).unwrap();
    assert!(rest.starts_with("HTTP/1.1 200 OK\r\n"), "{rest}");
}

#[test]
fn slow_and_cut_off_requests_end_in_time() {
    let cell = Cell::new();
    let started = Instant::now();
    let half = format!("GET /api/v1/info HTTP/1.1\r\nHost: {}\r\n", cell.console);
    // One is silent, one sends a byte now and then, one leaves its body out.
    let mut silent = TcpStream::connect(cell.console).unwrap();
    silent.write_all(half.as_bytes()).unwrap();
    let mut slow = TcpStream::connect(cell.console).unwrap();
    let mut without = TcpStream::connect(cell.console).unwrap();
    let check = "Content-Type: application/toml\r\nContent-Length: 30\r\n\r\nhalf";
    write!(without, "POST /api/v1/check HTTP/1.1\r\nHost: {}\r\n{check}", cell.console).unwrap();
    until("the slow client is refused", || {
        let sent = slow.write_all(b"G").is_ok();
        std::thread::sleep(Duration::from_millis(50));
        (!sent || started.elapsed() > Duration::from_secs(6)).then_some(())
    });
    for stream in [&mut silent, &mut without] {
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 408 "), "{answer}");
    }
    assert!(started.elapsed() < Duration::from_secs(15));
    until("all are gone", || (get(cell.console, "info").json()["console"]["connections"] == 1).then_some(()));
    assert_eq!(get(cell.console, "info").json()["console"]["counters"]["incomplete"], 3);
}

#[test]
fn streams_leave_room_for_requests_and_those_who_do_not_read_are_dropped() {
    let cell = Cell::new();
    let open = |to: SocketAddr| {
        let mut stream = TcpStream::connect(to).unwrap();
        write!(stream, "GET /api/v1/stream HTTP/1.1\r\nHost: {to}\r\n\r\n").unwrap();
        stream
    };
    let unread: Vec<_> = (0..4).map(|_| open(cell.console)).collect();
    for stream in &unread {
        // As small as the system allows: it fills within a second.
        rustix::net::sockopt::set_socket_recv_buffer_size(stream, 1).unwrap();
    }
    until("four streams", || (get(cell.console, "info").json()["console"]["streams"] == 4).then_some(()));
    let refused = request(cell.console, "GET /api/v1/stream", "", "").must_be(503);
    assert!(refused.body.contains("too many streams"), "{}", refused.body);
    get(cell.console, "status").must_be(200);
    let info = until("they are dropped", || {
        let info = get(cell.console, "info").json();
        (info["console"]["streams"] == 0).then_some(info)
    });
    assert_eq!(info["console"]["counters"]["slow_readers"], 4, "{info}");
}

/// Frames of the panel and answers of the controller, while somebody attacks the console.
#[test]
fn a_thousand_connections_cost_the_cell_nothing() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    let hoard: Vec<TcpStream> = (0..1_000)
        .map(|nth| {
            let mut stream = TcpStream::connect(cell.console).unwrap();
            // Half of them have begun a request.
            let _ = (nth % 2 == 0).then(|| stream.write_all(b"GET /api/v1/status HTTP/1.1\r\n"));
            if nth % 50 == 0 {
                panel.write_all(&frame((nth / 50) as u8)).unwrap();
            }
            stream
        })
        .collect();
    let crowded = send(cell.console, b"").unwrap();
    assert!(crowded.is_empty() || crowded.starts_with("HTTP/1.1 503 "), "{crowded}");
    for value in 1..=50 {
        panel.write_all(&frame(value)).unwrap();
        cell.outputs_are(value.into());
    }
    let port = |stats: &Value| stats["ports"]["device"].clone();
    let stats = cell.gateway.stats("all frames", |stats| port(stats)["frames_in"] == 70);
    for counter in ["resync_bytes", "tail_mismatches", "downs"] {
        assert_eq!(port(&stats)[counter], 0, "{counter}");
    }
    assert_eq!(stats["links"]["modbus"]["losses"], 0);
    drop(hoard);
    let info = until("there is room again", || {
        let answer = send(
            cell.console,
            format!("GET /api/v1/info HTTP/1.1\r\nHost: {}\r\n\r\n", cell.console).as_bytes(),
        );
        answer.filter(|answer| answer.starts_with("HTTP/1.1 200")).map(|answer| parse(&answer).json())
    });
    assert!(info["console"]["counters"]["turned_away"].as_u64().unwrap() >= 900, "{info}");
    assert_eq!(info["console"]["connections"], json!(1));
}
