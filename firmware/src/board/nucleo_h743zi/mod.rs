//! ST's NUCLEO-H743ZI2: an STM32H743ZI with a LAN8742A. RS-485 on USART2 and UART7, CAN on FDCAN1; the log goes
//! to the debugger (defmt, RTT); the configuration image is in flash. Pins and wiring are in firmware/README.md.

mod button;
mod can;
mod clocks;
mod crash_record;
mod ethernet;
mod flash;
mod identity;
mod leds;
mod readable;
mod serial;
mod storage;
mod watchdog;

use core::future::Future;

use cortex_m::peripheral::Peripherals as Core;
use defmt_rtt as _;
use embassy_executor::{Executor, Spawner};
use embassy_stm32::{bind_interrupts, eth};
use embassy_time::Duration;
use firmware::fmt::DisplayText;
use firmware::stored::StorePlaces;
use firmware::update::Site;
use firmware::{error, info, platform, warn};
use panic_probe as _;
use proto_core::config::Rs485;
use recipe_update::NUCLEO_H743ZI;
use static_cell::StaticCell;

// The devices, by the names that tasks have for them.
use super::Tasks;
pub(crate) use button::UserButton;
pub(crate) use can::CanDevice;
pub(crate) use ethernet::{Ethernet, EthernetError};
pub(crate) use flash::{Area as StoreArea, Area as SlotArea};
pub(crate) use leds::BoardLed;
pub(crate) use serial::SerialDevice;
pub(crate) use storage::StorageError;
pub(crate) use watchdog::Watchdog;

bind_interrupts!(struct Irqs {
    USART2 => serial::Usart2Interrupt;
    UART7 => serial::Uart7Interrupt;
    FDCAN1_IT0 => can::CanInterrupt;
    ETH => eth::InterruptHandler;
});

defmt::timestamp!("{=u64:us}", embassy_time::Instant::now().as_micros());

/// Devices that have not been handed out.
pub(crate) struct NucleoH743zi {
    serial: serial::Lines,
    can: Option<can::CanPins>,
    ethernet: Option<ethernet::EthernetParts>,
    link: Option<BoardLed>,
    status: Option<BoardLed>,
    watchdog: Option<Watchdog>,
    stores: Option<StorePlaces<flash::Area>>,
    slots: Option<Site<flash::Area>>,
    button: Option<UserButton>,
}

#[expect(refining_impl_trait, reason = "tasks name the types, because a task cannot be generic")]
impl platform::Board for NucleoH743zi {
    const NAME: &'static str = NUCLEO_H743ZI.board;
    const SERIAL_PORTS: usize = 2;
    const CAN_PORTS: usize = 1;
    const WATCHDOG_PERIOD: Duration = watchdog::PERIOD;

    fn configuration(&mut self) -> Result<&'static [u8], StorageError> {
        storage::read()
    }

    fn flash(&mut self) -> Option<StorePlaces<flash::Area>> {
        self.stores.take()
    }

    fn slots(&mut self) -> Site<flash::Area> {
        let none = Site { board: Self::NAME, slots: Err("asked for once") };
        self.slots.take().unwrap_or(none)
    }

    fn block_on<T>(&mut self, operation: impl Future<Output = T>) -> T {
        flash::block_on(operation, watchdog::feed_during_start)
    }

    fn serial(&mut self, line: &Rs485) -> Option<SerialDevice> {
        self.serial.next(line)?.inspect_err(|error| error!("{}", DisplayText(error))).ok()
    }

    fn can(&mut self, bitrate: u32) -> Option<CanDevice> {
        can::start(self.can.take()?, bitrate).inspect_err(|error| error!("{}", DisplayText(error))).ok()
    }

    fn ethernet(&mut self) -> Result<Ethernet, EthernetError> {
        let (parts, led) = self.ethernet.take().zip(self.link.take()).ok_or(EthernetError::Taken)?;
        parts.start(Irqs, identity::ethernet_address(), led)
    }

    /// The watchdog has been running since the reset.
    fn watchdog(&mut self) -> Watchdog {
        self.watchdog.take().expect("asked for once")
    }

    fn led(&mut self) -> BoardLed {
        self.status.take().expect("asked for once")
    }

    fn seed(&mut self) -> u64 {
        identity::seed()
    }

    fn random(&mut self) -> Option<[u8; 32]> {
        identity::random()
    }

    fn button(&mut self) -> UserButton {
        self.button.take().expect("asked for once")
    }

    fn stack_used(&self) -> usize {
        super::stack::used()
    }
}

/// Starts the board, and runs the tasks that `start` makes with it.
///
/// # Panics
/// If it was called before.
pub(crate) fn run<const N: usize>(start: impl FnOnce(Spawner, NucleoH743zi) -> Tasks<N>) -> ! {
    super::stack::guard();
    super::stack::paint();
    clocks::errata();
    let mut core = Core::take();
    if let Some(core) = &mut core {
        // Only the instruction cache is enabled: the Ethernet DMA and the debugger access memory directly, past a data
        // cache.
        core.SCB.enable_icache();
    }
    let watchdog = Watchdog::start();
    let source = clocks::source();
    let p = embassy_stm32::init(clocks::config(source));
    let leds = leds::Leds::new(p.PB0, p.PE1, p.PB14);
    log_start(source);
    if let Some(core) = &mut core {
        watchdog::supervise(&mut core.SYST);
    }
    let board = NucleoH743zi {
        serial: serial::Lines::new(serial::UartPins {
            usart2: (p.PD5, p.PD6, p.PD4),
            uart7: (p.PE8, p.PE7, p.PE9),
        }),
        can: Some((p.PD0, p.PD1)),
        ethernet: Some(ethernet::EthernetParts {
            mac: p.ETH,
            sma: p.ETH_SMA,
            ref_clk: p.PA1,
            mdio: p.PA2,
            crs_dv: p.PA7,
            mdc: p.PC1,
            rxd0: p.PC4,
            rxd1: p.PC5,
            tx_en: p.PG11,
            txd0: p.PG13,
            txd1: p.PB13,
        }),
        link: Some(leds.link),
        status: Some(leds.status),
        watchdog: Some(watchdog),
        // SAFETY: this is the only call, and it is executed once: a second call of `run` panics in
        // `embassy_stm32::init`.
        stores: Some(unsafe { flash::stores() }),
        // SAFETY: this is the only call, and it is executed once, as above. A test of the layout checks that slots and
        // stores do not overlap.
        slots: Some(unsafe { flash::slots() }),
        button: Some(UserButton::new(p.PC13)),
    };
    static EXECUTOR: StaticCell<Executor> = StaticCell::new();
    EXECUTOR.init(Executor::new()).run(|spawner| {
        start(spawner, board);
    })
}

/// Logs why the board was reset, and a missing external clock.
fn log_start(source: clocks::ClockSource) {
    let cause = embassy_stm32::pac::RCC.rsr().read();
    embassy_stm32::pac::RCC.rsr().modify(|w| w.set_rmvf(true));
    if cause.iwdg1rstf() {
        warn!("restarted by the watchdog");
    } else {
        info!("started");
    }
    crash_record::log();
    if source == clocks::ClockSource::Internal {
        warn!("no 8 MHz clock from the debugger: using the internal clock, too inaccurate for fast CAN");
    }
}

/// Handles faults and panics. Waits for the watchdog's reset, which leaves time to attach a debugger.
#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &cortex_m_rt::ExceptionFrame) -> ! {
    Watchdog::ensure_running();
    leds::fault();
    crash_record::save_fault(frame);
    loop {
        cortex_m::asm::nop();
    }
}
