//! A CAN port's task, and what it asks of a board's CAN controller.

use core::pin::pin;

use embassy_futures::select::{Either, select};
use embassy_time::{Duration, Timer};
use embedded_can::Frame;
use proto_core::engine::{BusState, Input, PortId};
use proto_core::recipe::can::CanFrame;
use proto_core::recipe::model::{CanId, MAX_CAN_DATA};

use crate::gateway::Gateway;
use crate::warn;
use crate::watchdog::Pulse;

/// A CAN controller. Its driver buffers what arrives while nobody receives.
#[allow(async_fn_in_trait, reason = "all tasks run on one executor: no future is sent anywhere")]
pub trait CanPort {
    /// The driver's frame.
    type Frame: Frame;

    /// The next frame, or a change of the controller's state. Nothing is lost when the future is
    /// dropped before it is done.
    async fn receive(&mut self) -> CanEvent<Self::Frame>;

    /// Sends a frame behind those before it.
    ///
    /// # Errors
    /// [`BusOff`] when the controller has left the bus.
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusOff>;

    /// Lets the controller onto the bus again after bus-off.
    async fn recover(&mut self);

    /// Frames with other ids need not be received. A controller without room for all of them lets
    /// more pass.
    fn set_filters(&mut self, ids: &[CanId]) {
        let _ = ids;
    }
}

/// What a CAN controller brings.
#[derive(Debug, Clone, Copy)]
pub enum CanEvent<F> {
    /// A frame.
    Frame(F),
    /// Its error state changed.
    Bus(BusState),
}

/// The controller has left the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BusOff;

/// Drives the port for ever.
pub async fn run(gateway: &Gateway, pulse: &Pulse, port: PortId, mut can: impl CanPort) -> ! {
    let Some(control) = gateway.port(port) else { core::future::pending().await };
    gateway.input(Input::PortUp { port });
    let mut backoff = BACKOFF_MIN;
    loop {
        let mut is_off = false;
        match pulse.idle(pin!(select(can.receive(), control.frame_waits()))).await {
            Either::First(CanEvent::Frame(frame)) => {
                if let Some(frame) = own_frame(&frame) {
                    gateway.input(Input::PortCan { port, frame });
                }
                backoff = BACKOFF_MIN;
            }
            Either::First(CanEvent::Bus(state)) => {
                gateway.input(Input::PortBus { port, state });
                is_off = state == BusState::BusOff;
            }
            Either::Second(()) => {}
        }
        // A bus that is never idle does not keep us from sending.
        let mut sent = false;
        while !is_off && let Some(frame) = control.next_frame() {
            sent = true;
            // On a bus with nobody else a frame is never acknowledged and never leaves.
            is_off = pulse.idle(pin!(can.send(&frame))).await == Err(BusOff);
            if is_off {
                gateway.input(Input::PortBus { port, state: BusState::BusOff });
            }
        }
        if sent && !is_off {
            gateway.input(Input::PortSent { port });
        }
        if is_off {
            control.clear();
            warn!("port {}: bus-off; onto the bus again in {} ms", port.0, backoff.as_millis());
            pulse.idle(pin!(Timer::after(backoff))).await;
            backoff = (backoff * 2).min(BACKOFF_MAX);
            can.recover().await;
            gateway.input(Input::PortBus { port, state: BusState::Active });
        }
    }
}

/// The engine's frame. Of a remote frame there is no data to look at.
fn own_frame(frame: &impl Frame) -> Option<CanFrame> {
    let id = CanId::from(frame.id());
    if frame.is_remote_frame() {
        CanFrame::remote(id, frame.dlc().min(MAX_CAN_DATA))
    } else {
        CanFrame::new(id, frame.data())
    }
}

const BACKOFF_MIN: Duration = Duration::from_millis(100);
const BACKOFF_MAX: Duration = Duration::from_secs(5);
