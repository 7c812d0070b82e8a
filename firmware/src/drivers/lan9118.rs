//! SMSC LAN9118 Ethernet controller as a driver of `embassy_net`.
//!
//! In: register accesses through [`Lan9118Registers`], and a waker that the interrupt handler wakes. Out: Ethernet
//! frames. The only receive interrupt used is "status FIFO level", which means that a whole frame has
//! arrived.

use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::waitqueue::AtomicWaker;

/// The controller's registers, 32 bits each.
pub trait Lan9118Registers {
    /// Reads the register at `offset`.
    fn read(&self, offset: u16) -> u32;
    /// Writes the register at `offset`.
    fn write(&self, offset: u16, value: u32);
    /// Called after a frame was written completely.
    fn transmitted(&self) {}
}

/// Longest frame without its CRC.
const MTU: usize = 1514;
/// Longest frame with the controller's padding, in whole words.
const BUFFER: usize = 1536;

/// The driver. Its interrupt handler calls [`Lan9118::interrupt`].
pub struct Lan9118<R> {
    regs: R,
    waker: &'static AtomicWaker,
    address: [u8; 6],
    rx: [u8; BUFFER],
    tx: [u8; BUFFER],
    /// Number of received frames with errors or too long.
    dropped: u32,
    /// Link state of the PHY; `None` before the first read.
    link: Option<bool>,
}

/// Why the controller does not start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Lan9118Error {
    /// The byte order register has a wrong value: no LAN9118.
    NoController {
        /// The register's value.
        found: u32,
    },
    /// A register bit did not change in time.
    Stuck {
        /// The register.
        offset: u16,
    },
}

impl core::fmt::Display for Lan9118Error {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::NoController { found } => write!(f, "no LAN9118: its byte test reads {found:08X}"),
            Self::Stuck { offset } => write!(f, "the LAN9118's register {offset:02X} does not change"),
        }
    }
}

impl core::error::Error for Lan9118Error {}

impl<R: Lan9118Registers> Lan9118<R> {
    /// Resets and starts the controller, with its interrupts disabled.
    ///
    /// # Errors
    /// See [`Lan9118Error`]. A missing controller does not hang the board.
    pub fn start(regs: R, waker: &'static AtomicWaker) -> Result<Self, Lan9118Error> {
        wait(&regs, PMT_CTRL, |value| value & 1 != 0)?;
        match regs.read(BYTE_TEST) {
            0x8765_4321 => {}
            found => return Err(Lan9118Error::NoController { found }),
        }
        regs.write(HW_CFG, HW_CFG_RESET);
        wait(&regs, HW_CFG, |value| value & HW_CFG_RESET == 0)?;
        // 5 KiB of transmit FIFO.
        regs.write(HW_CFG, 0x0015_0000);
        regs.write(AFC_CFG, 0x006E_3740);
        wait(&regs, E2P_CMD, |value| value & BUSY == 0)?;
        regs.write(INT_EN, 0);
        regs.write(INT_STS, u32::MAX);
        // Active high, push-pull, 170 µs between interrupts.
        regs.write(IRQ_CFG, 0x2200_0111);
        regs.write(FIFO_INT, 0x4800_0000);
        regs.write(RX_CFG, 0);
        regs.write(TX_CFG, 0xC000);
        regs.write(TX_CFG, TX_ON);
        let mut driver =
            Self { regs, waker, address: [0; 6], rx: [0; BUFFER], tx: [0; BUFFER], dropped: 0, link: None };
        let low = driver.mac_read(MAC_ADDRL)?.to_le_bytes();
        let high = driver.mac_read(MAC_ADDRH)?.to_le_bytes();
        driver.address = [low[0], low[1], low[2], low[3], high[0], high[1]];
        // Auto-negotiation, and an interrupt on changes of the link.
        driver.phy_write(PHY_BMCR, 0x1200)?;
        driver.phy_write(PHY_INT_MASK, 0xD0)?;
        driver.phy_read(PHY_INT_SOURCE)?;
        // Full duplex, transmitter and receiver on.
        driver.mac_write(MAC_CR, 0x0010_000C)?;
        Ok(driver)
    }

    /// The MAC address from the EEPROM.
    pub fn address(&self) -> [u8; 6] {
        self.address
    }

    /// Number of received frames with errors or too long.
    pub fn dropped(&self) -> u32 {
        self.dropped
    }

    /// The interrupt handler: disables the controller's interrupts until the task has run.
    pub fn interrupt(regs: &R, waker: &AtomicWaker) {
        regs.write(INT_EN, 0);
        waker.wake();
    }

    /// Reads the next good frame into the buffer; returns its length.
    fn take_frame(&mut self) -> Option<usize> {
        while self.regs.read(RX_FIFO_INF) >> 16 & 0xFF != 0 {
            let status = self.regs.read(RX_STATUS);
            let length = (status >> 16 & 0x3FFF) as usize;
            let good = status & RX_ERROR == 0 && (CRC..=MTU + CRC).contains(&length);
            let mut words = self.rx.chunks_exact_mut(4);
            // A bad frame is read too, because no other way to skip it works on all controllers.
            for _ in 0..length.div_ceil(4) {
                let word = self.regs.read(RX_DATA);
                if let Some(bytes) = words.next() {
                    bytes.copy_from_slice(&word.to_le_bytes());
                }
            }
            if good {
                return Some(length - CRC);
            }
            self.dropped = self.dropped.saturating_add(1);
        }
        None
    }

    /// Whether the transmit FIFO has room for the longest frame.
    fn has_room(&self) -> bool {
        let mut info = self.regs.read(TX_FIFO_INF);
        for _ in 0..info >> 16 & 0xFF {
            self.regs.read(TX_STATUS);
            info = self.regs.read(TX_FIFO_INF);
        }
        (info & 0xFFFF) as usize >= BUFFER
    }

    /// Reads the link state from the PHY. The PHY's interrupt is acknowledged first, so that later changes are not
    /// missed.
    fn read_link(&self) -> Result<bool, Lan9118Error> {
        self.regs.write(INT_STS, INT_PHY);
        self.phy_read(PHY_INT_SOURCE)?;
        // Read twice: the bit latches a loss of the link until it is read.
        self.phy_read(PHY_BMSR)?;
        Ok(self.phy_read(PHY_BMSR)? & BMSR_LINK != 0)
    }

    fn enable_interrupts(&self) {
        self.regs.write(INT_EN, INT_RX_STATUS | INT_PHY);
    }

    fn mac_wait(&self) -> Result<(), Lan9118Error> {
        wait(&self.regs, MAC_CMD, |value| value & BUSY == 0)
    }

    fn mac_read(&self, register: u32) -> Result<u32, Lan9118Error> {
        self.mac_wait()?;
        self.regs.write(MAC_CMD, BUSY | MAC_READ | register);
        self.mac_wait()?;
        Ok(self.regs.read(MAC_DATA))
    }

    fn mac_write(&self, register: u32, value: u32) -> Result<(), Lan9118Error> {
        self.mac_wait()?;
        self.regs.write(MAC_DATA, value);
        self.regs.write(MAC_CMD, BUSY | register);
        self.mac_wait()
    }

    fn phy_read(&self, register: u32) -> Result<u32, Lan9118Error> {
        self.mac_write(MAC_MII_ACC, PHY_ADDRESS | register << 6 | MII_BUSY)?;
        self.mac_read(MAC_MII_DATA)
    }

    fn phy_write(&self, register: u32, value: u32) -> Result<(), Lan9118Error> {
        self.mac_write(MAC_MII_DATA, value)?;
        self.mac_write(MAC_MII_ACC, PHY_ADDRESS | register << 6 | MII_WRITE | MII_BUSY)
    }
}

/// Polls a register with a limit.
fn wait(regs: &impl Lan9118Registers, offset: u16, done: impl Fn(u32) -> bool) -> Result<(), Lan9118Error> {
    let is_done = (0..MAX_POLLS).any(|_| done(regs.read(offset)));
    if is_done { Ok(()) } else { Err(Lan9118Error::Stuck { offset }) }
}

impl<R: Lan9118Registers> Driver for Lan9118<R> {
    type RxToken<'a>
        = Received<'a>
    where
        Self: 'a;
    type TxToken<'a>
        = Transmit<'a, R>
    where
        Self: 'a;

    fn receive(&mut self, cx: &mut Context<'_>) -> Option<(Received<'_>, Transmit<'_, R>)> {
        self.waker.register(cx.waker());
        if !self.has_room() {
            cx.waker().wake_by_ref();
            return None;
        }
        let length = match self.take_frame() {
            Some(length) => length,
            None => {
                self.regs.write(INT_STS, INT_RX_STATUS);
                self.enable_interrupts();
                // A frame may have arrived before interrupts were enabled.
                self.take_frame()?
            }
        };
        let frame = self.rx.get_mut(..length)?;
        Some((Received(frame), Transmit { regs: &self.regs, buffer: &mut self.tx }))
    }

    fn transmit(&mut self, cx: &mut Context<'_>) -> Option<Transmit<'_, R>> {
        if !self.has_room() {
            // The FIFO drains by itself; no interrupt for that works on all controllers.
            cx.waker().wake_by_ref();
            return None;
        }
        Some(Transmit { regs: &self.regs, buffer: &mut self.tx })
    }

    fn link_state(&mut self, cx: &mut Context<'_>) -> LinkState {
        self.waker.register(cx.waker());
        // The stack polls the link with each frame; the slow PHY registers are only read after an interrupt of the PHY.
        if self.link.is_none() || self.regs.read(INT_STS) & INT_PHY != 0 {
            self.link = self.read_link().ok();
            self.enable_interrupts();
        }
        if self.link == Some(true) { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = MTU;
        capabilities.max_burst_size = Some(1);
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet(self.address)
    }
}

/// A received frame.
#[derive(Debug)]
pub struct Received<'a>(&'a mut [u8]);

impl RxToken for Received<'_> {
    fn consume<T, F: FnOnce(&mut [u8]) -> T>(self, f: F) -> T {
        f(self.0)
    }
}

/// Buffer for one frame.
#[derive(Debug)]
pub struct Transmit<'a, R> {
    regs: &'a R,
    buffer: &'a mut [u8; BUFFER],
}

impl<R: Lan9118Registers> TxToken for Transmit<'_, R> {
    fn consume<T, F: FnOnce(&mut [u8]) -> T>(self, len: usize, f: F) -> T {
        let len = len.min(MTU);
        let (frame, _) = self.buffer.split_at_mut(len);
        let result = f(frame);
        // First and last segment of a frame of this length; then its tag and length.
        self.regs.write(TX_DATA, 0x3000 | len as u32);
        self.regs.write(TX_DATA, len as u32);
        for word in self.buffer.chunks_exact(4).take(len.div_ceil(4)) {
            let word = word.first_chunk().copied().unwrap_or_default();
            self.regs.write(TX_DATA, u32::from_le_bytes(word));
        }
        self.regs.transmitted();
        result
    }
}

const CRC: usize = 4;
/// Limit of polls of a register whose change takes microseconds.
const MAX_POLLS: u32 = 100_000;

const RX_DATA: u16 = 0x00;
const TX_DATA: u16 = 0x20;
const RX_STATUS: u16 = 0x40;
const TX_STATUS: u16 = 0x48;
const IRQ_CFG: u16 = 0x54;
const INT_STS: u16 = 0x58;
const INT_EN: u16 = 0x5C;
const BYTE_TEST: u16 = 0x64;
const FIFO_INT: u16 = 0x68;
const RX_CFG: u16 = 0x6C;
const TX_CFG: u16 = 0x70;
const HW_CFG: u16 = 0x74;
const RX_FIFO_INF: u16 = 0x7C;
const TX_FIFO_INF: u16 = 0x80;
const PMT_CTRL: u16 = 0x84;
const MAC_CMD: u16 = 0xA4;
const MAC_DATA: u16 = 0xA8;
const AFC_CFG: u16 = 0xAC;
const E2P_CMD: u16 = 0xB0;

const HW_CFG_RESET: u32 = 1;
const TX_ON: u32 = 2;
const INT_RX_STATUS: u32 = 1 << 3;
const INT_PHY: u32 = 1 << 18;
const RX_ERROR: u32 = 1 << 15;
const BUSY: u32 = 1 << 31;
const MAC_READ: u32 = 1 << 30;

const MAC_CR: u32 = 1;
const MAC_ADDRH: u32 = 2;
const MAC_ADDRL: u32 = 3;
const MAC_MII_ACC: u32 = 6;
const MAC_MII_DATA: u32 = 7;
const PHY_ADDRESS: u32 = 1 << 11;
const MII_WRITE: u32 = 1 << 1;
const MII_BUSY: u32 = 1;
const PHY_BMCR: u32 = 0;
const PHY_BMSR: u32 = 1;
const PHY_INT_SOURCE: u32 = 29;
const PHY_INT_MASK: u32 = 30;
const BMSR_LINK: u32 = 1 << 2;

#[cfg(test)]
mod tests;
