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

    /// The next frame, a change of the controller's state, or the end of what was sent. Nothing is lost
    /// when the future is dropped before it is done.
    async fn receive(&mut self) -> CanEvent<Self::Frame>;

    /// Hands a frame over for sending after the previous ones, as soon as there is room. When all
    /// have left, `receive` reports it.
    ///
    /// # Errors
    /// [`BusOff`] when the controller has left the bus; `receive` then does not report that again.
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusOff>;

    /// Drops the frames that wait to be sent, and lets the controller back onto the bus after
    /// bus-off. `receive` reports when it is back, which on a disturbed bus may be never.
    fn recover(&mut self);

    /// Goes onto the bus. Frames with other ids need not be received; a controller without room for all
    /// of the ids lets more pass. Called once, before anything else.
    fn set_filters(&mut self, ids: &[CanId]);

    /// State of the controller.
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
    /// Its error state changed.
    Bus(BusState),
    /// Everything handed over has left.
    Sent,
}

/// The controller has left the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BusOff;

/// The counters of a CAN controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CanCounters {
    /// The transmit error counter of the CAN standard: bus-off beyond 255.
    pub transmit_errors: u8,
    /// The receive error counter of the CAN standard.
    pub receive_errors: u8,
    /// Times that a frame was lost because it was not read from the controller in time. Wraps.
    pub lost: u32,
}
