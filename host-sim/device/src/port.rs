//! One port's device of any kind: opened from a `--bind`, driven by one task, used through a
//! handle.
//!
//! The task reports events of the device as [`PortEvent`]s. The port's owner sends through
//! [`PortTx`], which takes everything at once and never more than a fixed amount.

use std::io;
use std::rc::Rc;

use proto_core::config::Rs485;
use proto_core::wire::can::CanId;

use super::bind::Device;
use super::can_bus::CanPort;
use super::exchange::{PortEvent, PortTx};
use super::line::LinePort;
use super::socketcan::KernelCan;

/// The settings of a port's bus in the configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PortBus {
    /// A serial line.
    Serial(Rs485),
    /// A CAN bus of this bit rate.
    Can {
        /// Bit/s.
        bitrate: u32,
    },
}

/// A port whose device is open.
#[derive(Debug)]
pub struct Port {
    driver: Driver,
    tx: Rc<PortTx>,
}

#[derive(Debug)]
enum Driver {
    Line(LinePort),
    Can(CanPort),
    Kernel(KernelCan),
}

impl Port {
    /// Opens the device in the current tokio runtime, which must be a current-thread one.
    ///
    /// # Errors
    /// If the device does not suit the bus, does not exist, or cannot be opened.
    pub async fn open(device: &Device, bus: PortBus) -> io::Result<Self> {
        let tx = Rc::new(PortTx::default());
        let driver = match (bus, device) {
            (PortBus::Serial(settings), _) => {
                Driver::Line(LinePort::open(device, settings, Rc::clone(&tx)).await?)
            }
            (PortBus::Can { bitrate }, Device::SocketCan { interface }) => {
                Driver::Kernel(KernelCan::open(interface, bitrate, Rc::clone(&tx))?)
            }
            (PortBus::Can { bitrate }, _) => {
                Driver::Can(CanPort::open(device, bitrate, Rc::clone(&tx)).await?)
            }
        };
        Ok(Self { driver, tx })
    }

    /// The port's public place: the link of a pseudoterminal, the address of a socket.
    pub fn place(&self) -> String {
        match &self.driver {
            Driver::Line(line) => line.place(),
            Driver::Can(can) => can.place(),
            Driver::Kernel(can) => can.place(),
        }
    }

    /// Sets the ids that are used in either direction: a CAN interface of the kernel then passes on
    /// no others. Other devices, and an interface before this call, pass on everything.
    pub fn listen_to(&mut self, ids: Vec<CanId>) {
        if let Driver::Kernel(can) = &mut self.driver {
            can.listen_to(ids);
        }
    }

    /// The handle to send with.
    pub fn tx(&self) -> Rc<PortTx> {
        Rc::clone(&self.tx)
    }

    /// Drives the device until the future is dropped, which closes it.
    ///
    /// # Errors
    /// Only if the device is permanently unusable; otherwise the task waits for it to come back.
    pub async fn run(self, events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        match self.driver {
            Driver::Line(line) => line.run(events).await,
            Driver::Can(can) => can.run(events).await,
            Driver::Kernel(can) => can.run(events).await,
        }
    }
}
