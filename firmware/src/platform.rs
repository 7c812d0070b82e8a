//! What a board provides for the tasks: the only interface between them and a chip.
//!
//! A board hands out its devices, each once. It knows no protocol. How to add a board, and how to test it, is in
//! docs/boards.md.

use core::fmt::{Debug, Display};
use core::future::Future;

use embassy_net_driver::Driver;
use embassy_time::Duration;
use proto_core::config::Rs485;

use crate::drivers::can_port::CanPort;
use crate::drivers::line::Line;
use crate::kept::StoreFlash;

/// A board.
///
/// It exists when clocks, memory, the log and the watchdog are running. The methods that hand out devices
/// are called during the start, before any device is used; `ethernet` is called last, so that the field buses
/// run without a PHY.
pub trait Board {
    /// Number of RS-485 lines, assigned to the configuration's ports in order.
    const SERIAL_PORTS: usize;
    /// Number of CAN buses, assigned likewise.
    const CAN_PORTS: usize;
    /// Timeout of the watchdog: at least 4 s, since tasks are checked four times in it, and may take a second to
    /// answer.
    const WATCHDOG_PERIOD: Duration;

    /// An RS-485 line.
    type Serial: Line + 'static;
    /// A CAN bus.
    type Can: CanPort + 'static;
    /// The Ethernet controller with its PHY.
    type Ethernet: Driver + 'static;
    /// The watchdog.
    type Watchdog: FeedWatchdog;
    /// The status LED.
    type Led: StatusLed;
    /// The flash of the store.
    type Flash: StoreFlash + 'static;
    /// Why there is no configuration image.
    type StorageError: Debug + Display + Copy;
    /// Why there is no Ethernet.
    type EthernetError: Debug + Display + Copy;

    /// The configuration image that was put on the board from outside, and is taken over into the store; bytes
    /// after it are ignored.
    ///
    /// # Errors
    /// There is none, or it cannot be read. What the store holds then runs.
    fn configuration(&mut self) -> Result<&'static [u8], Self::StorageError>;

    /// The flash of the store (docs/store.md); called once. `None` if the board has none: it keeps nothing, and
    /// runs the image above.
    fn flash(&mut self) -> Option<Self::Flash>;

    /// Waits for the flash during the start, when no task runs yet. A sector may take two seconds, so the watchdog
    /// is fed meanwhile; each operation of the flash has a time limit.
    fn block_on<T>(&mut self, operation: impl Future<Output = T>) -> T;

    /// The next RS-485 line, with these settings; `None` if there is none left, or if it does not support the
    /// settings, which it logs.
    fn serial(&mut self, line: &Rs485) -> Option<Self::Serial>;

    /// The next CAN bus, with this bit rate; `None` as for [`Self::serial`].
    fn can(&mut self, bitrate: u32) -> Option<Self::Can>;

    /// The Ethernet controller.
    ///
    /// # Errors
    /// It does not work. The field buses then run without a controller.
    fn ethernet(&mut self) -> Result<Self::Ethernet, Self::EthernetError>;

    /// The watchdog; called once, before all others.
    fn watchdog(&mut self) -> Self::Watchdog;

    /// The status LED; called once.
    fn led(&mut self) -> Self::Led;

    /// A seed for local port numbers, different at each start.
    fn seed(&mut self) -> u64;

    /// Highest stack use so far, in bytes.
    fn stack_used(&self) -> usize;
}

/// Keeps a watchdog from resetting the board.
pub trait FeedWatchdog {
    /// Restarts the watchdog's period.
    fn feed(&mut self);
}

/// An LED.
pub trait StatusLed {
    /// Switches it on or off.
    fn set(&mut self, is_lit: bool);
}
