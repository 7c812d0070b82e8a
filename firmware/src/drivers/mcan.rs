//! Bosch M_CAN (the FDCAN of an STM32H7) as a CAN port, for classic frames.
//!
//! In: accesses to its registers and its message RAM through [`McanBlock`], and calls of [`Mcan::interrupt`]. Out: a
//! [`CanPort`]. Does not know boards or pins.
//!
//! The message RAM has two receive FIFOs of 64 frames, so that none is lost within 3 ms at 1 Mbit/s, and a
//! transmit FIFO for a whole cycle of 32. The id of a frame determines its receive FIFO, so frames of one id
//! stay in order. The interrupt only wakes the task.

mod registers;
mod timing;

use core::cell::Cell;
use core::future::poll_fn;
use core::task::Poll;

use embassy_sync::waitqueue::AtomicWaker;
use embedded_can::Frame;
use proto_core::engine::BusState;
use proto_core::recipe::model::MAX_CAN_IDS;
use proto_core::wire::can::{CanFrame, CanId, MAX_CAN_DATA};

use super::can_port::{BusOff, CanCounters, CanEvent, CanPort};

use registers::*;

pub use registers::MESSAGE_RAM_WORDS;
pub use timing::{BitTiming, BitrateError};

/// One M_CAN: its registers, and its share of the message RAM, 32 bits each.
pub trait McanBlock {
    /// Reads the register at `offset`.
    fn read(&self, offset: u8) -> u32;
    /// Writes the register at `offset`.
    fn write(&self, offset: u8, value: u32);
    /// Reads a word of the message RAM; `word` is below [`MESSAGE_RAM_WORDS`].
    fn ram_read(&self, word: u16) -> u32;
    /// Writes a word of the message RAM.
    fn ram_write(&self, word: u16, value: u32);
}

/// The controller. Its interrupt handler calls [`Mcan::interrupt`].
pub struct Mcan<R> {
    regs: R,
    waker: &'static AtomicWaker,
    bitrate: u32,
    /// The state reported last.
    state: Cell<BusState>,
    is_sending: Cell<bool>,
    lost: u32,
    /// Alternates which FIFO is read first.
    first: bool,
}

/// Why the controller does not start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum McanError {
    /// The endian register has a wrong value: no M_CAN, or one without a clock.
    NoController {
        /// The register's value.
        found: u32,
    },
    /// The bit rate cannot be derived from the clock.
    Bitrate(BitrateError),
}

impl core::fmt::Display for McanError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::NoController { found } => write!(f, "no M_CAN: its byte test reads {found:08X}"),
            Self::Bitrate(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for McanError {}

impl<R: McanBlock> Mcan<R> {
    /// Configures the controller after its reset. `clock` is its kernel clock in Hz; `ram_offset` is the start of
    /// its part of the message RAM, in words. It joins the bus when its filters are set.
    ///
    /// # Errors
    /// See [`McanError`]. A missing controller does not hang the board.
    pub fn start(
        regs: R,
        ram_offset: u16,
        waker: &'static AtomicWaker,
        bitrate: u32,
        clock: u32,
    ) -> Result<Self, McanError> {
        match regs.read(ENDN) {
            0x8765_4321 => {}
            found => return Err(McanError::NoController { found }),
        }
        let timing = BitTiming::of(bitrate, clock).map_err(McanError::Bitrate)?;
        let mcan = Self {
            regs,
            waker,
            bitrate,
            state: Cell::new(BusState::Active),
            is_sending: Cell::new(false),
            lost: 0,
            first: false,
        };
        mcan.enter_configuration();
        mcan.layout_message_ram(ram_offset);
        mcan.regs.write(NBTP, timing.register());
        // Classic frames only, with automatic retransmission.
        mcan.regs.write(CCCR, CCCR_INIT | CCCR_CONFIGURE);
        mcan.regs.write(TXBTIE, u32::MAX);
        mcan.regs.write(IE, INTERRUPTS);
        mcan.regs.write(ILS, 0);
        mcan.regs.write(ILE, 1);
        Ok(mcan)
    }

    /// The interrupt handler.
    pub fn interrupt(regs: &R, waker: &AtomicWaker) {
        // The flags of lost frames cause no interrupt; `take_frame` counts and clears them.
        regs.write(IR, regs.read(IR) & !LOST);
        waker.wake();
    }

    /// Sets the layout of the message RAM, with all filters disabled.
    fn layout_message_ram(&self, ram_offset: u16) {
        for word in 0..MESSAGE_RAM_WORDS {
            self.regs.ram_write(word, 0);
        }
        let address = |word: u16| u32::from(ram_offset.saturating_add(word)) << 2;
        let count = |count: u16, place: u32| u32::from(count) << place;
        self.regs.write(SIDFC, address(STANDARD_FILTERS) | count(FILTERS, 16));
        self.regs.write(XIDFC, address(EXTENDED_FILTERS) | count(FILTERS, 16));
        self.regs.write(XIDAM, 0x1FFF_FFFF);
        self.regs.write(RXF0C, address(RX_FIFOS[0]) | count(RX_ELEMENTS, 16));
        self.regs.write(RXF1C, address(RX_FIFOS[1]) | count(RX_ELEMENTS, 16));
        self.regs.write(TXEFC, 0);
        // A FIFO, not a queue ordered by ids.
        self.regs.write(TXBC, address(TX_FIFO) | count(TX_ELEMENTS, 24));
        // Elements with 8 bytes of data.
        self.regs.write(RXESC, 0);
        self.regs.write(TXESC, 0);
    }

    /// Leaves the bus; the controller drops all queued frames.
    fn enter_configuration(&self) {
        let control = self.regs.read(CCCR) & CCCR_KEPT;
        self.regs.write(CCCR, control | CCCR_INIT);
        self.wait_for_init(CCCR_INIT);
        self.regs.write(CCCR, control | CCCR_INIT | CCCR_CONFIGURE);
    }

    /// Joins the bus after 11 recessive bits, or 129 times as many after bus-off.
    fn leave_configuration(&self) {
        let control = self.regs.read(CCCR) & CCCR_KEPT;
        self.regs.write(CCCR, control | CCCR_INIT);
        self.regs.write(CCCR, control);
        self.wait_for_init(0);
    }

    /// Waits until INIT has crossed to the CAN clock domain. Before that, other writes would be ignored.
    fn wait_for_init(&self, wanted: u32) {
        for _ in 0..MAX_POLLS {
            if self.regs.read(CCCR) & CCCR_INIT == wanted {
                return;
            }
        }
    }

    fn bus_state(&self) -> BusState {
        // After a message RAM access failure the controller only listens. The recovery is the same as from
        // bus-off.
        if self.regs.read(CCCR) & CCCR_RESTRICTED != 0 {
            return BusState::BusOff;
        }
        match self.regs.read(PSR) {
            psr if psr & PSR_BUS_OFF != 0 => BusState::BusOff,
            psr if psr & PSR_PASSIVE != 0 => BusState::Passive,
            psr if psr & PSR_WARNING != 0 => BusState::Warning,
            _ => BusState::Active,
        }
    }

    /// The next frame, from both FIFOs in turn.
    fn take_frame(&mut self) -> Option<CanFrame> {
        let lost = self.regs.read(IR) & LOST;
        if lost != 0 {
            self.regs.write(IR, lost);
            self.lost = self.lost.wrapping_add(lost.count_ones());
        }
        self.first = !self.first;
        let turns = if self.first { [0, 1] } else { [1, 0] };
        turns.into_iter().find_map(|fifo| self.take_from(fifo))
    }

    fn take_from(&self, fifo: usize) -> Option<CanFrame> {
        let (&start, &(status, acknowledge)) = RX_FIFOS.get(fifo).zip(RX_REGISTERS.get(fifo))?;
        loop {
            let status = self.regs.read(status);
            if status & 0x7F == 0 {
                return None;
            }
            let index = status >> 8 & 0x3F;
            let frame = self.element(element(start, index));
            self.regs.write(acknowledge, index);
            if frame.is_some() {
                return frame;
            }
        }
    }

    /// The frame of a receive FIFO's element; `None` for a CAN FD frame.
    fn element(&self, word: u16) -> Option<CanFrame> {
        let read = |offset: u16| self.regs.ram_read(word.saturating_add(offset));
        let (head, control) = (read(0), read(1));
        if control & CONTROL_FD != 0 {
            return None;
        }
        let id = if head & HEAD_EXTENDED != 0 {
            CanId::Extended(head & 0x1FFF_FFFF)
        } else {
            CanId::Standard((head >> 18 & 0x7FF) as u16)
        };
        let len = (control >> 16 & 0xF).min(MAX_CAN_DATA as u32) as usize;
        if head & HEAD_REMOTE != 0 {
            return CanFrame::remote(id, len);
        }
        let mut data = [0; MAX_CAN_DATA];
        let (low, high) = data.split_at_mut(4);
        low.copy_from_slice(&read(2).to_le_bytes());
        high.copy_from_slice(&read(3).to_le_bytes());
        CanFrame::new(id, data.get(..len)?)
    }

    /// Puts a frame into the transmit FIFO; returns whether there was room.
    fn put_frame(&self, frame: &CanFrame) -> bool {
        let status = self.regs.read(TXFQS);
        if status & TXFQS_FULL != 0 {
            return false;
        }
        let index = status >> 16 & 0x1F;
        let word = element(TX_FIFO, index);
        let head = match frame.id() {
            CanId::Standard(id) => u32::from(id) << 18,
            CanId::Extended(id) => id | HEAD_EXTENDED,
        };
        let remote = if frame.is_remote_frame() { HEAD_REMOTE } else { 0 };
        let mut data = [0; MAX_CAN_DATA];
        for (place, byte) in data.iter_mut().zip(frame.data()) {
            *place = *byte;
        }
        let [a, b, c, d, e, f, g, h] = data;
        let words = [
            head | remote,
            (frame.dlc() as u32) << 16,
            u32::from_le_bytes([a, b, c, d]),
            u32::from_le_bytes([e, f, g, h]),
        ];
        for (offset, value) in (0..).zip(words) {
            self.regs.ram_write(word.saturating_add(offset), value);
        }
        self.regs.write(TXBAR, 1 << index);
        self.is_sending.set(true);
        true
    }

    fn is_transmitting(&self) -> bool {
        self.regs.read(TXBRP) != 0
    }
}

impl<R: McanBlock> CanPort for Mcan<R> {
    type Frame = CanFrame;

    async fn receive(&mut self) -> CanEvent<CanFrame> {
        poll_fn(|cx| {
            self.waker.register(cx.waker());
            if let Some(frame) = self.take_frame() {
                return Poll::Ready(CanEvent::Frame(frame));
            }
            let state = self.bus_state();
            if self.state.replace(state) != state {
                return Poll::Ready(CanEvent::Bus(state));
            }
            if self.is_sending.get() && !self.is_transmitting() && state != BusState::BusOff {
                self.is_sending.set(false);
                return Poll::Ready(CanEvent::Sent);
            }
            Poll::Pending
        })
        .await
    }

    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusOff> {
        poll_fn(|cx| {
            self.waker.register(cx.waker());
            if self.bus_state() == BusState::BusOff {
                self.state.set(BusState::BusOff);
                return Poll::Ready(Err(BusOff));
            }
            if self.put_frame(frame) { Poll::Ready(Ok(())) } else { Poll::Pending }
        })
        .await
    }

    fn recover(&mut self) {
        self.is_sending.set(false);
        // Drops the queued frames.
        self.enter_configuration();
        self.leave_configuration();
    }

    fn set_filters(&mut self, ids: &[CanId]) {
        self.enter_configuration();
        let (mut standard, mut extended) = (0, 0);
        for (index, id) in ids.iter().take(MAX_CAN_IDS).enumerate() {
            let fifo = if index % 2 == 0 { TO_FIFO_0 } else { TO_FIFO_1 };
            // A dual-id filter with the same id twice accepts exactly this id.
            match *id {
                CanId::Standard(id) => {
                    let (id, place) = (u32::from(id), STANDARD_FILTERS.saturating_add(standard));
                    self.regs.ram_write(place, TWO_IDS | fifo << 27 | id << 16 | id);
                    standard = standard.saturating_add(1);
                }
                CanId::Extended(id) => {
                    let place = EXTENDED_FILTERS.saturating_add(extended);
                    self.regs.ram_write(place, fifo << 29 | id);
                    self.regs.ram_write(place.saturating_add(1), TWO_IDS | id);
                    extended = extended.saturating_add(2);
                }
            }
        }
        self.regs.write(GFC, GFC_REJECT_OTHERS);
        self.leave_configuration();
    }

    fn counters(&self) -> CanCounters {
        let errors = self.regs.read(ECR);
        CanCounters {
            transmit_errors: errors as u8,
            receive_errors: (errors >> 8 & 0x7F) as u8,
            lost: self.lost,
        }
    }

    fn bitrate(&self) -> u32 {
        self.bitrate
    }
}

/// The word at which an element of four words begins.
fn element(start: u16, index: u32) -> u16 {
    start.saturating_add(ELEMENT_WORDS.saturating_mul(index as u16))
}

/// Limit of polls of a bit that changes after some cycles of the CAN clock.
const MAX_POLLS: usize = 10_000;

#[cfg(test)]
mod tests;
