//! Requests that a guard admits or refuses.

use super::*;
use crate::key::{BodyHash, Hex};
use crate::request::HeadBuffer;
use proto_core::time::Duration;
use std::format;
use std::string::{String, ToString};

const KEY: &str = "00112233445566778899aabbccddeeff";
const LOOPBACK: Site<'static> = Site { local: ip([127, 0, 0, 1]), peer: ip([127, 0, 0, 1]), names: &[] };
const NETWORK: Site<'static> = Site { local: ip([10, 0, 0, 5]), peer: ip([10, 0, 0, 9]), names: &["cell1"] };

const fn ip(octets: [u8; 4]) -> IpAddr {
    let [a, b, c, d] = octets;
    IpAddr::V4(core::net::Ipv4Addr::new(a, b, c, d))
}

fn at(seconds: u64) -> Instant {
    Instant::ZERO + Duration::from_secs(seconds)
}

fn guard() -> Guard {
    Guard::new(Key::parse(KEY), [5; 32])
}

fn ask(guard: &mut Guard, now: Instant, site: &Site<'_>, request: &str) -> Result<Admitted, Refusal> {
    let mut buffer = HeadBuffer::new();
    let request = request.replace('\n', "\r\n") + "\r\n\r\n";
    assert_eq!(buffer.push(request.as_bytes()), request.len());
    guard.admit(now, &buffer.head().unwrap(), site, Served::Gateway)
}

#[track_caller]
fn status(site: &Site<'_>, request: &str) -> u16 {
    ask(&mut guard(), at(0), site, request).map_or_else(|refusal| refusal.status.0, |_| 200)
}

/// A signed request with this body.
fn signed(guard: &mut Guard, now: Instant, method: &str, target: &str, body: &[u8]) -> String {
    let nonce = guard.nonce(now);
    with_nonce(&nonce, method, target, body)
}

fn with_nonce(nonce: &str, method: &str, target: &str, body: &[u8]) -> String {
    let mut hash = BodyHash::new();
    hash.update(body);
    let hash = Hex(&hash.finish()).to_string();
    let mac = Key::parse(KEY).unwrap().sign(&Signed { nonce, method, target, body: &hash });
    format!(
        "{method} {target} HTTP/1.1\nHost: 10.0.0.5\nContent-Length: {}\nContent-Type: application/json\n\
         Authorization: {SCHEME} nonce={nonce}, body={hash}, mac={}",
        body.len(),
        Hex(&mac)
    )
}

#[test]
fn on_one_machine_reading_is_free_and_writing_takes_the_key() {
    assert_eq!(status(&LOOPBACK, "GET /api/v1/status HTTP/1.1\nHost: localhost:8480"), 200);
    assert_eq!(status(&LOOPBACK, "HEAD /api/v1/status HTTP/1.1\nHost: 127.0.0.1:1"), 200);
    let write = "POST /api/v1/confirm HTTP/1.1\nHost: 127.0.0.1:1";
    assert_eq!(status(&LOOPBACK, write), 401);
    assert_eq!(status(&LOOPBACK, &format!("{write}\nAuthorization: Bearer {KEY}")), 200);
    assert_eq!(status(&LOOPBACK, &format!("{write}\nAuthorization: bearer  {KEY}")), 200);
    assert_eq!(status(&LOOPBACK, &format!("{write}\nAuthorization: Bearer {}", "1".repeat(32))), 401);
    assert_eq!(status(&LOOPBACK, &format!("{write}\nAuthorization: Basic {KEY}")), 401);
    // A key that is sent must be right, even where none is needed.
    assert_eq!(
        status(&LOOPBACK, "GET /api/v1/status HTTP/1.1\nHost: localhost\nAuthorization: Bearer 00"),
        401
    );
}

#[test]
fn over_a_network_everything_is_signed() {
    let get = "GET /api/v1/status HTTP/1.1\nHost: 10.0.0.5";
    assert_eq!(status(&NETWORK, get), 401);
    assert_eq!(status(&NETWORK, &format!("{get}\nAuthorization: Bearer {KEY}")), 401);
    let bearer = ask(&mut guard(), at(0), &NETWORK, &format!("{get}\nAuthorization: Bearer {KEY}"));
    let said = "Authorization must be a signature: over a network a key is never sent";
    assert_eq!(bearer.err().map(|refusal| refusal.text), Some(said));
    assert_eq!(status(&NETWORK, "GET /api/v1/nonce HTTP/1.1\nHost: 10.0.0.5"), 200);
    let mut guard = guard();
    let request = signed(&mut guard, at(0), "POST", "/api/v1/apply", b"{\"confirm_s\": 60}");
    let admitted = ask(&mut guard, at(1), &NETWORK, &request).unwrap();
    assert!(admitted.is_signed());
    let mut body = BodyHash::new();
    body.update(b"{\"confirm_s\": 60}");
    assert!(admitted.is_body(&body.clone().finish()));
    body.update(b" ");
    assert!(!admitted.is_body(&body.finish()));
    // The same request a second time.
    let refused = ask(&mut guard, at(1), &NETWORK, &request).unwrap_err();
    assert_eq!(
        (refused.status, refused.text),
        (StatusCode::UNAUTHORIZED, "this nonce was used; take a new one")
    );
    // A request that is too old.
    let request = signed(&mut guard, at(2), "POST", "/api/v1/confirm", b"");
    assert_eq!(ask(&mut guard, at(33), &NETWORK, &request).unwrap_err().status, StatusCode::UNAUTHORIZED);
    assert_eq!(guard.counters().replayed, 2);
    assert_eq!(guard.counters().wrong_key, 0);
}

#[test]
fn a_signature_is_for_one_request() {
    let mut guard = guard();
    let request = signed(&mut guard, at(0), "POST", "/api/v1/confirm", b"");
    for (from, to) in
        [("/confirm", "/rollback"), ("body=e3", "body=e4"), ("mac=", "mac=00"), ("nonce=", "nonce=0")]
    {
        let changed = request.replace(from, to);
        assert_ne!(changed, request);
        assert_eq!(
            ask(&mut guard, at(0), &NETWORK, &changed).unwrap_err().status,
            StatusCode::UNAUTHORIZED,
            "{to}"
        );
    }
    // A nonce of another run, with a valid signature.
    let other = Guard::new(Key::parse(KEY), [6; 32]).nonce(at(0));
    let foreign = with_nonce(&other, "POST", "/api/v1/confirm", b"");
    assert_eq!(ask(&mut guard, at(0), &NETWORK, &foreign).unwrap_err().status, StatusCode::UNAUTHORIZED);
    assert!(ask(&mut guard, at(0), &NETWORK, &request).is_ok(), "wrong requests do not use the nonce up");
}

#[test]
fn five_wrong_keys_and_even_the_right_one_waits() {
    let mut guard = guard();
    let wrong =
        format!("POST /api/v1/confirm HTTP/1.1\nHost: localhost\nAuthorization: Bearer {}", "0".repeat(32));
    let right = wrong.replace(&"0".repeat(32), KEY);
    for _ in 0..5 {
        assert_eq!(ask(&mut guard, at(0), &LOOPBACK, &wrong).unwrap_err().status, StatusCode::UNAUTHORIZED);
    }
    for request in [&wrong, &right] {
        let refused = ask(&mut guard, at(10), &LOOPBACK, request).unwrap_err();
        assert_eq!((refused.status, refused.retry_after_s), (StatusCode::TOO_MANY, Some(50)));
    }
    let read = "GET /api/v1/status HTTP/1.1\nHost: localhost";
    assert!(ask(&mut guard, at(10), &LOOPBACK, read).is_ok(), "who needs no key does not wait");
    assert!(ask(&mut guard, at(60), &LOOPBACK, &right).is_ok());
    assert_eq!((guard.counters().wrong_key, guard.counters().locked_out), (5, 2));
}

#[test]
fn without_a_key_nothing_can_be_changed_and_nothing_leaves_the_machine() {
    let mut guard = Guard::new(None, [5; 32]);
    let mut of =
        |site, request: &str| ask(&mut guard, at(0), site, request).map_or_else(|no| no.status.0, |_| 200);
    assert_eq!(of(&LOOPBACK, "GET /api/v1/status HTTP/1.1\nHost: localhost"), 200);
    let write = format!("POST /api/v1/confirm HTTP/1.1\nHost: localhost\nAuthorization: Bearer {KEY}");
    assert_eq!(of(&LOOPBACK, &write), 403);
    assert_eq!(of(&NETWORK, "GET /api/v1/status HTTP/1.1\nHost: 10.0.0.5"), 403);
}

#[test]
fn a_name_that_was_made_to_point_here_is_refused() {
    let get = |site, host: &str| status(site, &format!("GET /api/v1/nonce HTTP/1.1\nHost: {host}"));
    for host in [
        "evil.test",
        "evil.test:8480",
        "127.0.0.1.evil.test",
        "127.0.0.2",
        "10.0.0.5",
        "",
        ":80",
        "localhost.",
        "[::1]",
    ] {
        assert_eq!(get(&LOOPBACK, host), 421, "{host}");
    }
    for host in ["localhost", "LOCALHOST:9", "127.0.0.1", "127.0.0.1:8480", "127.0.0.1:"] {
        assert_eq!(get(&LOOPBACK, host), 200, "{host}");
    }
    assert_eq!(get(&NETWORK, "localhost"), 421);
    assert_eq!(get(&NETWORK, "Cell1:80"), 200);
    let six = IpAddr::V6(core::net::Ipv6Addr::LOCALHOST);
    let six = Site { local: six, peer: six, names: &[] };
    assert_eq!(get(&six, "[::1]:8480"), 200);
    assert_eq!(get(&six, "127.0.0.1"), 421);
}

#[test]
fn pages_of_other_servers_change_and_follow_nothing() {
    let auth = format!("Authorization: Bearer {KEY}");
    let of = |what: &str, more: &str| {
        status(&LOOPBACK, &format!("{what} HTTP/1.1\nHost: localhost:8480\n{auth}\n{more}"))
    };
    for request in ["POST /api/v1/confirm", "GET /api/v1/stream", "GET /api/v1/capture.pcapng"] {
        for more in [
            "Origin: http://evil.test",
            "Origin: null",
            "Origin: http://localhost:8481",
            "Origin: http://localhost",
            "Origin: file://",
            "Sec-Fetch-Site: cross-site",
            "Sec-Fetch-Site: same-site",
            "Origin: http://localhost:8480\nSec-Fetch-Site: same-site",
            "Origin: http://evil.test\nSec-Fetch-Site: same-origin",
        ] {
            assert_eq!(of(request, more), 403, "{request} {more}");
        }
        for more in
            ["X: y", "Origin: http://localhost:8480", "Sec-Fetch-Site: same-origin", "Sec-Fetch-Site: none"]
        {
            assert_eq!(of(request, more), 200, "{request} {more}");
        }
    }
    let check = "POST /api/v1/check HTTP/1.1\nHost: localhost\nContent-Type: application/toml\nOrigin: http://evil.test";
    assert_eq!(status(&LOOPBACK, check), 403);
    assert_eq!(
        status(&LOOPBACK, "OPTIONS /api/v1/confirm HTTP/1.1\nHost: localhost\nOrigin: http://evil.test"),
        405
    );
}

#[test]
fn arguments_are_known_and_come_once() {
    let asked = |target: &str| status(&LOOPBACK, &format!("GET {target} HTTP/1.1\nHost: localhost"));
    for right in
        ["info", "info?", "config?revision=1", "stream?frames=1&port=a", "stream?port=a", "log?lines="]
    {
        assert_eq!(asked(&format!("/api/v1/{right}")), 200, "{right}");
    }
    for wrong in ["info?x=1", "info?&", "log?lines", "log?Lines=1", "log?lines=1&lines=2", "log?lines=1&x=2"]
    {
        assert_eq!(asked(&format!("/api/v1/{wrong}")), 400, "{wrong}");
    }
}

#[test]
fn bodies_have_a_type_and_a_limit() {
    let of = |request: &str| {
        status(&LOOPBACK, &format!("{request}\nHost: localhost\nAuthorization: Bearer {KEY}"))
    };
    let put = "PUT /api/v1/config HTTP/1.1";
    assert_eq!(
        of(&format!("{put}\nContent-Type: application/toml; charset=utf-8\nContent-Length: 65536")),
        200
    );
    assert_eq!(of(&format!("{put}\nContent-Type: application/toml\nContent-Length: 65537")), 413);
    assert_eq!(of(&format!("{put}\nContent-Type: text/plain\nContent-Length: 1")), 415);
    assert_eq!(of(&format!("{put}\nContent-Length: 1")), 415);
    assert_eq!(of("POST /api/v1/apply HTTP/1.1"), 200);
    assert_eq!(of("POST /api/v1/apply HTTP/1.1\nContent-Length: 2"), 415);
    assert_eq!(
        of("POST /api/v1/apply HTTP/1.1\nContent-Type: application/x-www-form-urlencoded\nContent-Length: 2"),
        415
    );
    assert_eq!(of("GET /api/v1/info HTTP/1.1\nContent-Length: 1"), 413);
    assert_eq!(of("GET /api/v1/none HTTP/1.1"), 404);
}
