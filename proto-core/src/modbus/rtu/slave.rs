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
/// for an earlier one the master no longer waits.
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
    counters: Counters,
}

/// Frames that came without a silence between them.
const BUFFER: usize = 2 * MAX_ADU;

/// Counters of a slave since the start; they stop at their end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Counters {
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
            counters: Counters { answered: 0, refused: 0, broadcasts: 0, others: 0, late: 0, wrong: 0 },
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
    pub const fn counters(&self) -> Counters {
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
        if let Some((len, crc)) = self.sent
            && let Some((own, others)) = rest.split_at_checked(len)
            && own.ends_with(&crc)
            && is_right(own)
        {
            rest = others;
        }
        while !rest.is_empty() {
            let Some((frame, behind)) = first_frame(rest) else {
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

/// The frame at the front of `bytes`, with a right CRC: all of them, or what the function and the
/// byte count say of a request or reply.
fn first_frame(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let lengths = [FrameLen::Known(bytes.len()), request_len(bytes), reply_len(bytes)];
    lengths.into_iter().find_map(|len| match len {
        FrameLen::Known(len) => bytes.split_at_checked(len).filter(|(frame, _)| is_right(frame)),
        _ => None,
    })
}

fn writes(pdu: &[u8]) -> bool {
    matches!(
        pdu.first(),
        Some(
            &(function::WRITE_COIL
                | function::WRITE_REGISTER
                | function::WRITE_COILS
                | function::WRITE_REGISTERS)
        )
    )
}

/// The place of the PDU in a frame.
fn pdu_of(out: &mut [u8; MAX_ADU]) -> Option<&mut [u8; MAX_PDU]> {
    out.split_first_mut()?.1.first_chunk_mut()
}
