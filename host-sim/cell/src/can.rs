//! A CAN bus: one port of the gateway or of the controller, and a device, which may simulate several nodes.

use std::collections::VecDeque;

use proto_core::config::can_frame_time;
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;

use super::device::Device;
use super::line::MAX_HEARD;
use super::rng::Rng;
use super::{AnyPort, End};

/// Counters of a bus, in addition to those of its ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BusCounters {
    /// Frames sent by the device.
    pub device_sent: u64,
    /// Frames sent by the port.
    pub port_sent: u64,
    /// Frames that were lost on the bus.
    pub lost: u64,
}

/// A bus.
pub struct CanBus {
    pub(super) owner: AnyPort,
    bitrate: u32,
    /// Number of lost frames per million.
    pub loss_ppm: u32,
    /// Counters.
    pub counters: BusCounters,
    pub(super) connected: bool,
    /// The port's CAN controller is bus-off: it neither sends nor receives.
    pub(super) is_off: bool,
    pub(super) device: Option<Box<dyn Device<CanFrame>>>,
    waiting: [VecDeque<CanFrame>; 2],
    on_the_bus: Option<(End, CanFrame)>,
    heard: VecDeque<(Instant, CanFrame)>,
    pub(super) keep_heard: usize,
    rng: Rng,
}

impl std::fmt::Debug for CanBus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { owner, bitrate, counters, connected, .. } = self;
        f.debug_struct("CanBus")
            .field("owner", owner)
            .field("bitrate", bitrate)
            .field("counters", counters)
            .field("connected", connected)
            .finish_non_exhaustive()
    }
}

/// A frame that was transmitted over the bus.
#[derive(Debug, Clone, Copy)]
pub(super) struct Crossed {
    pub from: End,
    pub frame: CanFrame,
    pub arrives: bool,
    /// The sender has no more waiting frames.
    pub was_last: bool,
}

impl CanBus {
    pub(super) fn new(owner: AnyPort, bitrate: u32, rng: Rng) -> Self {
        Self {
            owner,
            bitrate,
            loss_ppm: 0,
            counters: BusCounters::default(),
            connected: true,
            is_off: false,
            device: None,
            waiting: [VecDeque::new(), VecDeque::new()],
            on_the_bus: None,
            heard: VecDeque::new(),
            keep_heard: MAX_HEARD,
            rng,
        }
    }

    /// The frames that the port has sent since the last call, each with the time of its end. The newest [`MAX_HEARD`]
    /// are kept.
    pub fn take_heard(&mut self) -> Vec<(Instant, CanFrame)> {
        self.heard.drain(..).collect()
    }

    /// Queues a frame. If a frame starts on the bus now, returns when it ends; otherwise `None`.
    pub(super) fn send(&mut self, now: Instant, from: End, frame: CanFrame) -> Option<Instant> {
        self.waiting[from as usize].push_back(frame);
        match from {
            End::Port => self.counters.port_sent += 1,
            End::Device => self.counters.device_sent += 1,
        }
        self.arbitrate(now)
    }

    /// The frame on the bus has ended.
    pub(super) fn finish(&mut self, now: Instant) -> Option<Crossed> {
        let (from, frame) = self.on_the_bus.take()?;
        let arrives = self.connected && !self.is_off && !self.rng.chance(self.loss_ppm);
        self.counters.lost += u64::from(!arrives);
        if arrives && from == End::Port && self.keep_heard > 0 {
            if self.heard.len() >= self.keep_heard {
                self.heard.pop_front();
            }
            self.heard.push_back((now, frame));
        }
        Some(Crossed { from, frame, arrives, was_last: self.waiting[from as usize].is_empty() })
    }

    /// Arbitration: the lowest id wins, and a data frame wins over a remote frame. Returns when the winning frame ends;
    /// `None` if the bus is busy or no frame waits.
    pub(super) fn arbitrate(&mut self, now: Instant) -> Option<Instant> {
        if self.on_the_bus.is_some() {
            return None;
        }
        let head = |end: End| {
            let frame = self.waiting[end as usize].front()?;
            Some((embedded_can::Frame::id(frame), frame.is_remote(), end))
        };
        let (.., from) = [head(End::Port), head(End::Device)].into_iter().flatten().min()?;
        let frame = self.waiting[from as usize].pop_front()?;
        self.on_the_bus = Some((from, frame));
        Some(now + can_frame_time(frame.id(), frame.data().len(), self.bitrate))
    }

    /// Drops the frames that wait at the port.
    pub(super) fn drop_port_frames(&mut self) {
        self.waiting[End::Port as usize].clear();
    }
}
