//! An RS-485 line: one port of the gateway or of the controller, and a device.

use std::collections::VecDeque;

use proto_core::config::Rs485;
use proto_core::time::{Duration, Instant};

use super::device::Device;
use super::rng::Rng;
use super::{AnyPort, End};

/// How the receiver's driver reports bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Chunking {
    /// Each transmission as a whole, when its last byte has arrived.
    Whole,
    /// In pieces of this many bytes, each when its last byte has arrived.
    Pieces(usize),
    /// In pieces of 1 to this many bytes.
    Random(usize),
    /// Like a USB adapter: received bytes are buffered and reported at each multiple of this duration.
    Gathered(Duration),
}

/// How the two ends are wired.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wiring {
    /// Both ends share one pair: simultaneous transmissions corrupt each other.
    TwoWire,
    /// Each direction has its own pair, as on a pseudoterminal.
    FourWire,
}

/// Counters of a line, in addition to those of its ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineCounters {
    /// Transmissions of the device.
    pub device_sent: u64,
    /// Bytes that the device sent.
    pub device_bytes: u64,
    /// Transmissions of the port.
    pub port_sent: u64,
    /// Bytes that the port sent.
    pub port_bytes: u64,
    /// Transmissions that began while the other end was sending.
    pub overlaps: u64,
    /// Bytes that were corrupted on the line.
    pub garbled_bytes: u64,
    /// Bytes that were lost on the line.
    pub lost_bytes: u64,
}

/// A line.
pub struct Line {
    pub(super) owner: AnyPort,
    settings: Rs485,
    /// How received bytes are reported, at both ends.
    pub chunking: Chunking,
    /// How the ends are joined.
    pub wiring: Wiring,
    /// Number of bytes per million that have a bit flipped.
    pub noise_ppm: u32,
    /// The port's adapter echoes what the port sends, whatever the configuration says.
    pub gives_back: bool,
    /// Counters.
    pub counters: LineCounters,
    pub(super) connected: bool,
    /// The port's adapter is plugged in.
    pub(super) is_plugged: bool,
    pub(super) device: Option<Box<dyn Device<Vec<u8>>>>,
    busy_until: [Instant; 2],
    collision: (Instant, Instant),
    heard: VecDeque<(Instant, Vec<u8>)>,
    pub(super) keep_heard: usize,
    /// Bytes that were gathered but not reported yet.
    pub(super) gathered: Vec<u8>,
    rng: Rng,
}

/// A piece of a transmission.
#[derive(Debug)]
pub(super) struct Chunk {
    pub from: End,
    pub began: Instant,
    pub bytes: Vec<u8>,
    pub is_first: bool,
    pub is_last: bool,
}

impl std::fmt::Debug for Line {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { owner, settings, counters, connected, .. } = self;
        f.debug_struct("Line")
            .field("owner", owner)
            .field("settings", settings)
            .field("counters", counters)
            .field("connected", connected)
            .finish_non_exhaustive()
    }
}

impl Line {
    pub(super) fn new(owner: AnyPort, settings: Rs485, rng: Rng) -> Self {
        Self {
            owner,
            settings,
            chunking: Chunking::Whole,
            wiring: Wiring::FourWire,
            noise_ppm: 0,
            gives_back: false,
            counters: LineCounters::default(),
            connected: true,
            is_plugged: true,
            device: None,
            busy_until: [Instant::ZERO; 2],
            collision: (Instant::ZERO, Instant::ZERO),
            heard: VecDeque::new(),
            keep_heard: MAX_HEARD,
            gathered: Vec::new(),
            rng,
        }
    }

    /// The line's settings.
    pub fn settings(&self) -> &Rs485 {
        &self.settings
    }

    /// When the device's newest transmission ends.
    pub fn device_done_at(&self) -> Instant {
        self.busy_until[End::Device as usize]
    }

    /// The transmissions of the port since the last call, each with the time of its last byte. The newest [`MAX_HEARD`]
    /// are kept.
    pub fn take_heard(&mut self) -> Vec<(Instant, Vec<u8>)> {
        self.heard.drain(..).collect()
    }

    /// Starts a transmission on the line. `each` gets the arrival time of each piece, in order.
    pub(super) fn send(
        &mut self,
        now: Instant,
        from: End,
        bytes: &[u8],
        mut each: impl FnMut(Instant, Chunk),
    ) {
        let other = self.busy_until[1 - from as usize];
        let start = now.max(self.busy_until[from as usize]);
        let end = start + self.settings.time_on_line(bytes.len());
        self.busy_until[from as usize] = end;
        match from {
            End::Port => {
                self.counters.port_sent += 1;
                self.counters.port_bytes += bytes.len() as u64;
            }
            End::Device => {
                self.counters.device_sent += 1;
                self.counters.device_bytes += bytes.len() as u64;
            }
        }
        if start < other {
            self.counters.overlaps += 1;
            if self.wiring == Wiring::TwoWire {
                self.collision = (start, end.min(other));
            }
        }
        let (mut at, mut began) = (0, start);
        while at < bytes.len() {
            let left = bytes.len() - at;
            let len = match self.chunking {
                Chunking::Whole | Chunking::Gathered(_) => left,
                Chunking::Pieces(len) => len.clamp(1, left),
                Chunking::Random(most) => (self.rng.between(1, most.max(1) as u64) as usize).min(left),
            };
            let arrival = start + self.settings.time_on_line(at + len);
            let bytes_of = bytes[at..at + len].to_vec();
            let is_first = at == 0;
            at += len;
            let is_last = at == bytes.len();
            each(arrival, Chunk { from, began, bytes: bytes_of, is_first, is_last });
            began = arrival;
        }
    }

    /// Applies collisions and noise to a piece; returns false if the line is cut.
    pub(super) fn deliver(&mut self, now: Instant, chunk: &mut Chunk) -> bool {
        if !self.connected {
            self.counters.lost_bytes += chunk.bytes.len() as u64;
            return false;
        }
        let (from, to) = self.collision;
        let collided = chunk.began < to && now > from;
        for byte in &mut chunk.bytes {
            if collided || self.rng.chance(self.noise_ppm) {
                *byte ^= 1 << self.rng.below(8);
                self.counters.garbled_bytes += 1;
            }
        }
        true
    }

    /// Keeps a transmission of the port for inspection.
    pub(super) fn hear(&mut self, now: Instant, bytes: &[u8], is_first: bool) {
        if let Some(newest) = self.heard.back_mut().filter(|_| !is_first) {
            newest.0 = now;
            newest.1.extend_from_slice(bytes);
            return;
        }
        if self.keep_heard == 0 {
            return;
        }
        if self.heard.len() >= self.keep_heard {
            self.heard.pop_front();
        }
        self.heard.push_back((now, bytes.to_vec()));
    }

    /// The transmission time of this many bytes.
    pub fn time_of(&self, len: usize) -> Duration {
        self.settings.time_on_line(len)
    }
}

/// Number of transmissions or frames kept for inspection.
pub const MAX_HEARD: usize = 100_000;
