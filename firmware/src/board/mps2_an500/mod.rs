//! QEMU's `mps2-an500`: a Cortex-M7 with five UARTs and a LAN9118. RS-485 on UART 0 and 1, CAN as slcan
//! on UART 2, the log on UART 3; configuration, store and slots are files on the host, named by semihosting arguments.
//!
//! It exists so that the firmware runs end to end in CI.

mod arguments;
mod button;
mod console;
mod executor;
mod fault_injection;
mod flash;
mod host_flash;
mod log_output;
mod registers;
mod storage;
mod time;
mod uart;
mod watchdog;

use core::future::Future;

use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::NVIC;
use embassy_executor::Spawner;
use embassy_sync::waitqueue::AtomicWaker;
use embassy_time::Duration;
use firmware::drivers::lan9118::{Lan9118, Lan9118Registers};
use firmware::drivers::slcan::SlcanPort;
use firmware::platform::{self, StatusLed};
use firmware::stored::StorePlaces;
use firmware::update::Site;
use proto_core::config::Rs485;
use recipe_update::MPS2_AN500;

// The devices, by the names that tasks have for them.
pub(crate) use FpgaLed as BoardLed;
pub(crate) use button::UserButton;
pub(crate) use firmware::drivers::lan9118::Lan9118Error as EthernetError;
pub(crate) use flash::StoreFile as StoreArea;
pub(crate) use host_flash::HostFlash as SlotArea;
pub(crate) use storage::StorageError;
pub(crate) use uart::Uart as SerialDevice;
pub(crate) use watchdog::Watchdog;

/// CAN is slcan on a UART here.
pub(crate) type CanDevice = SlcanPort<uart::Uart>;
pub(crate) type Ethernet = Lan9118<LanRegisters>;
use super::Tasks;

/// The numbers of the next devices to hand out.
pub(crate) struct Mps2An500 {
    serial: usize,
    can: usize,
}

#[expect(refining_impl_trait, reason = "tasks name the types, because a task cannot be generic")]
impl platform::Board for Mps2An500 {
    const NAME: &'static str = MPS2_AN500.board;
    const SERIAL_PORTS: usize = 2;
    const CAN_PORTS: usize = 1;
    const WATCHDOG_PERIOD: Duration = watchdog::PERIOD;

    fn configuration(&mut self) -> Result<&'static [u8], StorageError> {
        storage::read()
    }

    fn flash(&mut self) -> Option<StorePlaces<flash::StoreFile>> {
        flash::store().map(StorePlaces::one)
    }

    fn slots(&mut self) -> Site<host_flash::HostFlash> {
        flash::slots()
    }

    /// The operations of a file on the host complete at once, so the watchdog need not be fed.
    fn block_on<T>(&mut self, operation: impl Future<Output = T>) -> T {
        embassy_futures::block_on(operation)
    }

    /// Baud rate and format are not emulated.
    fn serial(&mut self, _: &Rs485) -> Option<SerialDevice> {
        let port = self.serial;
        (port < Self::SERIAL_PORTS).then(|| {
            self.serial += 1;
            uart::Uart::open(port)
        })
    }

    fn can(&mut self, bitrate: u32) -> Option<CanDevice> {
        let port = self.can;
        (port < Self::CAN_PORTS).then(|| {
            self.can += 1;
            SlcanPort::new(uart::Uart::open(Self::SERIAL_PORTS + port), bitrate)
        })
    }

    fn ethernet(&mut self) -> Result<Ethernet, EthernetError> {
        let driver = Lan9118::start(LanRegisters, &LAN_WAKER)?;
        Irq::LAN9118.enable();
        Ok(driver)
    }

    fn watchdog(&mut self) -> Watchdog {
        Watchdog::start()
    }

    fn led(&mut self) -> FpgaLed {
        FpgaLed
    }

    fn seed(&mut self) -> u64 {
        storage::host_time()
    }

    fn random(&mut self) -> Option<[u8; 32]> {
        storage::random()
    }

    fn button(&mut self) -> UserButton {
        UserButton::new()
    }

    fn stack_used(&self) -> usize {
        super::stack::used()
    }
}

#[derive(Debug)]
pub(crate) struct FpgaLed;

impl StatusLed for FpgaLed {
    fn set(&mut self, is_lit: bool) {
        registers::write(registers::FPGAIO, u32::from(is_lit));
    }
}

/// Starts the board, and runs the tasks that `start` makes with it.
pub(crate) fn run<const N: usize>(start: impl FnOnce(Spawner, Mps2An500) -> Tasks<N>) -> ! {
    super::stack::guard();
    super::stack::paint();
    console::start();
    log_output::start();
    time::start();
    executor::run(|spawner| {
        let tasks = start(spawner, Mps2An500 { serial: 0, can: 0 });
        fault_injection::start(&tasks);
    })
}

/// Ends QEMU with this exit code. With a loader, restarts the board instead, so that the loader decides which firmware
/// runs next.
fn end(code: i32) -> ! {
    match super::slot::running() {
        None => semihosting::process::exit(code),
        Some(_) => cortex_m::peripheral::SCB::sys_reset(),
    }
}

fn print_running() {
    match firmware::tasks::watchdog::running() {
        Some(task) => console::print(format_args!("task {task} was running\r\n")),
        None => console::print(format_args!("no task was running\r\n")),
    }
}

#[panic_handler]
fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    console::print(format_args!("{info}\r\n"));
    print_running();
    end(101)
}

#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &cortex_m_rt::ExceptionFrame) -> ! {
    console::print(format_args!("hard fault at {:08X}\r\n", frame.pc()));
    print_running();
    end(102)
}

#[derive(Debug)]
pub(crate) struct LanRegisters;

impl Lan9118Registers for LanRegisters {
    fn read(&self, offset: u16) -> u32 {
        registers::read(registers::LAN9118 + u32::from(offset))
    }

    fn write(&self, offset: u16, value: u32) {
        registers::write(registers::LAN9118 + u32::from(offset), value);
    }

    /// QEMU polls the host's sockets when a timer expires, but not when the guest sends. Without this timer a
    /// connection to the host takes a second.
    fn transmitted(&self) {
        time::wake_emulator();
    }
}

static LAN_WAKER: AtomicWaker = AtomicWaker::new();

fn on_lan9118() {
    Lan9118::interrupt(&LanRegisters, &LAN_WAKER);
}

#[derive(Debug, Clone, Copy)]
struct Irq(u16);

impl Irq {
    const TIMER0: Self = Self(8);
    const LAN9118: Self = Self(13);

    fn enable(self) {
        // SAFETY: the vector table below has a handler for it. Critical sections disable all interrupts with PRIMASK,
        // so unmasking one in the NVIC does not break them.
        unsafe { NVIC::unmask(self) }
    }
}

// SAFETY: the numbers of TIMER0, LAN9118 and the UARTs are valid indices of the vector table below, which has their
// handlers at these positions. An `Irq` does not change its number.
unsafe impl InterruptNumber for Irq {
    fn number(self) -> u16 {
        self.0
    }
}

fn on_unexpected() {
    panic!("an interrupt that was not enabled");
}

#[unsafe(link_section = ".vector_table.interrupts")]
#[unsafe(no_mangle)]
static __INTERRUPTS: [fn(); 32] = {
    let mut table: [fn(); 32] = [on_unexpected; 32];
    table[0] = uart::on_rx::<0>;
    table[1] = uart::on_tx::<0>;
    table[2] = uart::on_rx::<1>;
    table[3] = uart::on_tx::<1>;
    table[4] = uart::on_rx::<2>;
    table[5] = uart::on_tx::<2>;
    table[8] = time::on_alarm;
    table[13] = on_lan9118;
    table
};
