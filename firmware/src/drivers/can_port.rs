//! The trait of a CAN controller for the tasks.

use embedded_can::Frame;
use proto_core::engine::BusState;
use proto_core::wire::can::CanFrame;
use proto_core::wire::can::CanId;

/// A CAN controller. Its driver buffers received frames while no task receives.
#[allow(async_fn_in_trait, reason = "all tasks run on one executor: no future is sent anywhere")]
pub trait CanPort {
    /// The driver's frame.
    type Frame: Frame;

    /// The next event. No event is lost if the future is dropped before it completes.
    async fn receive(&mut self) -> CanEvent<Self::Frame>;

    /// Queues a frame for sending, as soon as there is room. When all queued frames have left, `receive`
    /// reports [`CanEvent::Sent`].
    ///
    /// # Errors
    /// [`BusOff`] if the controller is bus-off; `receive` then does not report that again.
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusOff>;

    /// Drops the queued frames; after bus-off also starts the recovery. `receive` reports when the controller is back
    /// on the bus. On a disturbed bus that may never happen.
    fn recover(&mut self);

    /// Sets the acceptance filters and joins the bus. Frames with other ids need not be received; a controller
    /// without room for all ids may accept more. Called once, before anything else.
    fn set_filters(&mut self, ids: &[CanId]);

    /// The controller's counters.
    fn counters(&self) -> CanCounters {
        CanCounters::default()
    }

    /// The bit rate of the bus, in bit/s.
    fn bitrate(&self) -> u32;
}

/// An event of a CAN controller.
#[derive(Debug, Clone, Copy)]
pub enum CanEvent<F> {
    /// A frame.
    Frame(F),
    /// The error state of the controller changed.
    Bus(BusState),
    /// All queued frames have left.
    Sent,
}

/// The controller is bus-off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BusOff;

/// The counters of a CAN controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CanCounters {
    /// The transmit error counter of the CAN standard: bus-off beyond 255.
    pub transmit_errors: u8,
    /// The receive error counter of the CAN standard.
    pub receive_errors: u8,
    /// How often frames were lost because they were not read from the controller in time. Wraps.
    pub lost: u32,
}
