//! A slave that answers for one address (docs/wire/modbus-rtu.md section 6).
//!
//! In: the bytes of a line, the time, a [`RegisterBank`]. Out: replies. Does not know the map.

use super::super::pdu::{MAX_PDU, function};
use super::super::server::{RegisterBank, answer};
use super::adu::{Adu, BROADCAST, CRC_LEN, FrameLen, MAX_ADU, is_right, reply_len, request_len, seal};
use super::{Echo, Timing};
use crate::time::Instant;

/// A slave on a line.
///
/// Call [`Self::received`] with bytes. After that, and when [`Self::deadline`] is reached, call [`Self::poll`] and send
/// its reply at once.
///
/// Silence ends a burst of frames. If the caller saw no silence between frames, as behind an operating system, their
/// lengths separate them. Only the newest request is answered: the master no longer waits for earlier ones. One byte
/// 0x00 or 0xFF before and one after the frames of a burst is ignored: lines produce them while their direction
/// changes.
#[derive(Debug, Clone)]
pub struct Slave {
    timing: Timing,
    echo: Echo,
    address: u8,
    buffer: [u8; BUFFER],
    len: usize,
    /// More bytes arrived without a silence than the buffer holds.
    overrun: bool,
    heard: Instant,
    /// Length and CRC of the reply that was sent, whose echo comes first.
    sent: Option<(usize, [u8; CRC_LEN])>,
    /// Length of a reply that is kept in the buffer until it can be sent.
    kept: usize,
    counters: SlaveStats,
}

/// Holds several frames that came without a silence between them.
const BUFFER: usize = 2 * MAX_ADU;

/// Counters of a slave since the start; they saturate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SlaveStats {
    /// Answered requests, refused ones included.
    pub answered: u32,
    /// Requests that were refused with an exception.
    pub refused: u32,
    /// Executed broadcasts.
    pub broadcasts: u32,
    /// Frames of the other slaves, requests and replies.
    pub others: u32,
    /// Requests that were not executed because more bytes followed.
    pub late: u32,
    /// Bursts that contain something other than valid frames.
    pub wrong: u32,
}

impl Slave {
    /// A slave that answers as `address`; `None` outside 1..=247.
    pub const fn new(timing: Timing, echo: Echo, address: u8) -> Option<Self> {
        if address == BROADCAST || address > super::MAX_ADDRESS {
            return None;
        }
        Some(Self {
            timing,
            echo,
            address,
            buffer: [0; BUFFER],
            len: 0,
            overrun: false,
            heard: Instant::ZERO,
            sent: None,
            kept: 0,
            counters: SlaveStats { answered: 0, refused: 0, broadcasts: 0, others: 0, late: 0, wrong: 0 },
        })
    }

    /// Takes bytes that were received by `now`. If the line was silent before them and [`Self::poll`] was not called,
    /// the earlier bytes are too old to be answered.
    pub fn received(&mut self, bytes: &[u8], now: Instant) {
        if bytes.is_empty() {
            return;
        }
        // More bytes arrived: an unsent reply is too late.
        self.kept = 0;
        let began = now - self.timing.of(bytes.len());
        if self.len != 0 && began >= self.heard + self.timing.silence() {
            self.counters.late = self.counters.late.saturating_add(1);
            self.forget();
        }
        self.heard = now;
        let room = self.buffer.get_mut(self.len..).unwrap_or(&mut []);
        self.overrun |= bytes.len() > room.len();
        let taken = bytes.len().min(room.len());
        for (slot, &byte) in room.iter_mut().zip(bytes) {
            *slot = byte;
        }
        self.len = self.len.saturating_add(taken);
    }

    /// Once the line is silent, executes the request and writes the reply to `out`. Returns its length, or `None` if
    /// there is nothing to send.
    pub fn poll<B: RegisterBank + ?Sized>(
        &mut self,
        now: Instant,
        bank: &mut B,
        out: &mut [u8; MAX_ADU],
    ) -> Option<usize> {
        if self.len == 0 || now < self.heard + self.timing.silence() {
            return None;
        }
        let reply = self.carry_out(bank, out);
        self.forget();
        if let (Some(len), Echo::Heard) = (reply, self.echo) {
            let crc = out.get(..len).and_then(|frame| frame.last_chunk().copied());
            self.sent = crc.map(|crc| (len, crc));
        }
        reply
    }

    /// When to call [`Self::poll`]; [`Instant::NEVER`] if no bytes are waiting.
    pub fn deadline(&self) -> Instant {
        if self.len == 0 { Instant::NEVER } else { self.heard + self.timing.silence() }
    }

    /// Copies the received bytes, as many as fit, to the front of `out` and returns how many.
    pub(crate) fn copy_to(&self, out: &mut [u8]) -> usize {
        let held = self.buffer.iter().take(self.len);
        out.iter_mut().zip(held).map(|(slot, &byte)| *slot = byte).count()
    }

    /// Keeps the reply of [`Self::poll`] until it can be sent.
    pub(crate) fn keep(&mut self, reply: &[u8]) {
        self.kept = self.buffer.iter_mut().zip(reply).map(|(slot, &byte)| *slot = byte).count();
    }

    pub(crate) const fn has_kept(&self) -> bool {
        self.kept > 0
    }

    pub(crate) fn take_kept(&mut self, out: &mut [u8]) -> Option<usize> {
        let kept = self.buffer.iter().take(core::mem::take(&mut self.kept));
        let len = out.iter_mut().zip(kept).map(|(slot, &byte)| *slot = byte).count();
        (len > 0).then_some(len)
    }

    /// Drops received bytes and an unsent reply, because the line is gone or their age is unknown. Returns the number
    /// of received bytes.
    pub(crate) fn discard(&mut self) -> usize {
        let len = self.len;
        self.forget();
        self.kept = 0;
        len
    }

    /// Counters since the start.
    pub const fn counters(&self) -> SlaveStats {
        self.counters
    }

    fn forget(&mut self) {
        (self.len, self.overrun, self.sent) = (0, false, None);
    }

    /// Processes the frames of a burst.
    fn carry_out<B: RegisterBank + ?Sized>(
        &mut self,
        bank: &mut B,
        out: &mut [u8; MAX_ADU],
    ) -> Option<usize> {
        let mut rest = self.buffer.get(..self.len)?;
        let counters = &mut self.counters;
        if let Some((len, crc)) = self.sent {
            let behind_echo = |bytes: &'_ [u8]| {
                let own = bytes.get(..len)?;
                (own.ends_with(&crc) && is_right(own)).then_some(len)
            };
            let inner = without_stray(rest);
            let echo = behind_echo(rest).or_else(|| behind_echo(inner?)?.checked_add(1));
            rest = echo.and_then(|echo| rest.get(echo..)).unwrap_or(rest);
        }
        let mut reading = BurstReading { own: self.address, is_bare: false };
        if !self.overrun
            && let Some(inner) = without_stray(rest)
            && let bare = (BurstReading { is_bare: true, ..reading })
            && bare.explains(inner)
        {
            if bare.first_frame(rest).is_some() && reading.explains(rest) {
                // It is ambiguous which of the two was sent.
                counters.wrong = counters.wrong.saturating_add(1);
                return None;
            }
            (rest, reading) = (inner, bare);
        }
        while !rest.is_empty() {
            let Some((frame, behind)) = reading.first_frame(rest) else {
                counters.wrong = counters.wrong.saturating_add(1);
                return None;
            };
            rest = behind;
            match Adu::parse(frame) {
                Ok(Adu { address: BROADCAST, pdu }) if writes(pdu) => {
                    // A broadcast is never answered, not even with an exception.
                    answer(pdu, bank, pdu_of(out)?);
                    counters.broadcasts = counters.broadcasts.saturating_add(1);
                }
                Ok(Adu { address, pdu }) if address == self.address => {
                    if !rest.is_empty() || self.overrun {
                        counters.late = counters.late.saturating_add(1);
                        continue;
                    }
                    let len = answer(pdu, bank, pdu_of(out)?).saturating_add(1);
                    counters.answered = counters.answered.saturating_add(1);
                    let [slave, code, ..] = out;
                    *slave = address;
                    if *code & function::EXCEPTION_FLAG != 0 {
                        counters.refused = counters.refused.saturating_add(1);
                    }
                    return seal(out, len);
                }
                _ => counters.others = counters.others.saturating_add(1),
            }
        }
        if self.overrun {
            counters.wrong = counters.wrong.saturating_add(1);
        }
        None
    }
}

/// How the bytes of a burst are split into frames.
#[derive(Debug, Clone, Copy)]
struct BurstReading {
    /// Address of this slave.
    own: u8,
    /// A byte was dropped, so a frame only counts if its length is the one given by its function and byte count.
    is_bare: bool,
}

impl BurstReading {
    /// Whether `bytes` consist of frames only, except for a stray byte at the end.
    fn explains(self, mut bytes: &[u8]) -> bool {
        while let Some((_, behind)) = self.first_frame(bytes) {
            if behind.is_empty() {
                return true;
            }
            bytes = behind;
        }
        false
    }

    /// Splits off the frame at the front of `bytes`, which has a right CRC: all bytes, or the length that function and
    /// byte count give for a request or reply. A stray byte after it is dropped; if the frame is for this slave, only
    /// if it has a request's length.
    fn first_frame(self, bytes: &[u8]) -> Option<(&[u8], &[u8])> {
        let is_for_this = bytes.first().is_some_and(|&address| address == self.own || address == BROADCAST);
        let (whole, request, reply) = (FrameLen::Known(bytes.len()), request_len(bytes), reply_len(bytes));
        // A frame followed by 0x00 also has a right CRC. So frames to execute are tried with a request's length first,
        // and of two lengths the shorter one is tried first.
        let (first, second) = match (request, reply) {
            (FrameLen::Known(request_len), FrameLen::Known(reply_len)) if reply_len < request_len => {
                (reply, request)
            }
            _ => (request, reply),
        };
        let lengths = match (is_for_this, self.is_bare) {
            (true, false) => [request, whole, reply],
            (true, true) => [request, FrameLen::Unknown, FrameLen::Unknown],
            (false, false) => [whole, first, second],
            (false, true) => [first, second, FrameLen::Unknown],
        };
        lengths.into_iter().find_map(|len| {
            let FrameLen::Known(known) = len else { return None };
            let (frame, behind) = bytes.split_at_checked(known).filter(|(frame, _)| is_right(frame))?;
            let is_last = matches!(behind, &[byte] if is_stray(byte)) && (!is_for_this || len == request);
            Some((frame, if is_last { &[] } else { behind }))
        })
    }
}

/// Whether a line may produce this byte while its direction changes.
const fn is_stray(byte: u8) -> bool {
    matches!(byte, 0x00 | 0xFF)
}

/// The bytes after a stray byte at the front.
fn without_stray(bytes: &[u8]) -> Option<&[u8]> {
    bytes.split_first().filter(|(first, _)| is_stray(**first)).map(|(_, inner)| inner)
}

fn writes(pdu: &[u8]) -> bool {
    matches!(
        pdu.first(),
        Some(
            &(function::WRITE_COIL
                | function::WRITE_REGISTER
                | function::WRITE_COILS
                | function::WRITE_REGISTERS
                | function::MASK_WRITE_REGISTER)
        )
    )
}

/// The space for the PDU in a frame.
fn pdu_of(out: &mut [u8; MAX_ADU]) -> Option<&mut [u8; MAX_PDU]> {
    out.split_first_mut()?.1.first_chunk_mut()
}
