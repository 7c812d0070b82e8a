//! What a board provides for the tasks: the only interface between them and a chip.
//!
//! A board hands out each of its devices once. It does not know protocols. How to add and test a board is in
//! docs/boards.md.

use core::fmt::{self, Debug, Display};
use core::future::Future;

use embassy_net_driver::Driver;
use embassy_time::Duration;
use proto_core::config::{Bus, Rs485};
use recipe_update::SlotFlash;

use crate::drivers::can_port::CanPort;
use crate::drivers::line::Line;
use crate::stored::{StoreFlash, StorePlaces};
use crate::update::Site;

/// Numbers of field ports of a board.
#[derive(Debug, Clone, Copy)]
pub struct Ports {
    /// RS-485 lines.
    pub lines: usize,
    /// CAN buses.
    pub buses: usize,
}

/// A configuration has more ports than the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoDevice {
    /// Index of the first port without a device, from 0.
    pub port: u8,
    /// Bus of the port.
    pub bus: &'static str,
    /// Number of ports of this bus on the board.
    pub available: usize,
}

impl Display for NoDevice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { port, bus, available } = self;
        write!(f, "port {}: this board has {available} {bus} ports", port.saturating_add(1))
    }
}

impl Ports {
    /// Checks that there is a device for each of the configuration's ports.
    pub fn have<'c>(self, wanted: impl Iterator<Item = &'c Bus>) -> Result<(), NoDevice> {
        let (mut lines, mut buses) = (self.lines, self.buses);
        for (port, bus) in (0..).zip(wanted) {
            let (left, bus, available) = match bus {
                Bus::Rs485(_) => (&mut lines, "RS-485", self.lines),
                Bus::Can { .. } => (&mut buses, "CAN", self.buses),
                Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => continue,
            };
            *left = left.checked_sub(1).ok_or(NoDevice { port, bus, available })?;
        }
        Ok(())
    }
}

/// A board.
///
/// A value of this type exists only after clocks, memory, the log and the watchdog are running. The methods that hand
/// out devices are called during the start, before any device is used; `ethernet` is called last, so that the field
/// buses run even without a PHY. Each method returns one concrete type of the board, because a task cannot be generic.
pub trait Board {
    /// Name of the board in firmware headers.
    const NAME: &'static str;
    /// Number of RS-485 lines, assigned to the configuration's ports in order.
    const SERIAL_PORTS: usize;
    /// Number of CAN buses, assigned likewise.
    const CAN_PORTS: usize;
    /// Timeout of the watchdog: at least 4 s, because tasks are checked four times per timeout, and may take a second
    /// to answer.
    const WATCHDOG_PERIOD: Duration;

    /// The configuration image written to the board by a probe or a file, which is adopted into the store. Trailing
    /// bytes are ignored.
    ///
    /// # Errors
    /// There is none, or it cannot be read. A configuration from the store then runs.
    fn configuration(&mut self) -> Result<&'static [u8], impl Debug + Display + Copy>;

    /// The flash of the store (docs/store.md); called once. `None` if the board has none: it then only runs the image
    /// above.
    fn flash(&mut self) -> Option<StorePlaces<impl StoreFlash + 'static>>;

    /// The slots of the firmware (docs/update.md) and their flash; called once. The program runs in one of them, and
    /// the other one can be written.
    fn slots(&mut self) -> Site<impl SlotFlash + 'static>;

    /// Waits for the flash during the start, when no task runs yet. Erasing a sector may take two seconds, so the
    /// watchdog is fed meanwhile. This cannot hide a hang, because each flash operation has a time limit.
    fn block_on<T>(&mut self, operation: impl Future<Output = T>) -> T;

    /// The next RS-485 line, with these settings; `None` if there is none left, or if it does not support the
    /// settings, which it logs.
    fn serial(&mut self, line: &Rs485) -> Option<impl Line + 'static>;

    /// The next CAN bus, with this bit rate; `None` as for [`Self::serial`].
    fn can(&mut self, bitrate: u32) -> Option<impl CanPort + 'static>;

    /// The Ethernet controller with its PHY.
    ///
    /// # Errors
    /// It does not work. The field ports then run without a controller.
    fn ethernet(&mut self) -> Result<impl Driver + 'static, impl Debug + Display + Copy>;

    /// The watchdog; called once, before all others.
    fn watchdog(&mut self) -> impl FeedWatchdog;

    /// The status LED; called once.
    fn led(&mut self) -> impl StatusLed;

    /// A seed for local port numbers, different at each start.
    fn seed(&mut self) -> u64;

    /// Unpredictable random bytes for the console's nonces; `None` if the board has no source of them, and then it has
    /// no console. The clock and the chip's serial number are not unpredictable.
    fn random(&mut self) -> Option<[u8; 32]>;

    /// The button that permits a client to set the access key; called once.
    fn button(&mut self) -> impl Button + 'static;

    /// Highest stack use so far, in bytes.
    fn stack_used(&self) -> usize;
}

/// Keeps a watchdog from resetting the board.
pub trait FeedWatchdog {
    /// Restarts the watchdog's period.
    fn feed(&mut self);
}

/// A button.
pub trait Button {
    /// Whether it is pressed now. Polled twenty times a second.
    fn is_pressed(&mut self) -> bool;
}

/// An LED.
pub trait StatusLed {
    /// Switches it on or off.
    fn set(&mut self, is_lit: bool);
}
