//! The LAN8742A PHY: its 50 MHz reference clock, its registers, and the cable. Microchip DS00001989.
//!
//! The link partner is a switch that advertises all modes. After a software reset the reset bit reads 1 for some
//! time ("Software reset": 0.5 s at most).

use crate::device::*;

/// The PHY.
#[derive(Debug)]
pub struct Phy {
    /// Whether it provides the 50 MHz reference clock.
    pub has_clock: bool,
    /// Whether it answers on MDIO at all.
    pub is_present: bool,
    /// Time from which it answers, after its own start-up.
    pub answers_from: Picos,
    /// Whether the cable is plugged in.
    pub has_cable: bool,
    /// Duration of auto-negotiation.
    pub negotiation: Picos,
    /// Number of register accesses.
    pub accesses: u64,
    control: u16,
    advertised: u16,
    reset_until: Option<Picos>,
    linked_at: Option<Picos>,
}

impl Phy {
    /// The state after power-on: it advertises all modes, and negotiates.
    pub fn new() -> Self {
        Self {
            has_clock: true,
            is_present: true,
            answers_from: 0,
            has_cable: true,
            negotiation: 300 * MILLI,
            accesses: 0,
            control: NEGOTIATE,
            advertised: ADVERTISE_ALL,
            reset_until: None,
            linked_at: Some(300 * MILLI),
        }
    }

    fn update(&mut self, now: Picos) {
        if self.reset_until.is_some_and(|until| now >= until) {
            self.reset_until = None;
            self.control = NEGOTIATE;
            self.advertised = ADVERTISE_ALL;
            self.linked_at = Some(now + self.negotiation);
        }
    }

    /// Unplugs the cable.
    pub fn unplug(&mut self) {
        self.has_cable = false;
    }

    /// Plugs the cable in: negotiation begins.
    pub fn plug(&mut self, now: Picos) {
        self.has_cable = true;
        self.linked_at = Some(now + self.negotiation);
    }

    /// The modes that it advertises (register 4).
    pub fn advertised(&self) -> u16 {
        self.advertised
    }

    /// Whether the link is up.
    pub fn is_up(&mut self, now: Picos) -> bool {
        self.update(now);
        self.is_present
            && self.has_cable
            && self.reset_until.is_none()
            && self.linked_at.is_some_and(|at| now >= at)
    }

    pub(super) fn read(&mut self, address: u32, register: u32, now: Picos) -> u16 {
        self.accesses += 1;
        self.update(now);
        if address != 0 || !self.is_present || now < self.answers_from {
            return 0xFFFF;
        }
        let is_up = self.is_up(now);
        match register {
            0 => self.control | if self.reset_until.is_some() { RESET } else { 0 },
            1 => 0x7809 | if is_up { 1 << 5 | 1 << 2 } else { 0 },
            2 => 0x0007,
            3 => 0xC131,
            4 => self.advertised,
            5 if is_up => 0x45E1,
            31 => {
                let speed = if self.advertised & 1 << 8 != 0 { 0b110 } else { 0b101 };
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
        self.update(now);
        if address != 0 || !self.is_present || now < self.answers_from {
            return Ok(());
        }
        match register {
            _ if self.reset_until.is_some() => return refuse("the PHY is written during its reset"),
            0 if value & RESET != 0 => self.reset_until = Some(now + 5 * MILLI),
            0 => {
                self.control = value & !RESTART;
                if value & RESTART != 0 {
                    self.linked_at = Some(now + self.negotiation);
                }
            }
            4 => self.advertised = value,
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
const ADVERTISE_ALL: u16 = 0x01E1;
