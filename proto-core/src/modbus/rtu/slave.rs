//! A slave that answers as one address (docs/wire/modbus-rtu.md section 6).
//!
//! In: the bytes of a line, the time, a [`RegisterBank`]. Out: replies. Does not know the map.

use super::super::pdu::{MAX_PDU, function};
use super::super::server::{RegisterBank, answer};
use super::adu::{Adu, BROADCAST, CRC_LEN, FrameLen, MAX_ADU, is_right, reply_len, request_len, seal};
use super::{Echo, Timing};
use crate::time::Instant;

/// A slave on a line.
///
/// To be called: [`Self::received`] with bytes, and after it and when [`Self::deadline`] has come,
/// [`Self::poll`], whose reply is to be sent at once.
///
/// The silence of the line ends a frame. Where the caller saw no silence between frames, as behind
/// an operating system, they are told apart by their lengths. Only the newest request is answered:
/// for an earlier one the master no longer waits. One byte 0x00 or 0xFF before the frames of a burst
/// and one behind them, as a line gives while its direction changes, are no part of them.
#[derive(Debug, Clone)]
pub struct Slave {
    timing: Timing,
    echo: Echo,
    address: u8,
    buffer: [u8; BUFFER],
    len: usize,
    /// More bytes came without a silence than there is room for.
    overrun: bool,
    heard: Instant,
    /// Length and CRC of the own reply, whose echo comes first.
    sent: Option<(usize, [u8; CRC_LEN])>,
    /// Length of a reply that is kept in the buffer, and is sent later.
    kept: usize,
    counters: SlaveStats,
}

/// Frames that came without a silence between them.
const BUFFER: usize = 2 * MAX_ADU;

/// Counters of a slave since the start; they stop at their end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SlaveStats {
    /// Requests that were answered, with those that were refused.
    pub answered: u32,
    /// Requests that were refused with an exception.
    pub refused: u32,
    /// Broadcasts that were carried out.
    pub broadcasts: u32,
    /// Frames of the other slaves, requests and replies.
    pub others: u32,
    /// Requests that were not carried out, because more came behind them.
    pub late: u32,
    /// Bursts with bytes that are no frame or have a wrong CRC.
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

    /// Takes bytes that came from the line by `now`. If the line was silent before them and
    /// [`Self::poll`] was not called, what came earlier is too old to be answered.
    pub fn received(&mut self, bytes: &[u8], now: Instant) {
        if bytes.is_empty() {
            return;
        }
        // The line goes on: a reply that was not sent is too late.
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

    /// Carries out what was asked once the line is silent; the length of the reply in `out`, or
    /// `None` if there is nothing to send.
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

    /// When to call [`Self::poll`]; [`Instant::NEVER`] while nothing has come.
    pub fn deadline(&self) -> Instant {
        if self.len == 0 { Instant::NEVER } else { self.heard + self.timing.silence() }
    }

    /// Copies the bytes that came to the front of `out`, as many as fit, and returns how many.
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

    /// Takes the reply that was kept, if there is one.
    pub(crate) fn take_kept(&mut self, out: &mut [u8]) -> Option<usize> {
        let kept = self.buffer.iter().take(core::mem::take(&mut self.kept));
        let len = out.iter_mut().zip(kept).map(|(slot, &byte)| *slot = byte).count();
        (len > 0).then_some(len)
    }

    /// Drops what came and what was to be sent: the line is gone, or nobody knows how old it is. Returns
    /// the number of bytes that came.
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

    /// Goes through the frames of a burst.
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
                // Nobody can tell which of the two was sent.
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
                    // None answers, not even with an exception.
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

/// How the bytes of a burst are taken for frames.
#[derive(Debug, Clone, Copy)]
struct BurstReading {
    /// The address of the slave.
    own: u8,
    /// A byte before them was dropped, so a frame counts only with the length that its function and
    /// byte count say.
    is_bare: bool,
}

impl BurstReading {
    /// Whether `bytes` are frames and nothing else, but for a false byte behind them.
    fn explains(self, mut bytes: &[u8]) -> bool {
        while let Some((_, behind)) = self.first_frame(bytes) {
            if behind.is_empty() {
                return true;
            }
            bytes = behind;
        }
        false
    }

    /// The frame at the front of `bytes`, with a right CRC, and what is behind it: all of them, or what
    /// the function and the byte count say of a request or reply. A single false byte behind it is
    /// dropped, but for a frame to this slave only if its length is a request's.
    fn first_frame(self, bytes: &[u8]) -> Option<(&[u8], &[u8])> {
        let is_for_this = bytes.first().is_some_and(|&address| address == self.own || address == BROADCAST);
        let (whole, request, reply) = (FrameLen::Known(bytes.len()), request_len(bytes), reply_len(bytes));
        // The CRC of a frame with 0x00 behind it is right as well. So what is to be carried out is looked
        // for first with a request's length, and of two lengths the shorter one is tried first.
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

/// Whether this is what a line gives while its direction changes.
const fn is_stray(byte: u8) -> bool {
    matches!(byte, 0x00 | 0xFF)
}

/// What is behind a false byte at the front.
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

/// The place of the PDU in a frame.
fn pdu_of(out: &mut [u8; MAX_ADU]) -> Option<&mut [u8; MAX_PDU]> {
    out.split_first_mut()?.1.first_chunk_mut()
}
