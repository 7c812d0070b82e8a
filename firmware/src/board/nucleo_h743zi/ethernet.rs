//! Ethernet: RMII with the board's LAN8742A, 100 Mbit/s full duplex.
//!
//! The driver would wait forever for the MAC's reset, which needs the PHY's 50 MHz, and for a missing PHY. So both are
//! checked before the driver is started, with a time limit.

use core::fmt;
use core::future::Future;
use core::pin::pin;
use core::task::Context;

use embassy_stm32::eth::{self, PacketQueue, Phy, Sma, StationManagement};
use embassy_stm32::gpio::{AfType, Flex, OutputType, Speed};
use embassy_stm32::pac::syscfg::vals::EthSelPhy;
use embassy_stm32::pac::{ETH, RCC, SYSCFG};
use embassy_stm32::peripherals::{self, ETH_SMA, PA1, PA2, PA7, PB13, PC1, PC4, PC5, PG11, PG13};
use embassy_stm32::{Peri, interrupt};
use embassy_time::{Duration, Instant, Timer};
use static_cell::ConstStaticCell;

use super::leds::BoardLed;
use firmware::platform::StatusLed;

pub(crate) type Ethernet = eth::Ethernet<'static, peripherals::ETH, Lan8742>;

/// Why there is no Ethernet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EthernetError {
    /// The PHY provides no clock.
    NoClock,
    /// There is no PHY at the expected address.
    NoPhy {
        /// The identifier that was read.
        found: u16,
    },
    /// The controller has already been handed out.
    Taken,
}

impl fmt::Display for EthernetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoClock => f.write_str("no Ethernet: no 50 MHz clock from the PHY on PA1"),
            Self::NoPhy { found } => write!(f, "no Ethernet: the PHY's identifier reads {found:04X}"),
            Self::Taken => f.write_str("Ethernet was started before"),
        }
    }
}

/// The controller and its pins.
pub(super) struct EthernetParts {
    pub(super) mac: Peri<'static, peripherals::ETH>,
    pub(super) sma: Peri<'static, ETH_SMA>,
    pub(super) ref_clk: Peri<'static, PA1>,
    pub(super) mdio: Peri<'static, PA2>,
    pub(super) crs_dv: Peri<'static, PA7>,
    pub(super) mdc: Peri<'static, PC1>,
    pub(super) rxd0: Peri<'static, PC4>,
    pub(super) rxd1: Peri<'static, PC5>,
    pub(super) tx_en: Peri<'static, PG11>,
    pub(super) txd0: Peri<'static, PG13>,
    pub(super) txd1: Peri<'static, PB13>,
}

impl EthernetParts {
    /// Starts the controller. Takes half a second at most, if the PHY provides its clock but does not answer.
    pub(super) fn start<I>(
        mut self,
        irqs: I,
        address: [u8; 6],
        led: BoardLed,
    ) -> Result<Ethernet, EthernetError>
    where
        I: interrupt::typelevel::Binding<interrupt::typelevel::ETH, eth::InterruptHandler> + 'static,
    {
        if !has_clock(self.ref_clk.reborrow()) {
            return Err(EthernetError::NoClock);
        }
        let mut sma = Sma::new(self.sma, self.mdio, self.mdc);
        // After power-on the PHY may not answer yet.
        let until = Instant::now() + TIMEOUT;
        loop {
            match sma.smi_read(PHY_ADDRESS, PHY_ID1) {
                PHY_VENDOR => break,
                found if Instant::now() > until => return Err(EthernetError::NoPhy { found }),
                _ => {}
            }
        }
        // Statics are in AXI SRAM, which the DMA reaches.
        static QUEUE: ConstStaticCell<PacketQueue<TX_FRAMES, RX_FRAMES>> =
            ConstStaticCell::new(PacketQueue::new());
        let queue = QUEUE.try_take().ok_or(EthernetError::Taken)?;
        Ok(eth::Ethernet::new_with_phy(
            queue,
            self.mac,
            irqs,
            self.ref_clk,
            self.crs_dv,
            self.rxd0,
            self.rxd1,
            self.txd0,
            self.txd1,
            self.tx_en,
            address,
            Lan8742 { sma, led, is_up: false, next_poll: Instant::MIN },
        ))
    }
}

/// Resets the MAC. The reset succeeds only with the PHY's clock, so the result tells whether there is one.
fn has_clock(ref_clk: Peri<'_, PA1>) -> bool {
    const FUNCTION: u8 = 11;
    let mut pin = Flex::new(ref_clk);
    pin.set_as_af_unchecked(FUNCTION, AfType::output(OutputType::PushPull, Speed::VeryHigh));
    // Dropping the pin would disconnect the clock.
    core::mem::forget(pin);
    critical_section::with(|_| {
        RCC.ahb1enr().modify(|w| {
            w.set_ethen(true);
            w.set_ethtxen(true);
            w.set_ethrxen(true);
        });
        SYSCFG.pmcr().modify(|w| w.set_eth_sel_phy(EthSelPhy::RMII));
    });
    // The write has to be complete before the reset.
    SYSCFG.pmcr().read();
    let mode = ETH.ethernet_dma().dmamr();
    mode.modify(|w| w.set_swr(true));
    let until = Instant::now() + TIMEOUT;
    while mode.read().swr() {
        if Instant::now() > until {
            return false;
        }
    }
    true
}

/// The PHY. It advertises only 100 Mbit/s full duplex, the MAC's setting: with a peer that does not support it
/// there is no link, instead of one that loses frames.
pub(crate) struct Lan8742 {
    sma: Sma<'static, ETH_SMA>,
    led: BoardLed,
    /// The link was up at the last poll.
    is_up: bool,
    /// Time of the next poll: it takes 0.1 ms, and the network stack asks with each frame.
    next_poll: Instant,
}

impl Lan8742 {
    fn read(&mut self, register: u8) -> u16 {
        self.sma.smi_read(PHY_ADDRESS, register)
    }

    fn write(&mut self, register: u8, value: u16) {
        self.sma.smi_write(PHY_ADDRESS, register, value);
    }
}

impl Phy for Lan8742 {
    /// Only starts the reset, which takes up to half a second. `poll_link` sets up the PHY after it.
    fn phy_reset(&mut self) {
        self.write(PHY_CONTROL, CONTROL_RESET);
        self.next_poll = Instant::now() + LINK_PERIOD;
    }

    fn phy_init(&mut self) {
        if self.read(PHY_CONTROL) & CONTROL_RESET != 0 {
            return;
        }
        self.write(PHY_ADVERTISE, ADVERTISE_100_FULL);
        self.write(PHY_CONTROL, CONTROL_NEGOTIATE);
    }

    fn poll_link(&mut self, cx: &mut Context<'_>) -> bool {
        let now = Instant::now();
        if now >= self.next_poll {
            self.next_poll = now + LINK_PERIOD;
            // A reset, also one caused by a disturbance, clears the PHY's settings.
            if self.read(PHY_ADVERTISE) != ADVERTISE_100_FULL {
                self.phy_init();
            }
            self.is_up = self.read(PHY_STATUS) & STATUS_UP == STATUS_UP
                && self.read(PHY_RESULT) & RESULT_MASK == RESULT_100_FULL;
            self.led.set(self.is_up);
        }
        // Wakes the network's task for the next poll, also after the timer is dropped.
        let _ = pin!(Timer::at(self.next_poll)).poll(cx);
        self.is_up
    }
}

const TX_FRAMES: usize = 4;
const RX_FRAMES: usize = 4;
const TIMEOUT: Duration = Duration::from_millis(250);
const LINK_PERIOD: Duration = Duration::from_millis(250);

const PHY_ADDRESS: u8 = 0;
const PHY_CONTROL: u8 = 0;
const PHY_STATUS: u8 = 1;
const PHY_ID1: u8 = 2;
const PHY_ADVERTISE: u8 = 4;
const PHY_RESULT: u8 = 31;
const PHY_VENDOR: u16 = 0x0007;
const CONTROL_RESET: u16 = 1 << 15;
/// Enable and restart auto-negotiation.
const CONTROL_NEGOTIATE: u16 = 1 << 12 | 1 << 9;
/// 100BASE-TX full duplex, IEEE 802.3.
const ADVERTISE_100_FULL: u16 = 1 << 8 | 1;
/// Auto-negotiation complete, link up.
const STATUS_UP: u16 = 1 << 5 | 1 << 2;
const RESULT_MASK: u16 = 0b111 << 2;
const RESULT_100_FULL: u16 = 0b110 << 2;
