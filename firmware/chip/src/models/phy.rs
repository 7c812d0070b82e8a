//! The LAN8742A on the board: its 50 MHz, its registers behind MDIO, and the cable. Microchip DS00001989.
//!
//! It negotiates like a switch that offers everything. After a software reset it answers with the reset
//! bit set for a while ("Software reset": 0.5 s at most).

use crate::device::*;

/// The PHY.
#[derive(Debug)]
pub struct Phy {
    /// It gives 50 MHz to the MAC.
    pub has_clock: bool,
    /// It is there and answers.
    pub is_there: bool,
    /// From when on it answers: its own start takes time.
    pub answers_from: Picos,
    /// The cable's other end is a switch.
    pub has_cable: bool,
    /// How long negotiation takes.
    pub negotiation: Picos,
    /// How often its registers were read or written.
    pub accesses: u64,
    control: u16,
    offer: u16,
    resets: Option<Picos>,
    linked: Option<Picos>,
}

impl Phy {
    /// As it starts: it offers everything, and negotiates.
    pub fn new() -> Self {
        Self {
            has_clock: true,
            is_there: true,
            answers_from: 0,
            has_cable: true,
            negotiation: 300 * MILLI,
            accesses: 0,
            control: NEGOTIATE,
            offer: OFFER_ALL,
            resets: None,
            linked: Some(300 * MILLI),
        }
    }

    fn look(&mut self, now: Picos) {
        if self.resets.is_some_and(|until| now >= until) {
            self.resets = None;
            self.control = NEGOTIATE;
            self.offer = OFFER_ALL;
            self.linked = Some(now + self.negotiation);
        }
    }

    /// The cable is pulled out.
    pub fn pull(&mut self) {
        self.has_cable = false;
    }

    /// The cable is plugged in again: they negotiate.
    pub fn plug(&mut self, now: Picos) {
        self.has_cable = true;
        self.linked = Some(now + self.negotiation);
    }

    /// What it offers its partner (register 4).
    pub fn offer(&self) -> u16 {
        self.offer
    }

    /// Whether frames pass.
    pub fn is_up(&mut self, now: Picos) -> bool {
        self.look(now);
        self.is_there && self.has_cable && self.resets.is_none() && self.linked.is_some_and(|at| now >= at)
    }

    pub(super) fn read(&mut self, address: u32, register: u32, now: Picos) -> u16 {
        self.accesses += 1;
        self.look(now);
        if address != 0 || !self.is_there || now < self.answers_from {
            return 0xFFFF;
        }
        let is_up = self.is_up(now);
        match register {
            0 => self.control | if self.resets.is_some() { RESET } else { 0 },
            1 => 0x7809 | if is_up { 1 << 5 | 1 << 2 } else { 0 },
            2 => 0x0007,
            3 => 0xC131,
            4 => self.offer,
            5 if is_up => 0x45E1,
            31 => {
                let speed = if self.offer & 1 << 8 != 0 { 0b110 } else { 0b101 };
                0x0040 | if is_up { 1 << 12 | speed << 2 } else { 0 }
            }
            _ => 0,
        }
    }

    pub(super) fn write(
        &mut self,
        address: u32,
        register: u32,
        value: u16,
        now: Picos,
    ) -> Result<(), Refusal> {
        self.accesses += 1;
        self.look(now);
        if address != 0 || !self.is_there || now < self.answers_from {
            return Ok(());
        }
        match register {
            _ if self.resets.is_some() => return refuse("the PHY is written while it resets"),
            0 if value & RESET != 0 => self.resets = Some(now + 5 * MILLI),
            0 => {
                self.control = value & !RESTART;
                if value & RESTART != 0 {
                    self.linked = Some(now + self.negotiation);
                }
            }
            4 => self.offer = value,
            1..=3 | 5 | 6 => return refuse("this register of the PHY can only be read"),
            _ => return refuse("this register of the PHY is not modelled"),
        }
        Ok(())
    }
}

impl Default for Phy {
    fn default() -> Self {
        Self::new()
    }
}

const RESET: u16 = 1 << 15;
const NEGOTIATE: u16 = 0x3000;
const RESTART: u16 = 1 << 9;
const OFFER_ALL: u16 = 0x01E1;
