//! A tap on ports and links, for a trace, a capture or a page.
//!
//! In: frames and bytes, and whether they were accepted. Out: records, in order. The ring is bounded and lossy: records
//! that do not fit are counted, and the engine never waits for a reader. A tap that does not listen costs one branch.

use super::io::{LinkId, PortId};
use super::rejection::Rejection;
use crate::time::Instant;
use crate::wire::can::CanId;

/// Maximum number of bytes in a record; longer data is cut off.
pub const MAX_TAPPED: usize = 1536;

/// The place of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TapPlace {
    /// A field port.
    Port(PortId),
    /// A link to the controller.
    Link(LinkId),
}

/// The direction of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TapDirection {
    /// To the gateway.
    In,
    /// From the gateway.
    Out,
}

/// The verdict on a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum TapVerdict {
    /// A whole frame or datagram was accepted, or bytes were handed over for sending.
    Taken,
    /// Bytes or a datagram of a link, as received; replies, packets and frames are found in them later.
    Link,
    /// It was rejected as a whole.
    Rejected(Rejection),
}

/// One record: data that passed over a port or link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TapRecord<'a> {
    /// When it was reported to the engine, or handed over.
    pub at: Instant,
    /// The port or link.
    pub place: TapPlace,
    /// The direction.
    pub direction: TapDirection,
    /// The verdict.
    pub verdict: TapVerdict,
    /// The frame's id on a CAN bus.
    pub can_id: Option<CanId>,
    /// Length in bytes; greater than that of `bytes` if the data was cut to [`MAX_TAPPED`].
    pub len: usize,
    /// The bytes.
    pub bytes: &'a [u8],
    /// Number of records lost since the previous one.
    pub lost: u32,
}

/// The ring. `Tap<[u8; N]>` has `N` bytes; each record takes its contents and [`TAP_OVERHEAD`] bytes. A ring too small
/// for one record never listens.
#[derive(Debug, Clone)]
pub struct Tap<R: ?Sized = [u8]> {
    is_listening: bool,
    /// Number of records lost since the newest kept one.
    lost: u32,
    /// Where the oldest record begins.
    start: usize,
    used: usize,
    ring: R,
}

/// Number of bytes that a record takes in addition to its contents.
pub const TAP_OVERHEAD: usize = 23;

/// Data for a record.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tapped<'a> {
    pub at: Instant,
    pub place: TapPlace,
    pub direction: TapDirection,
    pub verdict: TapVerdict,
    pub can_id: Option<CanId>,
    /// Head, payload and tail of a frame, or all bytes in one piece.
    pub pieces: [&'a [u8]; 3],
}

impl<const N: usize> Tap<[u8; N]> {
    /// An empty ring that does not listen; all bytes are 0.
    pub(super) const fn new() -> Self {
        Self { is_listening: false, lost: 0, start: 0, used: 0, ring: [0; N] }
    }
}

impl<R: ?Sized> Tap<R> {
    /// Whether records are kept.
    pub fn is_listening(&self) -> bool {
        self.is_listening
    }
}

impl Tap {
    pub(super) fn record<'a>(&mut self, what: impl FnOnce() -> Tapped<'a>) {
        if self.is_listening {
            self.keep(&what());
        }
    }

    /// Records data handed over for sending.
    pub(super) fn went(&mut self, place: TapPlace, can_id: Option<CanId>, bytes: &[u8], at: Instant) {
        let (direction, verdict) = (TapDirection::Out, TapVerdict::Taken);
        self.record(|| Tapped { at, place, direction, verdict, can_id, pieces: [bytes, &[], &[]] });
    }

    /// Records bytes, or a datagram, received on a link.
    pub(super) fn came(&mut self, link: LinkId, bytes: &[u8], at: Instant) {
        let (place, direction, verdict) = (TapPlace::Link(link), TapDirection::In, TapVerdict::Link);
        self.record(|| Tapped { at, place, direction, verdict, can_id: None, pieces: [bytes, &[], &[]] });
    }

    /// Starts or stops listening; both clear the ring.
    pub fn listen(&mut self, listen: bool) {
        self.is_listening = listen && self.ring.len() > TAP_OVERHEAD;
        (self.lost, self.start, self.used) = (0, 0, 0);
    }

    /// Removes and returns the oldest record; `None` if there is none. Its bytes are written to `room`, which should
    /// have [`MAX_TAPPED`] bytes: a longer record is cut off.
    pub fn next<'b>(&mut self, room: &'b mut [u8]) -> Option<TapRecord<'b>> {
        if self.used < TAP_OVERHEAD {
            return None;
        }
        let at = Instant::from_micros(u64::from_le_bytes(self.array()));
        let lost = u32::from_le_bytes(self.array());
        let id = u32::from_le_bytes(self.array());
        let len = usize::from(u16::from_le_bytes(self.array()));
        let kept = usize::from(u16::from_le_bytes(self.array()));
        let [place, verdict, flags] = self.array();
        let (bytes, _) = room.split_at_mut_checked(kept.min(room.len()))?;
        self.pull(bytes);
        self.forget(kept.saturating_sub(bytes.len()));
        Some(TapRecord {
            at,
            place: if flags & IS_LINK == 0 {
                TapPlace::Port(PortId(place))
            } else {
                TapPlace::Link(LinkId(place))
            },
            direction: if flags & IS_OUT == 0 { TapDirection::In } else { TapDirection::Out },
            verdict: verdict_of(verdict),
            can_id: match flags & (HAS_ID | IS_EXTENDED) {
                0 => None,
                HAS_ID => Some(CanId::Standard(id as u16)),
                _ => Some(CanId::Extended(id)),
            },
            len,
            bytes,
            lost,
        })
    }

    fn keep(&mut self, what: &Tapped<'_>) {
        let len = what.pieces.iter().fold(0_usize, |len, piece| len.saturating_add(piece.len()));
        let kept = len.min(MAX_TAPPED);
        if self.ring.len().saturating_sub(self.used) < kept.saturating_add(TAP_OVERHEAD) {
            self.lost = self.lost.saturating_add(1);
            return;
        }
        let lost = core::mem::take(&mut self.lost);
        let (place, mut flags) = match what.place {
            TapPlace::Port(port) => (port.0, 0),
            TapPlace::Link(link) => (link.0, IS_LINK),
        };
        if what.direction == TapDirection::Out {
            flags |= IS_OUT;
        }
        let id = match what.can_id {
            None => 0,
            Some(CanId::Standard(id)) => {
                flags |= HAS_ID;
                u32::from(id)
            }
            Some(CanId::Extended(id)) => {
                flags |= HAS_ID | IS_EXTENDED;
                id
            }
        };
        self.push(&what.at.as_micros().to_le_bytes());
        self.push(&lost.to_le_bytes());
        self.push(&id.to_le_bytes());
        self.push(&u16::try_from(len).unwrap_or(u16::MAX).to_le_bytes());
        self.push(&(kept as u16).to_le_bytes());
        self.push(&[place, code_of(what.verdict), flags]);
        let mut left = kept;
        for piece in what.pieces {
            let (piece, _) = piece.split_at_checked(left.min(piece.len())).unwrap_or((piece, &[]));
            self.push(piece);
            left = left.saturating_sub(piece.len());
        }
    }

    /// Appends bytes; the caller has checked that they fit.
    fn push(&mut self, bytes: &[u8]) {
        let end = wrapped(self.start.saturating_add(self.used), self.ring.len());
        let (before, behind) = self.ring.split_at_mut_checked(end).unwrap_or((&mut [], &mut []));
        for (place, &byte) in behind.iter_mut().chain(before).zip(bytes) {
            *place = byte;
        }
        self.used = self.used.saturating_add(bytes.len());
    }

    /// Removes the first bytes; the caller has checked that they exist.
    fn pull(&mut self, into: &mut [u8]) {
        let (before, behind) = self.ring.split_at_checked(self.start).unwrap_or((&[], &[]));
        for (place, &byte) in into.iter_mut().zip(behind.iter().chain(before)) {
            *place = byte;
        }
        self.forget(into.len());
    }

    fn array<const LEN: usize>(&mut self) -> [u8; LEN] {
        let mut bytes = [0; LEN];
        self.pull(&mut bytes);
        bytes
    }

    fn forget(&mut self, len: usize) {
        self.start = wrapped(self.start.saturating_add(len), self.ring.len());
        self.used = self.used.saturating_sub(len);
    }
}

/// A position in the ring; `at` is less than twice its size.
fn wrapped(at: usize, size: usize) -> usize {
    at.checked_sub(size).unwrap_or(at)
}

const IS_LINK: u8 = 1;
const IS_OUT: u8 = 2;
const HAS_ID: u8 = 4;
const IS_EXTENDED: u8 = 8;

/// Code of a record's verdict: 0 accepted, 1 from a link, from 2 on the reason of a rejection.
fn code_of(verdict: TapVerdict) -> u8 {
    match verdict {
        TapVerdict::Taken => 0,
        TapVerdict::Link => 1,
        TapVerdict::Rejected(why) => {
            let place = Rejection::ALL.iter().position(|&other| other == why).unwrap_or(0);
            (place as u8).wrapping_add(2)
        }
    }
}

fn verdict_of(code: u8) -> TapVerdict {
    match code.checked_sub(2).map(usize::from) {
        Some(why) => TapVerdict::Rejected(Rejection::ALL.get(why).copied().unwrap_or(Rejection::Malformed)),
        None if code == 0 => TapVerdict::Taken,
        None => TapVerdict::Link,
    }
}

#[cfg(test)]
mod tests {
    use std::vec;
    use std::vec::Vec;

    use super::*;

    fn tapped(at: u64, bytes: &[u8]) -> Tapped<'_> {
        Tapped {
            at: Instant::from_micros(at),
            place: TapPlace::Port(PortId(3)),
            direction: TapDirection::In,
            verdict: TapVerdict::Taken,
            can_id: None,
            pieces: [bytes, &[], &[]],
        }
    }

    #[test]
    fn whoever_does_not_listen_costs_nothing_and_gets_nothing() {
        let tap: &mut Tap = &mut Tap::<[u8; 256]>::new();
        tap.record(|| unreachable!("nobody listens"));
        assert_eq!(tap.next(&mut [0; 64]), None);
    }

    #[test]
    fn a_ring_without_room_never_listens() {
        let tap: &mut Tap = &mut Tap::<[u8; 0]>::new();
        tap.listen(true);
        assert!(!tap.is_listening());
    }

    #[test]
    fn every_kind_comes_out_as_it_went_in() {
        let tap: &mut Tap = &mut Tap::<[u8; 4096]>::new();
        tap.listen(true);
        let places = [TapPlace::Port(PortId(0)), TapPlace::Port(PortId(7)), TapPlace::Link(LinkId::URGENT)];
        let ids = [
            None,
            Some(CanId::Standard(0x7FF)),
            Some(CanId::Extended(0x1FFF_FFFF)),
            Some(CanId::Standard(0)),
        ];
        let verdicts = Rejection::ALL.map(TapVerdict::Rejected);
        let verdicts = verdicts.into_iter().chain([TapVerdict::Taken, TapVerdict::Link]);
        let mut expected = Vec::new();
        for (nth, verdict) in verdicts.enumerate() {
            let (place, can_id) = (places[nth % 3], ids[nth % 4]);
            let direction = if nth % 2 == 0 { TapDirection::In } else { TapDirection::Out };
            let at = Instant::from_micros(u64::MAX / 2 + nth as u64);
            let pieces: [&[u8]; 3] = [&[1, 2], &[3], &[4, 5, 6]];
            tap.record(|| Tapped { at, place, direction, verdict, can_id, pieces });
            expected.push((at, place, direction, verdict, can_id));
        }
        let mut room = [0xA5; MAX_TAPPED];
        for expected in expected {
            let record = tap.next(&mut room).unwrap();
            assert_eq!((record.bytes, record.len, record.lost), (&[1, 2, 3, 4, 5, 6][..], 6, 0));
            let found = (record.at, record.place, record.direction, record.verdict, record.can_id);
            assert_eq!(found, expected);
        }
        assert_eq!(tap.next(&mut room), None);
    }

    #[test]
    fn what_finds_no_room_is_counted_and_the_rest_stays_whole_wherever_the_ring_wraps() {
        let tap: &mut Tap = &mut Tap::<[u8; 200]>::new();
        tap.listen(true);
        let mut room = [0; 64];
        let (mut told, mut taken, mut lost) = (0_u64, 0_u64, 0_u64);
        for round in 0..2_000_usize {
            for nth in 0..round % 9 {
                let bytes = vec![told as u8; (round + nth) % 40];
                tap.record(|| tapped(told, &bytes));
                told += 1;
            }
            for _ in 0..round % 4 {
                let Some(record) = tap.next(&mut room) else { break };
                lost += u64::from(record.lost);
                assert_eq!(record.at.as_micros(), taken + lost, "in order, the lost ones counted");
                assert!(record.bytes.iter().all(|&byte| byte == record.at.as_micros() as u8));
                assert_eq!(record.bytes.len(), record.len);
                taken += 1;
            }
        }
        assert!(lost > 1_000 && taken > 1_000, "{lost} lost, {taken} taken");
    }

    #[test]
    fn what_is_longer_than_a_record_or_the_room_is_cut_and_says_so() {
        let tap: &mut Tap = &mut Tap::<[u8; 4096]>::new();
        tap.listen(true);
        let long = vec![7; 70_000];
        tap.record(|| tapped(1, &long));
        tap.record(|| tapped(2, &long[..100]));
        let mut room = [0; MAX_TAPPED];
        let record = tap.next(&mut room).unwrap();
        assert_eq!((record.bytes.len(), record.len), (MAX_TAPPED, usize::from(u16::MAX)));
        let record = tap.next(&mut room[..10]).unwrap();
        assert_eq!((record.bytes, record.len), (&[7; 10][..], 100));
        assert_eq!(tap.next(&mut room), None);
    }

    #[test]
    fn listening_anew_forgets_what_is_there() {
        let tap: &mut Tap = &mut Tap::<[u8; 256]>::new();
        tap.listen(true);
        tap.record(|| tapped(1, &[1]));
        tap.listen(true);
        assert_eq!(tap.next(&mut [0; 64]), None);
        tap.record(|| tapped(2, &[1]));
        tap.listen(false);
        assert_eq!(tap.next(&mut [0; 64]), None);
    }
}
