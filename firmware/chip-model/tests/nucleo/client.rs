//! Clients of the board's console, over the test's TCP.

use recipe_api::key::Key;
use recipe_chip_model::device::{MILLI, SECOND};
use recipe_test_kit::http::{self, Response};
use smoltcp::iface::SocketHandle;
use smoltcp::socket::tcp;
use smoltcp::wire::{IpAddress, IpEndpoint, Ipv4Address};

use crate::Bench;

/// Address of the board in the cells of these tests.
const BOARD: IpEndpoint = IpEndpoint { addr: IpAddress::Ipv4(Ipv4Address::new(192, 168, 12, 20)), port: 80 };
/// What a browser announces at least.
pub(crate) const WIDE: usize = 64 << 10;
const KEY: &str = "00112233445566778899aabbccddeeff";

/// Begins a connection; `size` bytes are buffered for reading.
pub(crate) fn open(bench: &mut Bench, size: usize) -> SocketHandle {
    bench.robot.as_mut().expect("there is one").connect(BOARD, size)
}

pub(crate) fn connection(bench: &mut Bench, handle: SocketHandle) -> &mut tcp::Socket<'static> {
    bench.robot.as_mut().expect("there is one").connection(handle)
}

/// Takes at most `most` bytes of what has come.
pub(crate) fn read(bench: &mut Bench, handle: SocketHandle, most: usize, into: &mut Vec<u8>) {
    let mut bytes = vec![0; most];
    let count = connection(bench, handle).recv_slice(&mut bytes).unwrap_or(0);
    into.extend_from_slice(&bytes[..count]);
}

/// Opens a connection and sends a request.
#[track_caller]
pub(crate) fn ask(bench: &mut Bench, request: &[u8], size: usize) -> SocketHandle {
    let handle = open(bench, size);
    bench.until("a connection", SECOND, |bench| connection(bench, handle).may_send());
    connection(bench, handle).send_slice(request).expect("there is room");
    handle
}

/// The reply.
#[track_caller]
pub(crate) fn exchange(bench: &mut Bench, request: &[u8]) -> Response {
    let handle = open(bench, WIDE);
    bench.until("a connection", SECOND, |bench| connection(bench, handle).may_send());
    let (mut bytes, mut rest) = (Vec::new(), request);
    bench.until("the end of an answer", 5 * SECOND, |bench| {
        // More than the buffer of a socket.
        let sent = connection(bench, handle).send_slice(rest).unwrap_or(0);
        rest = &rest[sent..];
        read(bench, handle, WIDE, &mut bytes);
        !connection(bench, handle).may_recv()
    });
    // Its place is free at once.
    connection(bench, handle).abort();
    bench.run(2 * MILLI);
    bench.robot.as_mut().expect("there is one").forget(handle);
    Response::parse(&bytes).expect("a head")
}

/// The other end of HTTP: what it sends is sent by [`exchange`].
pub(crate) fn browser() -> http::Client {
    http::Client {
        to: ([192, 168, 12, 20], 80).into(),
        host: "192.168.12.20".to_owned(),
        key: Key::parse(KEY),
    }
}

/// Bytes of a signed request.
#[track_caller]
pub(crate) fn signed(bench: &mut Bench, line: &str) -> Vec<u8> {
    signed_with(bench, line, "", b"")
}

/// Bytes of a signed request with more fields and a body.
#[track_caller]
pub(crate) fn signed_with(bench: &mut Bench, line: &str, more: &str, body: &[u8]) -> Vec<u8> {
    let browser = browser();
    let nonce = exchange(bench, &browser.bytes("GET /api/v1/nonce", "", b"")).must_be(200).json();
    let mut fields = browser.signature(nonce["nonce"].as_str().expect("a text"), line, body);
    if !more.is_empty() {
        fields = format!("{fields}\n{more}");
    }
    browser.bytes(line, &fields, body)
}

/// The reply to a signed request. Waits as long as the board demands after wrong keys from the same address.
#[track_caller]
pub(crate) fn ask_signed(bench: &mut Bench, line: &str) -> Response {
    loop {
        let request = signed(bench, line);
        let answer = exchange(bench, &request);
        let Some(wait) = answer.field("Retry-After") else { return answer.must_be(200) };
        let seconds: u64 = wait.parse().expect("a number");
        bench.run((seconds + 1) * SECOND);
    }
}

/// Presses the button, and gives the board the key.
#[track_caller]
pub(crate) fn claim(bench: &mut Bench) {
    let now = bench.now();
    bench.chip.devices().press_button(now, 200 * MILLI);
    bench.run(300 * MILLI);
    let body = format!("{{\"key\": \"{KEY}\"}}");
    let request = browser().bytes("POST /api/v1/claim", "Content-Type: application/json", body.as_bytes());
    exchange(bench, &request).must_be(200);
}
