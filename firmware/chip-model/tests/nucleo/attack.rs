//! A cell under load whose console is watched by some and attacked by others, against the same cell alone: the same
//! frames, cycles and counters, and how much later things may be.
//!
//! Everything is in virtual time, so the same happens in every run. `CHIP_ATTACK` is the number of hostile connections
//! (default 150).

use recipe_chip_model::device::{MILLI, Picos, SECOND};
use smoltcp::iface::SocketHandle;

use crate::Bench;
use crate::client::{WIDE, ask, ask_signed, browser, claim, connection, open, read, signed};
use crate::load::work;
use crate::page::cyclic;

/// Between two hostile connections.
const EVERY: Picos = 25 * MILLI;
/// How long one is held that does nothing; one in sixteen is given up by the board.
const HELD: [Picos; 2] = [60 * MILLI, 6 * SECOND];
/// How much later a cycle may be for all of this: the longest that a connection keeps the others waiting.
const LATER: Picos = MILLI;
/// A hostile connection.
struct Hostile {
    handle: SocketHandle,
    /// What it sends once connected.
    says: Option<Vec<u8>>,
    /// Whether it reads.
    reads: bool,
    /// When it is reset.
    ends: Picos,
}

impl Hostile {
    fn new(bench: &mut Bench, nth: usize) -> Self {
        let browser = browser();
        let whole = |line: &str, fields: &str, body: &[u8]| browser.bytes(line, fields, body);
        let held = HELD[usize::from(nth % 128 >= 120)];
        let nonce = "0000000928a724da00000000c27868a9e87ad27a773140a5";
        // Mixed, so that a held connection does not always block the same ones.
        let kind = (nth as u32).wrapping_mul(0x9E37_79B9) >> 29;
        let (says, reads, held) = match kind {
            // Half a request, and silence.
            0 => (b"GET /api/v1/info HTTP/1.1\r\nHost: ".to_vec(), false, held),
            // A head that is too long.
            1 => (whole("GET /", &format!("X: {}", "x".repeat(4000)), b""), true, held),
            // A wrong signature.
            2 => (whole("GET /api/v1/status", &browser.signature(nonce, "GET /", b""), b""), true, held),
            // A reset in the middle.
            3 => (whole("GET /", "", b""), false, 5 * MILLI),
            // One that does not read.
            4 => (whole("GET /", "", b""), false, held),
            // No HTTP.
            5 => (vec![0xA5; 3000], true, held),
            // An announced body that never comes.
            6 => (
                whole("PUT /api/v1/config", "Content-Type: application/octet-stream", &[0; 4000]),
                false,
                held,
            ),
            // Nothing at all.
            _ => (Vec::new(), false, held),
        };
        let size = if reads { WIDE } else { 1024 };
        Self { handle: open(bench, size), says: Some(says), reads, ends: bench.now() + held }
    }

    /// Returns whether it goes on.
    fn go_on(&mut self, bench: &mut Bench) -> bool {
        let now = bench.now();
        let socket = connection(bench, self.handle);
        if socket.may_send()
            && let Some(says) = self.says.take()
        {
            let _ = socket.send_slice(&says);
        }
        if self.reads {
            let _ = socket.recv(|bytes| (bytes.len(), ()));
        }
        if now < self.ends && socket.is_open() {
            return true;
        }
        let is_closed = !socket.is_open();
        socket.abort();
        if is_closed {
            bench.robot.as_mut().expect("there is one").forget(self.handle);
        }
        !is_closed
    }
}

/// Clients that watch: two streams, one of them of frames, and one that reloads the page.
struct Watchers {
    streams: [SocketHandle; 2],
    /// And whether it has asked.
    page: Option<(SocketHandle, bool)>,
    /// Bytes of the page.
    received: usize,
    pages: usize,
    events: [usize; 2],
}

impl Watchers {
    fn new(bench: &mut Bench) -> Self {
        let streams = ["GET /api/v1/stream?frames=1", "GET /api/v1/stream"].map(|line| {
            let request = signed(bench, line);
            ask(bench, &request, WIDE)
        });
        Self { streams, page: None, received: 0, pages: 0, events: [0; 2] }
    }

    fn go_on(&mut self, bench: &mut Bench) {
        for (handle, events) in self.streams.iter().zip(&mut self.events) {
            let mut bytes = Vec::new();
            read(bench, *handle, WIDE, &mut bytes);
            *events += bytes.windows(7).filter(|seven| *seven == b"event: ").count();
            assert!(connection(bench, *handle).may_recv(), "a stream has ended");
        }
        let Some((handle, is_asked)) = &mut self.page else {
            self.page = Some((open(bench, WIDE), false));
            return;
        };
        let socket = connection(bench, *handle);
        if socket.may_send() && !std::mem::replace(is_asked, true) {
            let _ = socket.send_slice(&browser().bytes("GET /", "", b""));
        }
        // A connection that found no place, or a whole answer.
        if !socket.is_open() {
            bench.robot.as_mut().expect("there is one").forget(*handle);
            self.page = None;
        } else if *is_asked {
            let mut bytes = vec![0; WIDE];
            self.received += socket.recv_slice(&mut bytes).unwrap_or(0);
            if !socket.may_recv() {
                self.pages += usize::from(std::mem::take(&mut self.received) > recipe_console::PAGE.len());
                socket.abort();
            }
        }
    }
}

fn claimed() -> Bench {
    let mut bench = cyclic();
    claim(&mut bench);
    bench
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn who_watches_or_attacks_the_console_costs_the_cell_no_frame_and_no_cycle() {
    let count = std::env::var("CHIP_ATTACK").map_or(150, |text| text.parse().expect("CHIP_ATTACK"));
    let span = count as Picos * EVERY;
    let alone = work(&mut claimed(), span, |_| {});
    let mut bench = claimed();
    let mut watchers = Watchers::new(&mut bench);
    let mut hostile: Vec<Hostile> = Vec::new();
    let (begin, mut begun) = (bench.now(), 0);
    let attacked = work(&mut bench, span, |bench| {
        watchers.go_on(bench);
        if begun < count && bench.now() - begin >= begun as Picos * EVERY {
            hostile.push(Hostile::new(bench, begun));
            begun += 1;
        }
        hostile.retain_mut(|hostile| hostile.go_on(bench));
    });
    let console = ask_signed(&mut bench, "GET /api/v1/info").json()["console"].clone();
    let seconds = span as f64 / SECOND as f64;
    println!(
        "{seconds} s, {count} hostile connections, {} pages, {:?} events; {console}",
        watchers.pages, watchers.events
    );
    attacked.is_like(&alone, "attacked", LATER);
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
    // They were served, not only refused by the network.
    for counter in [&console["requests"]["without_key"], &console["counters"]["incomplete"]] {
        assert!(counter.as_u64() > Some(3), "{console}");
    }
    assert!(watchers.events.iter().all(|events| *events as f64 >= seconds * 5.0), "{:?}", watchers.events);
}
