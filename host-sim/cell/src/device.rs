//! Devices at the far end of a line or bus.

use proto_core::time::{Duration, Instant};

/// A device: `M` is `Vec<u8>` on an RS-485 line and a CAN frame on a bus.
///
/// What it returns is sent in order, each as soon as the line is free of what the device sent
/// before.
pub trait Device<M> {
    /// Something came in: a chunk of bytes as the line delivers it, or a CAN frame.
    fn receive(&mut self, now: Instant, message: &M) -> Vec<M> {
        let _ = (now, message);
        Vec::new()
    }

    /// When [`Self::poll`] is to be called.
    fn deadline(&self) -> Instant {
        Instant::NEVER
    }

    /// The deadline has come; the next one must be later than `now`.
    fn poll(&mut self, now: Instant) -> Vec<M> {
        let _ = now;
        Vec::new()
    }
}

/// Sends by itself: the `n`-th time what `make(n)` returns, on a grid that keeps its phase.
///
/// The n-th message leaves at `start + n * 1 s / rate`, rounded down to the microsecond, so that no
/// error adds up at rates that do not divide a second.
#[derive(Debug, Clone)]
pub struct Talker<F> {
    start: Instant,
    per_second: u64,
    sent: u64,
    count: u64,
    make: F,
}

impl<F> Talker<F> {
    /// `per_second` messages a second from `start` on, `count` of them altogether.
    ///
    /// The rate must be from 1 to 1 000 000.
    pub fn new(start: Instant, per_second: u64, count: u64, make: F) -> Self {
        assert!((1..=1_000_000).contains(&per_second), "{per_second} messages a second");
        Self { start, per_second, sent: 0, count, make }
    }
}

impl<M, F: FnMut(u64) -> M> Device<M> for Talker<F> {
    fn deadline(&self) -> Instant {
        if self.sent >= self.count {
            return Instant::NEVER;
        }
        let micros = u128::from(self.sent) * 1_000_000 / u128::from(self.per_second);
        self.start + Duration::from_micros(u64::try_from(micros).unwrap_or(u64::MAX))
    }

    fn poll(&mut self, now: Instant) -> Vec<M> {
        let mut messages = Vec::new();
        while Device::<M>::deadline(self) <= now {
            messages.push((self.make)(self.sent));
            self.sent += 1;
        }
        messages
    }
}

/// Answers what it receives.
#[derive(Debug, Clone)]
pub struct Responder<F>(pub F);

impl<M, F: FnMut(Instant, &M) -> Vec<M>> Device<M> for Responder<F> {
    fn receive(&mut self, now: Instant, message: &M) -> Vec<M> {
        (self.0)(now, message)
    }
}
