//! The progress of a move: path time, whose rate changes in ramps.

use proto_core::time::{Duration, Instant};

use super::Braking;

#[derive(Debug, Clone, Copy)]
pub(super) struct PathClock {
    anchor: Instant,
    /// Path time at the anchor.
    position_s: f64,
    /// Rate at the anchor.
    rate: f64,
    target: f64,
    /// Change of the rate per second while it differs from the target; positive.
    slope: f64,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct PathTime {
    /// Seconds of path time.
    pub(super) position_s: f64,
    /// Path seconds per second.
    pub(super) rate: f64,
    /// Change of the rate per second.
    pub(super) rate_change: f64,
}

impl PathClock {
    /// A stopped clock at path time 0.
    pub(super) fn stopped() -> Self {
        Self { anchor: Instant::ZERO, position_s: 0.0, rate: 0.0, target: 0.0, slope: NORMAL_SLOPE }
    }

    pub(super) fn running(now: Instant, rate: f64) -> Self {
        Self { anchor: now, position_s: 0.0, rate, target: rate, slope: NORMAL_SLOPE }
    }

    pub(super) fn set_rate(&mut self, now: Instant, target: f64, braking: Braking) {
        let reading = self.at(now);
        let slope = match braking {
            Braking::Normal => NORMAL_SLOPE,
            Braking::Hard => 4.0 * NORMAL_SLOPE,
        };
        *self = Self { anchor: now, position_s: reading.position_s, rate: reading.rate, target, slope };
    }

    pub(super) fn at(&self, now: Instant) -> PathTime {
        let dt = now.saturating_since(self.anchor).as_micros() as f64 * 1e-6;
        let (ramp_s, slope) = self.ramp();
        // Instants are whole microseconds: with less than that left, the ramp is over.
        if dt + 0.5e-6 < ramp_s {
            let position_s = self.position_s + self.rate * dt + 0.5 * slope * dt * dt;
            return PathTime { position_s, rate: self.rate + slope * dt, rate_change: slope };
        }
        let after_ramp = self.after_ramp();
        let position_s = after_ramp + self.target * (dt - ramp_s);
        PathTime { position_s, rate: self.target, rate_change: 0.0 }
    }

    /// When the path time reaches `goal_s`; `None` if it never does.
    pub(super) fn reaches(&self, goal_s: f64) -> Option<Instant> {
        let missing = goal_s - self.position_s;
        if missing <= 0.0 {
            return Some(self.anchor);
        }
        let (ramp_s, slope) = self.ramp();
        let after_ramp = self.after_ramp();
        let dt = if after_ramp >= goal_s {
            // rate·t + slope/2·t² = missing, in a form without cancellation.
            let root = (self.rate * self.rate + 2.0 * slope * missing).max(0.0).sqrt();
            2.0 * missing / (self.rate + root)
        } else if self.target > 0.0 {
            ramp_s + (goal_s - after_ramp) / self.target
        } else {
            return None;
        };
        Some(self.anchor + micros(dt))
    }

    /// When the clock stops; `None` if it does not stop.
    pub(super) fn halts(&self) -> Option<Instant> {
        (self.target <= 0.0).then(|| self.anchor + micros(self.ramp().0))
    }

    /// Duration of the ramp from the anchor, s, and its signed slope.
    fn ramp(&self) -> (f64, f64) {
        let change = self.target - self.rate;
        (change.abs() / self.slope, self.slope.copysign(change))
    }

    fn after_ramp(&self) -> f64 {
        let (ramp_s, slope) = self.ramp();
        self.position_s + self.rate * ramp_s + 0.5 * slope * ramp_s * ramp_s
    }
}

/// Rounded up, so the goal is reached at that instant.
fn micros(seconds: f64) -> Duration {
    Duration::from_micros((seconds * 1e6).ceil() as u64)
}

/// From full rate to rest in 100 ms.
const NORMAL_SLOPE: f64 = 10.0;
