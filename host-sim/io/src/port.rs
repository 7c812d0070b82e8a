//! The device of a port, of any kind: opened as `--bind` says, driven by one task, used through a handle.
//!
//! The task reports events of the device as [`PortEvent`]s. The port's owner sends through [`PortTx`], which
//! never waits: its queue is bounded.

use std::io;
use std::rc::Rc;

use proto_core::config::Rs485;
use proto_core::wire::can::CanId;

use super::bind::Device;
use super::can_bus::CanPort;
use super::exchange::{PortEvent, PortTx};
use super::handover::{HandoverDevice, HandoverState, Held, Hold};
use super::serial::SerialPort;
use super::socketcan::KernelCan;
use crate::clock::Clock;

/// A port's bus and its settings, from the configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BusSettings {
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
pub struct OpenPort {
    driver: PortDriver,
    device: Device,
    is_handed_over: bool,
    tx: Rc<PortTx>,
}

#[derive(Debug)]
enum PortDriver {
    Serial(SerialPort),
    Can(CanPort),
    Kernel(KernelCan),
}

impl OpenPort {
    /// Opens the device in the current tokio runtime, which must be a current-thread one.
    ///
    /// # Errors
    /// If the device does not suit the bus, does not exist, or cannot be opened.
    pub async fn open(device: &Device, bus: BusSettings) -> io::Result<Self> {
        Self::open_or_adopt(device, bus, None).await
    }

    /// As [`Self::open`], but takes over the previous owner's device if it matches: clients stay connected, and input
    /// from before the takeover is dropped. A device that does not match is closed first.
    pub async fn open_or_adopt(
        device: &Device,
        bus: BusSettings,
        handover: Option<HandoverDevice>,
    ) -> io::Result<Self> {
        let tx = Rc::new(PortTx::default());
        let handover = handover.filter(|handover| handover.device == *device).map(|handover| handover.what);
        let handover = handover.filter(|what| bus.suits(what));
        let is_handed_over = handover.is_some();
        let driver = match (bus, device) {
            (BusSettings::Serial(settings), _) => {
                PortDriver::Serial(SerialPort::open(device, settings, Rc::clone(&tx), handover).await?)
            }
            (BusSettings::Can { bitrate }, Device::SocketCan { interface }) => {
                PortDriver::Kernel(KernelCan::open(interface, bitrate, Rc::clone(&tx))?)
            }
            (BusSettings::Can { bitrate }, _) => {
                let handover = match handover {
                    Some(HandoverState::Bus(bus)) => Some(bus),
                    _ => None,
                };
                PortDriver::Can(CanPort::open(device, bitrate, Rc::clone(&tx), handover).await?)
            }
        };
        Ok(Self { driver, device: device.clone(), is_handed_over, tx })
    }

    /// Whether the device was taken over from another owner.
    pub fn is_handed_over(&self) -> bool {
        self.is_handed_over
    }

    /// Allows the device to be handed over after the tasks of [`Self::run`] have ended; `None` if the device has no
    /// clients, or costs nothing to open again.
    pub fn hold(&self) -> Option<Hold> {
        let held = match &self.driver {
            PortDriver::Serial(serial) => serial.held()?,
            PortDriver::Can(can) => Held::Bus(can.held()),
            PortDriver::Kernel(_) => return None,
        };
        Some(Hold { device: self.device.clone(), held, tx: Rc::clone(&self.tx) })
    }

    /// Where a client finds the device: the link to a pseudoterminal, the address of a socket, the name of an
    /// interface.
    pub fn place(&self) -> String {
        match &self.driver {
            PortDriver::Serial(serial) => serial.place(),
            PortDriver::Can(can) => can.place(),
            PortDriver::Kernel(can) => can.place(),
        }
    }

    /// Sets the CAN ids that are used in either direction. A CAN interface of the kernel then reports no other ids;
    /// other devices report all frames, as does an interface before this call.
    pub fn listen_to(&mut self, ids: Vec<CanId>) {
        if let PortDriver::Kernel(can) = &mut self.driver {
            can.listen_to(ids);
        }
    }

    /// Lets transmissions take their time on this clock instead of the machine's. Without effect on a CAN interface of
    /// the kernel.
    #[must_use]
    pub fn on_clock(mut self, clock: &Clock) -> Self {
        match &mut self.driver {
            PortDriver::Serial(serial) => serial.clock = clock.clone(),
            PortDriver::Can(can) => can.clock = clock.clone(),
            PortDriver::Kernel(_) => {}
        }
        self
    }

    /// Whether the kernel, and not the clock of [`Self::on_clock`], decides when a frame has left.
    pub fn is_kernel_can(&self) -> bool {
        matches!(self.driver, PortDriver::Kernel(_))
    }

    /// The handle to send with.
    pub fn tx(&self) -> Rc<PortTx> {
        Rc::clone(&self.tx)
    }

    /// Runs the device until the future is dropped, which closes it.
    ///
    /// # Errors
    /// If the device fails permanently; a device that comes back is waited for.
    pub async fn run(self, events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let tx = Rc::clone(&self.tx);
        let ended = match self.driver {
            PortDriver::Serial(serial) => serial.run(events).await,
            PortDriver::Can(can) => can.run(events).await,
            PortDriver::Kernel(can) => can.run(events).await,
        };
        tx.has_failed.set(true);
        ended
    }
}

impl BusSettings {
    /// Whether a port of this bus can take over this device. Line settings may differ; the bit rate of slcan clients
    /// may not.
    fn suits(self, what: &HandoverState) -> bool {
        match (self, what) {
            (Self::Serial(_), HandoverState::Pty(_) | HandoverState::Listen(..)) => true,
            (Self::Can { bitrate }, HandoverState::Bus(bus)) => bus.bitrate == bitrate,
            _ => false,
        }
    }
}
