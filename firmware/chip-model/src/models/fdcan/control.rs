//! CCCR: INIT, CCE, and the checks before the controller joins the bus.

use super::Fdcan;
use super::registers::*;
use crate::device::*;

impl Fdcan {
    pub(super) fn cancel_all(&mut self) {
        if self.sending.take().is_some() {
            self.bus.aborted += 1;
        }
        self.waiting.clear();
        self.put = 0;
        self.fifos = [(0, 0, 0); 2];
    }

    pub(super) fn write_control(&mut self, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        let before = self.bank.get(CCCR);
        let arrived = self.init_change.is_none();
        if (value ^ before) & INIT != 0 && !arrived {
            return refuse("INIT is changed before an earlier change has taken effect (read it back)");
        }
        if value & CCE != 0 && (before & INIT == 0 || !arrived) {
            return refuse("CCE is set while INIT is not");
        }
        if value & RESTRICTED != 0 && before & CCE == 0 && before & RESTRICTED == 0 {
            return refuse("ASM can only be set while INIT and CCE are");
        }
        let protected = 0x73C0 & !(1 << 4);
        if (value ^ before) & protected != 0 && before & CCE == 0 {
            return refuse("these bits can only be set while INIT and CCE are");
        }
        if value & 0x80 | value & 0x300 != 0 {
            return refuse("test mode and CAN FD are not modelled");
        }
        let cycles = 4 * cycle(at.clocks.fdcan);
        if value & INIT != 0 && before & INIT == 0 {
            self.init_change = Some((true, at.now + cycles));
        } else if value & INIT == 0 && before & INIT != 0 {
            self.check_set_up(at)?;
            self.init_change = Some((false, at.now + cycles));
        }
        // CCE is cleared with INIT. INIT reads as before until the change has taken effect.
        let value = if value & INIT == 0 { value & !CCE } else { value };
        if value & CCE != 0 && before & CCE == 0 {
            self.cancel_all();
        }
        self.bank.set(CCCR, value & !INIT | before & INIT);
        Ok(())
    }

    /// Checks the configuration when INIT is cleared.
    fn check_set_up(&self, at: &Context<'_>) -> Result<(), Refusal> {
        if self.bank.get(CCFG) & BYPASS == 0 {
            return refuse("the clock calibration unit is neither bypassed nor set up (CCU_CCFG.BCC)");
        }
        if self.bit(at.clocks).is_none() {
            return refuse("it has no clock");
        }
        let sections = [
            (SIDFC, (self.bank.get(SIDFC) >> 16 & 0xFF) as usize),
            (XIDFC, 2 * (self.bank.get(XIDFC) >> 16 & 0x7F) as usize),
            (RXFC[0], ELEMENT * (self.bank.get(RXFC[0]) >> 16 & 0x7F) as usize),
            (RXFC[1], ELEMENT * (self.bank.get(RXFC[1]) >> 16 & 0x7F) as usize),
            (TXBC, ELEMENT * (self.bank.get(TXBC) >> 24 & 0x3F) as usize),
        ];
        let ranges = sections.map(|(register, len)| {
            let first = (self.bank.get(register) & 0xFFFC) as usize / 4;
            (first, first + len)
        });
        for (index, (first, end)) in ranges.iter().enumerate() {
            if *end > WORDS {
                return refuse("a section of the message RAM ends behind it");
            }
            if ranges[..index].iter().any(|(other, behind)| first < behind && other < end) {
                return refuse("two sections of the message RAM overlap");
            }
        }
        Ok(())
    }
}
