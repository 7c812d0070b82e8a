//! The message RAM: transmit buffers and receive FIFOs.

use super::Fdcan;
use super::filters::Filters;
use super::registers::*;
use crate::device::*;
use crate::models::can_bus::Frame;

impl Fdcan {
    /// Reads a word of the message RAM.
    ///
    /// # Errors
    /// `word` is out of range.
    pub fn ram_read(&self, word: usize) -> Result<u32, Refusal> {
        self.ram.get(word).copied().ok_or_else(|| Refusal("behind the message RAM's end".into()))
    }

    /// Writes a word of the message RAM.
    ///
    /// # Errors
    /// `word` is out of range, or belongs to a transmit buffer with a pending request.
    pub fn ram_write(&mut self, word: usize, value: u32) -> Result<(), Refusal> {
        let buffers = self.bank.get(TXBC);
        let first = (buffers & 0xFFFC) as usize / 4;
        let waits = |index: u32| {
            let begin = first + ELEMENT * index as usize;
            (begin..begin + ELEMENT).contains(&word)
        };
        if self.waiting.iter().copied().any(waits) || self.sending.is_some_and(|(index, ..)| waits(index)) {
            return refuse("this transmit buffer waits to be sent (TXBRP)");
        }
        match self.ram.get_mut(word) {
            Some(place) => {
                *place = value;
                Ok(())
            }
            None => refuse("behind the message RAM's end"),
        }
    }

    pub(super) fn request(&mut self, bits: u32) -> Result<(), Refusal> {
        if !self.is_on_bus {
            return refuse("a transmission is requested while INIT is set");
        }
        let size = self.bank.get(TXBC) >> 24 & 0x3F;
        if bits != 1 << self.put || self.used() >= size {
            return refuse(format!("not the FIFO's put index, which is {}", self.put));
        }
        let begin = (self.bank.get(TXBC) & 0xFFFC) as usize / 4 + ELEMENT * self.put as usize;
        if self.ram[begin + 1] & 0x0070_FFFF != 0 {
            return refuse("a frame of CAN FD, or reserved bits in its element");
        }
        self.waiting.push_back(self.put);
        self.put = (self.put + 1) % size;
        Ok(())
    }

    pub(super) fn used(&self) -> u32 {
        self.waiting.len() as u32 + u32::from(self.sending.is_some())
    }

    /// The frame of a transmit buffer.
    pub(super) fn frame(&self, index: u32) -> Frame {
        let begin = (self.bank.get(TXBC) & 0xFFFC) as usize / 4 + ELEMENT * index as usize;
        let words: [u32; ELEMENT] = std::array::from_fn(|offset| self.ram[begin + offset]);
        Frame::from_words(words)
    }

    pub(super) fn store(&mut self, frame: &Frame) {
        let filters = Filters {
            others: self.bank.get(GFC),
            standard: self.bank.get(SIDFC),
            extended: self.bank.get(XIDFC),
            mask: self.bank.get(XIDAM),
        };
        let Some((fifo, filter)) = filters.accept(frame, &self.ram) else { return };
        self.bus.accepted += 1;
        let config = self.bank.get(RXFC[fifo]);
        let size = config >> 16 & 0x7F;
        let (get, put, fill) = self.fifos[fifo];
        if fill == size {
            self.raise(1 << (3 + 4 * fifo));
            return;
        }
        let begin = (config & 0xFFFC) as usize / 4 + ELEMENT * put as usize;
        for (place, word) in self.ram[begin..begin + ELEMENT].iter_mut().zip(frame.words()) {
            *place = word;
        }
        // FIDX, or ANMF if no filter matched (RM0433, "FDCAN Rx buffer and FIFO element").
        self.ram[begin + 1] |= filter.map_or(1 << 31, |index| index << 24);
        self.fifos[fifo] = (get, (put + 1) % size, fill + 1);
        self.raise(1 << (4 * fifo) | u32::from(fill + 1 == size) << (2 + 4 * fifo));
    }

    pub(super) fn acknowledge(&mut self, fifo: usize, index: u32) -> Result<(), Refusal> {
        let (get, put, fill) = self.fifos[fifo];
        if fill == 0 || index != get {
            return refuse(format!("not the FIFO's get index, which is {get}; {fill} are there"));
        }
        let size = self.bank.get(RXFC[fifo]) >> 16 & 0x7F;
        self.fifos[fifo] = ((get + 1) % size, put, fill - 1);
        Ok(())
    }
}
