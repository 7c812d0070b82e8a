//! CAN: FDCAN1 with classic frames.

use embassy_stm32::gpio::{AfType, Flex, OutputType, Pull, Speed};
use embassy_stm32::interrupt::typelevel::{self, Handler, Interrupt};
use embassy_stm32::pac::{FDCAN1, FDCANRAM};
use embassy_stm32::peripherals::{PD0, PD1};
use embassy_stm32::{Peri, peripherals, rcc};
use embassy_sync::waitqueue::AtomicWaker;
use firmware::drivers::mcan::{MESSAGE_RAM_WORDS, Mcan, McanBlock, McanError};

pub(crate) type CanDevice = Mcan<CanRegisters>;

/// The registers of FDCAN1, and the message RAM, which FDCAN2 does not use.
pub(crate) struct CanRegisters;

impl McanBlock for CanRegisters {
    fn read(&self, offset: u8) -> u32 {
        // SAFETY: the driver passes only offsets of M_CAN registers, which are multiples of 4 and within FDCAN1.
        unsafe { FDCAN1.as_ptr().cast::<u8>().add(usize::from(offset)).cast::<u32>().read_volatile() }
    }

    fn write(&self, offset: u8, value: u32) {
        // SAFETY: the driver passes only offsets of M_CAN registers, which are multiples of 4 and within FDCAN1. The
        // controller accesses no memory except its message RAM.
        unsafe { FDCAN1.as_ptr().cast::<u8>().add(usize::from(offset)).cast::<u32>().write_volatile(value) }
    }

    fn ram_read(&self, word: u16) -> u32 {
        // SAFETY: the driver passes words below `MESSAGE_RAM_WORDS`, which the assertion below shows to be within the
        // message RAM.
        unsafe { FDCANRAM.as_ptr().cast::<u32>().add(usize::from(word)).read_volatile() }
    }

    fn ram_write(&self, word: u16, value: u32) {
        // SAFETY: the driver passes words below `MESSAGE_RAM_WORDS`, which the assertion below shows to be within the
        // message RAM. Only the driver and the controller use it.
        unsafe { FDCANRAM.as_ptr().cast::<u32>().add(usize::from(word)).write_volatile(value) }
    }
}

// The message RAM has 10 KiB.
const _: () = assert!(MESSAGE_RAM_WORDS <= 2_560);

static WAKER: AtomicWaker = AtomicWaker::new();

pub(super) struct CanInterrupt;

impl Handler<typelevel::FDCAN1_IT0> for CanInterrupt {
    unsafe fn on_interrupt() {
        Mcan::interrupt(&CanRegisters, &WAKER);
    }
}

/// Bypasses the clock calibration unit between the kernel clock and the controllers. After a reset its output is
/// not a valid clock (RM0433, "Clock calibration on CAN"). Its register can be written in the configuration mode in
/// which [`Mcan::start`] leaves the controller.
fn bypass_calibration() {
    const CCFG: usize = 0x804;
    const BYPASS: u32 = 1 << 6;
    // SAFETY: CCFG is an aligned 32-bit register within the block of FDCAN, and nothing else uses it.
    unsafe {
        let register = FDCAN1.as_ptr().cast::<u8>().add(CCFG).cast::<u32>();
        register.write_volatile(register.read_volatile() | BYPASS);
    }
}

pub(super) type CanPins = (Peri<'static, PD0>, Peri<'static, PD1>);

pub(super) fn start(pins: CanPins, bitrate: u32) -> Result<CanDevice, McanError> {
    const FUNCTION: u8 = 9;
    let (mut rx, mut tx) = (Flex::new(pins.0), Flex::new(pins.1));
    rx.set_as_af_unchecked(FUNCTION, AfType::input(Pull::Up));
    tx.set_as_af_unchecked(FUNCTION, AfType::output(OutputType::PushPull, Speed::High));
    // Dropping the pins would disconnect them.
    core::mem::forget((rx, tx));
    rcc::enable_and_reset::<peripherals::FDCAN1>();
    let clock = rcc::frequency::<peripherals::FDCAN1>().0;
    let started = Mcan::start(CanRegisters, 0, &WAKER, bitrate, clock)?;
    bypass_calibration();
    // SAFETY: `CanInterrupt` is bound as its handler. Critical sections disable all interrupts with PRIMASK, so
    // unmasking one in the NVIC does not break them.
    unsafe { typelevel::FDCAN1_IT0::enable() };
    Ok(started)
}
