//! Records of port and link traffic for subscribers of `recipe_capture::Watch`.
//!
//! In, on the gateway's thread: the engine's tap and calls. They are written to a byte ring without waiting or
//! allocating; what does not fit is dropped and counted. Without subscribers a call costs one relaxed load. Out, on an
//! ordinary thread: owned records.

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use crate::snapshot::TAP;
use proto_core::engine::{
    Engine, Input, LinkId, MAX_TAPPED, Output, PortId, Rejection, Tap, TapDirection, TapPlace, TapRecord,
    TapVerdict,
};
use proto_core::record::{Entry, totals};
use proto_core::time::Instant;
use proto_core::wire::can::CanId;
use recipe_capture::{Cell, Frame, Record, Watch, What};
use rtrb::{Consumer, Producer, RingBuffer};

/// Bytes of the ring between the threads: more than a second of busy ports. Pages are allocated on first use.
const RING: usize = 8 << 20;
/// Maximum length of a message. Passes of an engine and its configuration are far shorter.
const MAX_MESSAGE: usize = 128 << 10;
/// Poll interval of the reader while the ring is empty. The gateway does not wake it: that would be a system call.
const READ_INTERVAL: Duration = Duration::from_millis(2);

#[derive(Debug)]
pub(super) struct Tapping {
    watch: Watch,
    ring: Producer<u8>,
    /// The message being built.
    message: Vec<u8>,
    is_too_long: bool,
    /// Passes are recorded from the start of the engine on.
    records_passes: bool,
    /// Lost since the last successful push: frames, passes.
    lost: [u32; 2],
    reader: Option<JoinHandle<()>>,
}

impl Tapping {
    /// Starts to record a gateway whose engine was not called yet. Passes are recorded if there is an image, which is
    /// the first entry of a recording.
    pub(super) fn begin(watch: &Watch, cell: Cell, at: Instant, image: Option<&[u8]>) -> io::Result<Self> {
        let (ring, consumer) = RingBuffer::new(RING);
        let began = Record { at, lost: 0, what: What::Began(Arc::new(cell)) };
        let reader = RingReader { watch: watch.clone(), ring: consumer, message: Vec::new() };
        let reader = std::thread::Builder::new().name("watch".to_owned()).spawn(move || reader.run(began))?;
        let mut tapping = Self {
            watch: watch.clone(),
            ring,
            message: Vec::with_capacity(MAX_MESSAGE),
            is_too_long: false,
            records_passes: image.is_some(),
            lost: [0; 2],
            reader: Some(reader),
        };
        if let Some(image) = image {
            tapping.head(PASS, at);
            tapping.entry(&Entry::Start { image });
            tapping.push(PASS);
        }
        Ok(tapping)
    }

    /// Called before the engine is.
    #[inline]
    pub(super) fn before(&mut self, tap: &mut Tap, at: Instant, input: Input<'_>) {
        let wanted = self.watch.wanted();
        if wanted.frames != tap.is_listening() {
            tap.listen(wanted.frames);
        }
        if self.records_passes {
            self.records_passes = wanted.passes;
            self.head(PASS, at);
            self.entry(&Entry::Input { at, input });
        }
    }

    /// Records a call of the engine's `make_safe`.
    pub(super) fn make_safe(&mut self, at: Instant) {
        if self.records_passes {
            self.head(PASS, at);
            self.entry(&Entry::MakeSafe);
            self.push(PASS);
        }
    }

    /// Records an output of the engine.
    #[inline]
    pub(super) fn output(&mut self, output: Output<'_>) {
        if self.records_passes {
            self.entry(&Entry::Output(output));
        }
    }

    #[inline]
    pub(super) fn behind(&mut self, tap: &mut Tap) {
        if self.records_passes {
            self.push(PASS);
        }
        if tap.is_listening() {
            self.drain(tap);
        }
    }

    /// Records the final totals of the engine.
    pub(super) fn end<const P: usize, const U: usize, const F: usize, const E: usize>(
        &mut self,
        engine: &Engine<P, U, F, TAP, E>,
        at: Instant,
    ) {
        if self.records_passes {
            self.head(PASS, at);
            self.entry(&Entry::Totals(&totals(engine)));
            self.push(PASS);
        }
    }

    #[cold]
    fn drain(&mut self, tap: &mut Tap) {
        let mut buffer = [0; MAX_TAPPED];
        while let Some(record) = tap.next(&mut buffer) {
            self.lost[0] = self.lost[0].saturating_add(record.lost);
            self.frame(&record);
            self.push(FRAME);
        }
    }

    fn frame(&mut self, record: &TapRecord<'_>) {
        let (kind, place) = match record.place {
            TapPlace::Port(port) => (0, port.0),
            TapPlace::Link(link) => (1, link.0),
        };
        let direction = u8::from(record.direction == TapDirection::Out);
        let verdict = match record.verdict {
            TapVerdict::Rejected(why) => {
                let nth = Rejection::ALL.iter().position(|other| *other == why).unwrap_or(0);
                u8::try_from(nth + 2).unwrap_or(u8::MAX)
            }
            TapVerdict::Link => 1,
            _ => 0,
        };
        let (has_id, id) = match record.can_id {
            None => (0, 0),
            Some(CanId::Standard(id)) => (1, u32::from(id)),
            Some(CanId::Extended(id)) => (2, id),
        };
        self.head(FRAME, record.at);
        self.put(&[kind, place, direction, verdict, has_id]);
        self.put(&id.to_le_bytes());
        self.put(&u32::try_from(record.len).unwrap_or(u32::MAX).to_le_bytes());
        self.put(record.bytes);
    }

    fn head(&mut self, kind: u8, at: Instant) {
        self.message.clear();
        self.is_too_long = false;
        let lost = self.lost[usize::from(kind == PASS)];
        // The length is written when it is known.
        self.put(&[0; 4]);
        self.put(&[kind]);
        self.put(&lost.to_le_bytes());
        self.put(&at.as_micros().to_le_bytes());
    }

    fn entry(&mut self, entry: &Entry<'_>) {
        entry.encode(|bytes| self.put(bytes));
    }

    /// Appends to the message without allocating.
    fn put(&mut self, bytes: &[u8]) {
        if self.message.capacity() - self.message.len() >= bytes.len() {
            self.message.extend_from_slice(bytes);
        } else {
            self.is_too_long = true;
        }
    }

    /// Pushes the message to the ring, or drops and counts it.
    fn push(&mut self, kind: u8) {
        let len = u32::try_from(self.message.len()).unwrap_or(0);
        if let Some(place) = self.message.first_chunk_mut() {
            *place = len.to_le_bytes();
        }
        let lost = &mut self.lost[usize::from(kind == PASS)];
        let is_kept = !self.is_too_long && self.ring.push_entire_slice(&self.message).is_ok();
        *lost = if is_kept { 0 } else { lost.saturating_add(1) };
    }
}

impl Drop for Tapping {
    fn drop(&mut self) {
        // The reader drains the ring once it is abandoned.
        let (ring, _) = RingBuffer::new(0);
        self.ring = ring;
        if let Some(reader) = self.reader.take() {
            reader.thread().unpark();
            let _ = reader.join();
        }
    }
}

/// The reading side of the ring, on a thread of its own.
struct RingReader {
    watch: Watch,
    ring: Consumer<u8>,
    message: Vec<u8>,
}

impl RingReader {
    fn run(mut self, began: Record) {
        self.watch.read_here();
        self.watch.give(began);
        loop {
            // Checked before draining: an abandoned ring gets no more messages.
            let is_abandoned = self.ring.is_abandoned();
            while let Some(record) = self.next() {
                self.watch.give(record);
            }
            if is_abandoned {
                return;
            }
            if self.watch.wanted() == recipe_capture::Interest::default() {
                std::thread::park();
            } else {
                std::thread::park_timeout(READ_INTERVAL);
            }
        }
    }

    fn next(&mut self) -> Option<Record> {
        let mut len = [0; 4];
        self.ring.pop_entire_slice(&mut len).ok()?;
        // Messages are pushed as a whole.
        self.message.resize((u32::from_le_bytes(len) as usize).saturating_sub(len.len()), 0);
        self.ring.pop_entire_slice(&mut self.message).ok()?;
        parse(&self.message)
    }
}

fn parse(message: &[u8]) -> Option<Record> {
    let (&kind, rest) = message.split_first()?;
    let (lost, rest) = rest.split_first_chunk()?;
    let (at, rest) = rest.split_first_chunk()?;
    let what = match kind {
        PASS => What::Pass(rest.into()),
        _ => {
            let (&[kind, place, direction, verdict, has_id], rest) = rest.split_first_chunk()?;
            let (id, rest) = rest.split_first_chunk()?;
            let (len, bytes) = rest.split_first_chunk()?;
            let id = u32::from_le_bytes(*id);
            What::Frame(Frame {
                place: if kind == 0 { TapPlace::Port(PortId(place)) } else { TapPlace::Link(LinkId(place)) },
                direction: if direction == 0 { TapDirection::In } else { TapDirection::Out },
                verdict: match verdict {
                    0 => TapVerdict::Taken,
                    1 => TapVerdict::Link,
                    nth => TapVerdict::Rejected(*Rejection::ALL.get(usize::from(nth) - 2)?),
                },
                can_id: match has_id {
                    0 => None,
                    1 => Some(CanId::Standard(u16::try_from(id).ok()?)),
                    _ => Some(CanId::Extended(id)),
                },
                len: u32::from_le_bytes(*len) as usize,
                bytes: bytes.into(),
            })
        }
    };
    Some(Record { at: Instant::from_micros(u64::from_le_bytes(*at)), lost: u32::from_le_bytes(*lost), what })
}

const FRAME: u8 = 0;
const PASS: u8 = 1;

#[cfg(test)]
#[path = "tapping_tests.rs"]
mod tests;
