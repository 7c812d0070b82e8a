//! A CAN port's task.
//!
//! The task receives frames, sends the frames of the engine, and restarts the controller after bus-off. It never waits
//! for only one direction, and yields after a bounded number of events even if the bus is busy all the time.

use core::pin::pin;

use embassy_futures::select::{Either, Either3, select, select3};
use embassy_futures::yield_now;
use embassy_time::{Duration, Instant, Timer, with_timeout};
use embedded_can::Frame;
use proto_core::engine::{BusState, Input, PortId};
use proto_core::wire::can::{CanFrame, CanId, MAX_CAN_DATA};

use super::control::PortControl;
use super::gateway::Gateway;
use super::watchdog::Pulse;
use crate::drivers::can_port::{BusOff, CanCounters, CanEvent, CanPort};
use crate::{info, warn};

/// Runs the port forever.
pub async fn run(gateway: &Gateway, pulse: &Pulse, port: PortId, can: impl CanPort) -> ! {
    let Some(control) = gateway.port(port) else { core::future::pending().await };
    let task = CanTask {
        gateway,
        pulse,
        port,
        control,
        can,
        phase: CanPhase::Idle,
        is_failing: false,
        backoff: BACKOFF_MIN,
        recovered: Instant::MIN,
        lost: 0,
        lost_logged: Instant::MIN,
    };
    task.run().await
}

/// What the task waits for, besides frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum CanPhase {
    Idle,
    /// Frames in the controller must be sent by then.
    Sending {
        until: Instant,
    },
    /// Bus-off: restart at that time.
    Off {
        until: Instant,
    },
    /// The controller is recovering; on timeout, recovery is retried.
    Recovering {
        until: Instant,
    },
}

struct CanTask<'a, C> {
    gateway: &'a Gateway,
    pulse: &'a Pulse,
    port: PortId,
    control: &'a PortControl,
    can: C,
    phase: CanPhase,
    /// The last attempt to send failed.
    is_failing: bool,
    /// Wait after the next bus-off.
    backoff: Duration,
    recovered: Instant,
    /// Lost frames reported by the last log line, and its time.
    lost: u32,
    lost_logged: Instant,
}

impl<C: CanPort> CanTask<'_, C> {
    async fn run(mut self) -> ! {
        self.can.set_filters(self.control.ids());
        self.gateway.input(Input::PortUp { port: self.port });
        loop {
            for _ in 0..IN_A_ROW {
                let deadline = self.deadline();
                let next = select3(self.can.receive(), self.control.frame_waits(), Timer::at(deadline));
                let next = self.pulse.idle(pin!(next)).await;
                match next {
                    Either3::First(event) => self.event(event),
                    Either3::Second(()) => {}
                    Either3::Third(()) => self.expired(),
                }
                // Sent here too, because a busy bus may never let the task become idle.
                self.send_waiting().await;
            }
            self.log_lost();
            self.gateway.more_waits();
            yield_now().await;
        }
    }

    fn deadline(&self) -> Instant {
        match self.phase {
            CanPhase::Idle => Instant::MAX,
            CanPhase::Sending { until } | CanPhase::Off { until } | CanPhase::Recovering { until } => until,
        }
    }

    fn event(&mut self, event: CanEvent<C::Frame>) {
        match event {
            CanEvent::Frame(frame) => {
                if let Some(frame) = to_core(&frame) {
                    self.gateway.input(Input::PortCan { port: self.port, frame });
                }
            }
            CanEvent::Bus(BusState::BusOff) => self.bus_off(),
            CanEvent::Bus(state) => {
                self.log_state(state);
                if matches!(self.phase, CanPhase::Off { .. } | CanPhase::Recovering { .. }) {
                    self.recovered = Instant::now();
                    self.phase = CanPhase::Idle;
                }
                self.gateway.input(Input::PortBus { port: self.port, state });
            }
            CanEvent::Sent => {
                if let CanPhase::Sending { .. } = self.phase {
                    self.phase = CanPhase::Idle;
                    self.is_failing = false;
                    self.gateway.input(Input::PortSent { port: self.port });
                }
            }
        }
    }

    async fn send_waiting(&mut self) {
        let mut frames = 0_u32;
        while let Some(frame) = self.control.next_frame() {
            if matches!(self.phase, CanPhase::Off { .. } | CanPhase::Recovering { .. }) {
                // The engine has been told the state of the bus, and earlier frames were dropped.
                continue;
            }
            frames = frames.saturating_add(1);
            let timeout = send_timeout(frames, self.can.bitrate());
            self.control.clear_sleep();
            // If the gateway has slept meanwhile, data in the controller is old and must be reported before
            // the frame has left.
            let sending = select(self.can.send(&frame), self.control.wait_for_sleep());
            let sent = self.pulse.idle(pin!(with_timeout(timeout, sending))).await;
            match sent {
                Ok(Either::First(Ok(()))) => {
                    self.phase = CanPhase::Sending { until: Instant::now() + timeout };
                }
                Ok(Either::First(Err(BusOff))) => self.bus_off(),
                Ok(Either::Second(())) => self.drop_waiting(),
                Err(_) => self.give_up(),
            }
        }
    }

    fn expired(&mut self) {
        match self.phase {
            CanPhase::Idle => {}
            CanPhase::Sending { .. } => self.give_up(),
            CanPhase::Off { .. } | CanPhase::Recovering { .. } => {
                self.can.recover();
                self.phase = CanPhase::Recovering { until: Instant::now() + RECOVERY };
            }
        }
    }

    /// Drops the frames after a timeout: nobody acknowledges them, so no other node is connected. They would be old by
    /// the time one is.
    fn give_up(&mut self) {
        // Only the first of consecutive failures is logged.
        if !self.is_failing {
            let errors = self.can.counters().transmit_errors;
            warn!(
                "port {}: frames are not acknowledged by any node; transmit errors {}",
                self.port.0, errors
            );
        }
        self.is_failing = true;
        self.drop_waiting();
    }

    fn drop_waiting(&mut self) {
        self.can.recover();
        self.control.clear();
        self.phase = CanPhase::Idle;
        self.gateway.input(Input::PortDown { port: self.port });
        self.gateway.input(Input::PortUp { port: self.port });
    }

    fn bus_off(&mut self) {
        let now = Instant::now();
        if matches!(self.phase, CanPhase::Off { .. }) {
            return;
        }
        if now.saturating_duration_since(self.recovered) >= HEALTHY {
            self.backoff = BACKOFF_MIN;
        }
        warn!("port {}: bus-off; restart in {} ms", self.port.0, self.backoff.as_millis());
        self.phase = CanPhase::Off { until: now + self.backoff };
        self.backoff = (self.backoff * 2).min(BACKOFF_MAX);
        self.gateway.input(Input::PortBus { port: self.port, state: BusState::BusOff });
        self.control.clear();
    }

    fn log_state(&self, state: BusState) {
        let CanCounters { transmit_errors, receive_errors, .. } = self.can.counters();
        let name = match state {
            BusState::Active => "error-active",
            BusState::Warning => "error warning",
            BusState::Passive => "error-passive",
            BusState::BusOff => "bus-off",
        };
        let port = self.port.0;
        info!("port {}: {}; errors: transmit {}, receive {}", port, name, transmit_errors, receive_errors);
    }

    /// Logs that frames were lost, at most once a second.
    fn log_lost(&mut self) {
        let lost = self.can.counters().lost;
        let now = Instant::now();
        if lost != self.lost && now.saturating_duration_since(self.lost_logged) >= LOST_PERIOD {
            warn!("port {}: frames were lost {} times", self.port.0, lost);
            self.lost = lost;
            self.lost_logged = now;
        }
    }
}

fn to_core(frame: &impl Frame) -> Option<CanFrame> {
    let id = CanId::from(frame.id());
    if frame.is_remote_frame() {
        CanFrame::remote(id, frame.dlc().min(MAX_CAN_DATA))
    } else {
        CanFrame::new(id, frame.data())
    }
}

/// Time limit for sending `frames` frames: four times their duration on an idle bus (at most 160 bits each), because
/// frames of other nodes may have priority, plus a minimum.
fn send_timeout(frames: u32, bitrate: u32) -> Duration {
    let bits = u64::from(frames).saturating_mul(4 * 160);
    Duration::from_micros(bits.saturating_mul(1_000_000) / u64::from(bitrate.max(1))) + SEND_TIMEOUT_MIN
}

/// Maximum number of events in a row before the task yields.
const IN_A_ROW: usize = 16;
const SEND_TIMEOUT_MIN: Duration = Duration::from_millis(250);
const BACKOFF_MIN: Duration = Duration::from_millis(100);
const BACKOFF_MAX: Duration = Duration::from_secs(5);
/// After this time on the bus, the wait after the next bus-off is the shortest one again.
const HEALTHY: Duration = Duration::from_secs(5);
/// Limit of a recovery, which takes 129 times 11 bits: 142 ms at 10 kbit/s.
const RECOVERY: Duration = Duration::from_secs(1);
const LOST_PERIOD: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests;
