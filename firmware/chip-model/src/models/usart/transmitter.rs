//! Transmission: characters, and driver-enable around them.

use super::Usart;
use super::registers::*;
use crate::device::*;
use crate::models::line::Sent;

impl Usart {
    /// Driver-enable at the transceiver. Its pin has a pull-down while it is not driven; without DEM it is RTS,
    /// which is high when inactive.
    pub(super) fn show_driver(&mut self, is_active: bool, at: &Context<'_>) {
        let is_connected = self.pins.de.is(at.functions, self.pins.function);
        let is_set_up = self.has(CR1, UE) && self.has(CR3, DEM);
        let level = is_connected && (!is_set_up || is_active != self.has(CR3, DEP));
        self.line.drive(at.now, level);
    }

    pub(super) fn is_driving(&self) -> bool {
        self.sending.is_some() || self.releases.is_some()
    }

    pub(super) fn begin(&mut self, byte: u8, from: Picos, clocks: Clocks) {
        // The parity bit replaces the last data bit.
        let bits = self.data_bits() - u32::from(self.has(CR1, PCE));
        let byte = byte & (0xFF >> 8_u32.saturating_sub(bits));
        self.sending = Some((byte, from, from + self.character(clocks)));
    }

    pub(super) fn transmit(&mut self, at: &Context<'_>) -> Result<(), Refusal> {
        let bit = self.bit(at.clocks);
        while let Some((byte, start, end)) = self.sending {
            if at.now < end {
                break;
            }
            let is_connected = self.pins.tx.is(at.functions, self.pins.function);
            if !is_connected {
                return refuse(format!("a character was sent, but {:?} is not its pin", self.pins.tx));
            }
            let is_driven = self.line.is_driven(start) && self.line.is_driven(end);
            let (parity, stop_bits) = (self.parity_bit(byte), self.stop_bits() as u8);
            self.line.sent.push(Sent { byte, start, end, bit, parity, stop_bits, is_driven });
            self.sending = None;
            match self.waiting.pop_front() {
                Some(next) => self.begin(next, end, at.clocks),
                None => {
                    self.flags |= TC;
                    let sixteenths = u64::from(self.bank.get(CR1) >> 16 & 0x1F);
                    self.releases = Some(end + sixteenths * bit / 16);
                }
            }
        }
        if let Some(until) = self.releases
            && at.now >= until
        {
            self.releases = None;
            let then = Context { now: until, ..*at };
            self.show_driver(false, &then);
        }
        Ok(())
    }
}
