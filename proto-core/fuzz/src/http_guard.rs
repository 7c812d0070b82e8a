//! Requests with right, wrong and repeated keys, signatures and nonces, at any times, against a list of all that
//! was given out and used.

use std::net::{IpAddr, Ipv4Addr};

use proto_core::time::{Duration, Instant};
use recipe_api::guard::{Guard, Site};
use recipe_api::key::{BodyHash, Hex, Key, SCHEME, Signed};
use recipe_api::request::HeadBuffer;
use recipe_api::route::Served;

use crate::source::Source;

const KEY: &str = "00112233445566778899aabbccddeeff";
const OTHER: &str = "00112233445566778899aabbccddeefe";

/// What is known of a nonce.
struct Given {
    text: String,
    at: Instant,
    is_used: bool,
}

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let has_key = !input.u8().is_multiple_of(8);
    let mut guard = Guard::new(has_key.then(|| Key::parse(KEY)).flatten(), [7; 32]);
    let mut now = Instant::from_micros(1_000_000);
    let mut given: Vec<Given> = Vec::new();
    // When each address sent wrong keys.
    let mut wrong: Vec<(IpAddr, Instant)> = Vec::new();
    // When right signatures were used.
    let mut used: Vec<Instant> = Vec::new();
    let mut expected = [0_u32; 2];
    while !input.is_empty() {
        let kind = input.u8();
        if kind < 60 {
            now += Duration::from_millis(u64::from(kind) * u64::from(kind) * 10);
            continue;
        }
        if kind < 90 || given.is_empty() {
            given.push(Given { text: guard.nonce(now).to_string(), at: now, is_used: false });
            continue;
        }
        let is_local = kind & 1 == 0;
        let peer = if is_local { [127, 0, 0, 1] } else { [10, 0, 0, 1 + (kind >> 1) % 3] };
        let peer = IpAddr::V4(Ipv4Addr::from(peer));
        let local = IpAddr::V4(Ipv4Addr::from(if is_local { [127, 0, 0, 1] } else { [10, 0, 0, 9] }));
        let (host, is_host) = match input.u8() % 16 {
            0 => ("evil.test".to_owned(), false),
            1 => ("10.0.0.8".to_owned(), false),
            _ => (format!("{local}:8480"), true),
        };
        let (origin, is_own) = match input.u8() % 16 {
            0 => ("Origin: http://evil.test\r\n".to_owned(), false),
            1 => ("Sec-Fetch-Site: cross-site\r\n".to_owned(), false),
            2 => (format!("Origin: http://{host}\r\n"), true),
            _ => (String::new(), true),
        };
        let nth = input.below(given.len());
        let (key, is_right) = if input.u8().is_multiple_of(4) { (OTHER, false) } else { (KEY, true) };
        let way = input.u8() % 8;
        let nonce = &given[nth];
        let target = "/api/v1/confirm";
        let shown = match way {
            0 => String::new(),
            1 | 2 => format!("Authorization: Bearer {key}\r\n"),
            _ => {
                let body = Hex(&BodyHash::new().finish()).to_string();
                let signed = Signed { nonce: &nonce.text, method: "POST", target, body: &body };
                let mac = Key::parse(key).expect("32 digits").sign(&signed);
                format!("Authorization: {SCHEME} nonce={}, body={body}, mac={}\r\n", nonce.text, Hex(&mac))
            }
        };
        let text = format!("POST {target} HTTP/1.1\r\nHost: {host}\r\n{origin}{shown}\r\n");
        let mut buffer = HeadBuffer::new();
        assert_eq!(buffer.push(text.as_bytes()), text.len());
        let site = Site { local, peer, names: &[] };
        let admitted = guard.admit(now, &buffer.head().expect("a right head"), &site, Served::Gateway);

        wrong.retain(|(_, at)| now.saturating_since(*at) < Duration::from_secs(60));
        let is_locked = wrong.iter().filter(|(address, _)| *address == peer).count() >= 5;
        let is_seen = has_key && is_host && is_own && !is_locked;
        let is_bearer = matches!(way, 1 | 2);
        let is_shown = is_bearer && is_local || way > 2;
        if is_seen && is_shown && !is_right {
            wrong.push((peer, now));
            expected[1] += 1;
        }
        let is_young = now.saturating_since(nonce.at) <= Duration::from_secs(30);
        let is_valid = is_seen && is_shown && is_right && (is_bearer || is_young && !nonce.is_used);
        // With so many used at about the same time, an older one may be refused before its time.
        let may_be_forgotten = !is_bearer && used.len() >= 64;
        match (&admitted, is_valid) {
            (Ok(_), false) => panic!("admitted: {text}"),
            (Err(refusal), true) if !may_be_forgotten => panic!("{}: {text}", refusal.text),
            _ => {}
        }
        if admitted.is_ok() {
            expected[0] += 1;
            if !is_bearer {
                given[nth].is_used = true;
                used.push(now);
            }
        }
    }
    let counters = guard.counters();
    assert_eq!([counters.admitted, counters.wrong_key], expected);
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    // A request: kind, host, origin, nonce, key, way.
    let request = |kind: u8, key: u8, way: u8| [kind, 9, 9, 0, key, way];
    let nonce = [1, 70];
    vec![
        [&nonce[..], &request(100, 1, 1), &request(101, 1, 5), &request(101, 1, 5)].concat(),
        [&nonce[..], &request(101, 1, 0), &[55], &request(101, 1, 5)].concat(),
        [&nonce[..], &request(100, 0, 1).repeat(6), &request(100, 1, 1), &[59, 59], &request(100, 1, 1)]
            .concat(),
        [&nonce[..], &request(103, 0, 5).repeat(5), &request(105, 1, 5)].concat(),
        [&[0, 70][..], &request(100, 1, 1)].concat(),
        [&[1, 70][..], &[100, 0, 9, 0, 1, 1], &[100, 9, 0, 0, 1, 1], &[100, 9, 2, 0, 1, 1]].concat(),
    ]
}
