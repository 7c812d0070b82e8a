//! What a board provides for the tasks: the one interface between them and a chip, its pins and its
//! memory.
//!
//! In: nothing of a protocol. Out: unused devices, each handed out once. How to write your own, and
//! the tests for it: docs/boards.md.

use core::fmt::{Debug, Display};

use embassy_net_driver::Driver;
use embassy_time::Duration;
use proto_core::config::Rs485;

use crate::drivers::can_port::CanPort;
use crate::drivers::line::Line;

/// A board, as the wiring of the tasks sees it.
///
/// Made after clocks, memory and the log, and with the watchdog running. Each method that hands out a
/// device is called from one task at the start, before any device is used; `ethernet` comes last, so
/// that a PHY that is not there does not keep the field buses from running.
pub trait Board {
    /// Number of RS-485 lines; ports of the configuration get them in order.
    const SERIAL_PORTS: usize;
    /// Number of CAN buses; likewise.
    const CAN_PORTS: usize;
    /// How long the watchdog waits for [`Feed::feed`]: at least 4 s, since a task may take a second to
    /// answer and is asked four times in it.
    const WATCHDOG_PERIOD: Duration;

    /// An RS-485 line: bytes in and out, driver-enable, what the line's errors were.
    type Serial: Line + 'static;
    /// A CAN bus.
    type Can: CanPort + 'static;
    /// The Ethernet controller with its PHY.
    type Ethernet: Driver + 'static;
    /// What feeds the watchdog.
    type Watchdog: Feed;
    /// The status LED.
    type Led: Lamp;
    /// Why there is no configuration image.
    type StorageError: Debug + Display + Copy;
    /// Why there is no Ethernet.
    type EthernetError: Debug + Display + Copy;

    /// The configuration image, in memory that can be read; bytes after it are ignored.
    ///
    /// # Errors
    /// There is none, or it cannot be read: then the buses stay silent.
    fn configuration(&mut self) -> Result<&'static [u8], Self::StorageError>;

    /// The next RS-485 line with these settings; `None` if there are no more, or it cannot have
    /// them (which is logged).
    fn serial(&mut self, line: &Rs485) -> Option<Self::Serial>;

    /// The next CAN bus with this bit rate; `None` as for [`Self::serial`].
    fn can(&mut self, bitrate: u32) -> Option<Self::Can>;

    /// The Ethernet controller.
    ///
    /// # Errors
    /// It does not answer: then the field buses run without a controller.
    fn ethernet(&mut self) -> Result<Self::Ethernet, Self::EthernetError>;

    /// What feeds the watchdog; asked for once, and first.
    fn watchdog(&mut self) -> Self::Watchdog;

    /// The status LED; asked for once.
    fn led(&mut self) -> Self::Led;

    /// A seed for local port numbers: another at each start.
    fn seed(&mut self) -> u64;

    /// The maximum stack use so far, in bytes.
    fn stack_used(&self) -> usize;
}

/// Keeps a watchdog from resetting the board.
pub trait Feed {
    /// Another period begins.
    fn feed(&mut self);
}

/// An LED.
pub trait Lamp {
    /// Lights it, or not.
    fn set(&mut self, is_lit: bool);
}
