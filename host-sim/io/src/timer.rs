//! The clock and its timers: CLOCK_BOOTTIME in microseconds, and `timerfd`s on absolute times.
//!
//! CLOCK_BOOTTIME continues while the machine is suspended, so the age of waiting data is right after it.
//!
//! tokio's own timers have a resolution of 1 ms and fire later than that. A `timerfd` in the same reactor is late by
//! tens of microseconds, which a grid of 4 ms needs.

use std::cell::Cell;
use std::io;
use std::os::fd::OwnedFd;

use proto_core::time::{Duration, Instant};
use rustix::time::{
    ClockId, Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, clock_gettime,
    timerfd_create, timerfd_settime,
};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::reactor::register;

/// The time since boot: the clock of every state machine in this process.
pub fn now() -> Instant {
    let time = clock_gettime(ClockId::Boottime);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    let nanos = u64::try_from(time.tv_nsec).unwrap_or(0);
    Instant::from_micros(seconds.saturating_mul(1_000_000).saturating_add(nanos / 1_000))
}

/// A one-shot timer with an absolute deadline, which may be moved at any time.
#[derive(Debug)]
pub struct Timer {
    fd: AsyncFd<OwnedFd>,
    armed: Cell<Instant>,
}

impl Timer {
    /// A timer without a deadline, in the current tokio runtime.
    ///
    /// # Errors
    /// If the system has no descriptor left.
    pub fn new() -> io::Result<Self> {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let fd = timerfd_create(TimerfdClockId::Boottime, flags)?;
        Ok(Self { fd: register(fd, Interest::READABLE)?, armed: Cell::new(Instant::NEVER) })
    }

    /// The deadline, or [`Instant::NEVER`].
    pub fn deadline(&self) -> Instant {
        self.armed.get()
    }

    /// Moves the deadline. A past deadline expires at once; [`Instant::NEVER`] disarms the timer.
    pub fn arm(&self, deadline: Instant) -> io::Result<()> {
        if deadline == self.armed.get() {
            return Ok(());
        }
        // Zero would disarm the timer, hence at least 1 µs.
        let value = if deadline == Instant::NEVER { 0 } else { deadline.as_micros().max(1) };
        timerfd_settime(
            self.fd.get_ref(),
            TimerfdTimerFlags::ABSTIME,
            &Itimerspec { it_interval: timespec(0), it_value: timespec(value) },
        )?;
        self.armed.set(deadline);
        Ok(())
    }

    /// Waits until the deadline has passed; the timer is disarmed then. Cancel safe.
    ///
    /// # Errors
    /// If the descriptor cannot be read, which does not happen while the runtime lives.
    pub async fn expired(&self) -> io::Result<()> {
        loop {
            let mut ready = self.fd.readable().await?;
            if now() >= self.armed.get() {
                // Expirations are not read: arming resets their count, and the reactor is notified of each once.
                ready.clear_ready();
                self.armed.set(Instant::NEVER);
                return Ok(());
            }
            // An expiration of an earlier deadline, unless two clocks of the kernel disagree.
            match ready.try_io(|fd| Ok(rustix::io::read(fd.get_ref(), &mut [0; 8])?)) {
                Ok(Ok(_)) if self.armed.get() != Instant::NEVER => {
                    self.armed.set(Instant::NEVER);
                    return Ok(());
                }
                Ok(Err(error)) => return Err(error),
                Ok(Ok(_)) => {}
                Err(_would_block) => {}
            }
        }
    }

    /// Waits until `deadline`. Cancel safe; leaves the timer armed when cancelled.
    pub async fn sleep_until(&self, deadline: Instant) -> io::Result<()> {
        self.arm(deadline)?;
        self.expired().await
    }
}

/// Ticks on a grid of absolute times, `period` apart. Keeps its phase: missed ticks are skipped and counted,
/// never sent in a burst.
#[derive(Debug)]
pub struct Grid {
    timer: Timer,
    next: Instant,
    period: Duration,
}

impl Grid {
    /// A grid whose first tick is at `first`. A period of zero means one microsecond.
    pub fn new(first: Instant, period: Duration) -> io::Result<Self> {
        Ok(Self { timer: Timer::new()?, next: first, period: period.max(Duration::from_micros(1)) })
    }

    /// Waits for the next tick. Cancel safe.
    pub async fn tick(&mut self) -> io::Result<GridTick> {
        self.timer.sleep_until(self.next).await?;
        let late = now().saturating_since(self.next);
        let skipped = late.as_micros() / self.period.as_micros();
        let due = self.next + self.period.saturating_mul(skipped);
        self.next = due + self.period;
        Ok(GridTick { due, skipped })
    }
}

/// One tick of a [`Grid`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GridTick {
    /// When it was due.
    pub due: Instant,
    /// Number of missed ticks before it.
    pub skipped: u64,
}

fn timespec(micros: u64) -> Timespec {
    // More seconds than an i64 holds: the timer never fires.
    let seconds = i64::try_from(micros / 1_000_000).unwrap_or(i64::MAX);
    let nanos = i64::try_from(micros % 1_000_000).unwrap_or(0).saturating_mul(1_000);
    Timespec { tv_sec: seconds, tv_nsec: nanos }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run<T>(future: impl Future<Output = T>) -> T {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(future)
    }

    #[test]
    fn a_timer_fires_at_its_deadline_and_never_before() {
        run(async {
            let timer = Timer::new().unwrap();
            for micros in [1, 100, 5_000] {
                let deadline = now() + Duration::from_micros(micros);
                timer.sleep_until(deadline).await.unwrap();
                assert!(now() >= deadline);
                assert_eq!(timer.deadline(), Instant::NEVER);
            }
        });
    }

    #[test]
    fn a_deadline_in_the_past_fires_at_once_and_one_can_be_moved_earlier() {
        run(async {
            let timer = Timer::new().unwrap();
            timer.sleep_until(Instant::ZERO).await.unwrap();
            timer.arm(now() + Duration::from_secs(3_600)).unwrap();
            timer.sleep_until(now() + Duration::from_millis(1)).await.unwrap();
        });
    }

    #[test]
    fn a_deadline_that_has_passed_unseen_is_not_the_next_one() {
        run(async {
            let timer = Timer::new().unwrap();
            for _ in 0..20 {
                // The reactor learns of it, and nobody asks.
                timer.arm(Instant::ZERO).unwrap();
                tokio::task::yield_now().await;
                let deadline = now() + Duration::from_millis(2);
                timer.sleep_until(deadline).await.unwrap();
                assert!(now() >= deadline);
            }
        });
    }

    #[test]
    fn a_disarmed_timer_stays_silent() {
        run(async {
            let (off, other) = (Timer::new().unwrap(), Timer::new().unwrap());
            off.arm(now() + Duration::from_millis(1)).unwrap();
            off.arm(Instant::NEVER).unwrap();
            tokio::select! {
                biased;
                fired = off.expired() => panic!("fired: {fired:?}"),
                fired = other.sleep_until(now() + Duration::from_millis(5)) => fired.unwrap(),
            }
        });
    }

    #[test]
    fn a_late_grid_keeps_its_phase_and_counts_skipped_ticks() {
        run(async {
            let period = Duration::from_millis(4);
            let first = now() - Duration::from_millis(10);
            let mut grid = Grid::new(first, period).unwrap();
            let tick = grid.tick().await.unwrap();
            assert!(tick.skipped >= 2);
            let mut last = tick.due;
            for _ in 0..3 {
                let tick = grid.tick().await.unwrap();
                let steps = tick.due.saturating_since(last).as_micros() / period.as_micros();
                assert_eq!(tick.due, last + period.saturating_mul(steps));
                assert_eq!(steps, tick.skipped + 1);
                assert!(now() >= tick.due);
                last = tick.due;
            }
        });
    }
}
