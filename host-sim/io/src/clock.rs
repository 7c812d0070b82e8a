//! The clock of a state machine: the machine's own time, the same faster or slower, or a clock that moves only on
//! command.
//!
//! All clones of a [`Clock`] show the same time. An [`Alarm`] waits for an instant of its clock, as a [`Timer`] does
//! for an instant of the machine's clock.

use std::cell::{Cell, RefCell};
use std::io;
use std::rc::Rc;

use proto_core::time::{Duration, Instant};
use tokio::sync::Notify;

use super::timer::{self, Timer};

/// How a clock runs.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Pace {
    /// At the machine's speed.
    #[default]
    Real,
    /// The machine's speed multiplied by this, which is more than 0.
    Factor(f64),
    /// Only by [`Clock::step_to`].
    Stepped,
}

/// A clock. For a current-thread runtime.
#[derive(Debug, Clone)]
pub struct Clock(Rc<ClockKind>);

#[derive(Debug)]
enum ClockKind {
    Real,
    Scaled(Scale),
    Stepped(Stepped),
}

/// A clock that showed the machine's time at one instant.
#[derive(Debug, Clone, Copy)]
struct Scale {
    since: Instant,
    factor: f64,
}

#[derive(Debug)]
struct Stepped {
    now: Cell<Instant>,
    /// In the order of creation.
    alarms: RefCell<Vec<Rc<SteppedAlarm>>>,
}

#[derive(Debug)]
struct SteppedAlarm {
    armed: Cell<Instant>,
    due: Notify,
}

impl Clock {
    /// A clock of this pace. A stepped clock starts at [`STEPPED_START`], any other at the machine's time.
    pub fn new(pace: Pace) -> Self {
        Self(Rc::new(match pace {
            Pace::Real => ClockKind::Real,
            Pace::Factor(factor) => {
                ClockKind::Scaled(Scale { since: timer::now(), factor: factor.clamp(MIN_FACTOR, MAX_FACTOR) })
            }
            Pace::Stepped => {
                ClockKind::Stepped(Stepped { now: Cell::new(STEPPED_START), alarms: RefCell::default() })
            }
        }))
    }

    /// The machine's clock.
    pub fn real() -> Self {
        Self::new(Pace::Real)
    }

    /// The current time of this clock.
    pub fn now(&self) -> Instant {
        match &*self.0 {
            ClockKind::Real => timer::now(),
            ClockKind::Scaled(scale) => scale.shown_at(timer::now()),
            ClockKind::Stepped(stepped) => stepped.now.get(),
        }
    }

    /// Whether the clock moves only by [`Self::step_to`].
    pub fn is_stepped(&self) -> bool {
        matches!(&*self.0, ClockKind::Stepped(_))
    }

    /// Whether the clock differs from the machine's.
    pub fn runs_apart(&self) -> bool {
        !matches!(&*self.0, ClockKind::Real)
    }

    /// The earliest deadline of a stepped clock's alarms that is later than now; [`Instant::NEVER`] if there
    /// is none, or if the clock runs by itself.
    pub fn next_deadline(&self) -> Instant {
        self.deadlines(|deadline, now| deadline > now)
    }

    /// Whether an alarm of a stepped clock is due and its task has not run yet.
    pub fn has_due(&self) -> bool {
        self.deadlines(|deadline, now| deadline <= now) != Instant::NEVER
    }

    fn deadlines(&self, counts: impl Fn(Instant, Instant) -> bool) -> Instant {
        let ClockKind::Stepped(stepped) = &*self.0 else { return Instant::NEVER };
        let (alarms, now) = (stepped.alarms.borrow(), stepped.now.get());
        let deadlines = alarms.iter().map(|alarm| alarm.armed.get());
        deadlines.filter(|&deadline| counts(deadline, now)).min().unwrap_or(Instant::NEVER)
    }

    /// Moves a stepped clock to this instant and wakes the alarms that are due. Never moves it back, and has no effect
    /// on a clock that runs by itself.
    pub fn step_to(&self, instant: Instant) {
        let ClockKind::Stepped(stepped) = &*self.0 else { return };
        stepped.now.set(instant.max(stepped.now.get()));
        for alarm in stepped.alarms.borrow().iter().filter(|alarm| alarm.armed.get() <= stepped.now.get()) {
            alarm.due.notify_one();
        }
    }

    /// An alarm without a deadline, in the current tokio runtime.
    pub fn alarm(&self) -> io::Result<Alarm> {
        let waits = match &*self.0 {
            ClockKind::Real | ClockKind::Scaled(_) => Waits::Timer(Timer::new()?),
            ClockKind::Stepped(stepped) => {
                let alarm = Rc::new(SteppedAlarm { armed: Cell::new(Instant::NEVER), due: Notify::new() });
                stepped.alarms.borrow_mut().push(Rc::clone(&alarm));
                Waits::Stepped(alarm)
            }
        };
        Ok(Alarm { clock: self.clone(), armed: Cell::new(Instant::NEVER), waits })
    }
}

impl Scale {
    fn shown_at(&self, real: Instant) -> Instant {
        let passed = real.saturating_since(self.since).as_micros() as f64;
        self.since + Duration::from_micros((passed * self.factor) as u64)
    }

    /// The machine's time at which the clock shows this instant, rounded up.
    fn real(&self, shown: Instant) -> Instant {
        if shown == Instant::NEVER {
            return shown;
        }
        let passed = shown.saturating_since(self.since).as_micros() as f64;
        self.since + Duration::from_micros((passed / self.factor).ceil() as u64)
    }
}

/// A one-shot timer of a [`Clock`].
#[derive(Debug)]
pub struct Alarm {
    clock: Clock,
    armed: Cell<Instant>,
    waits: Waits,
}

#[derive(Debug)]
enum Waits {
    Timer(Timer),
    Stepped(Rc<SteppedAlarm>),
}

impl Alarm {
    /// Moves the deadline. A past deadline expires at once; [`Instant::NEVER`] disarms the alarm.
    pub fn arm(&self, deadline: Instant) -> io::Result<()> {
        self.armed.set(deadline);
        match (&self.waits, &*self.clock.0) {
            (Waits::Timer(timer), ClockKind::Scaled(scale)) => timer.arm(scale.real(deadline)),
            (Waits::Timer(timer), _) => timer.arm(deadline),
            (Waits::Stepped(alarm), _) => {
                alarm.armed.set(deadline);
                if deadline <= self.clock.now() {
                    alarm.due.notify_one();
                }
                Ok(())
            }
        }
    }

    /// Waits until the deadline has passed; the alarm is disarmed then. Cancel safe.
    pub async fn expired(&self) -> io::Result<()> {
        loop {
            match &self.waits {
                Waits::Timer(timer) => {
                    timer.expired().await?;
                    // A clock with a factor may be a microsecond behind.
                    if self.clock.now() < self.armed.get() {
                        self.arm(self.armed.get())?;
                        continue;
                    }
                }
                Waits::Stepped(alarm) => {
                    // The notification may belong to an earlier deadline.
                    if alarm.armed.get() > self.clock.now() {
                        alarm.due.notified().await;
                        continue;
                    }
                    alarm.armed.set(Instant::NEVER);
                }
            }
            self.armed.set(Instant::NEVER);
            return Ok(());
        }
    }
}

impl Drop for Alarm {
    fn drop(&mut self) {
        if let (Waits::Stepped(own), ClockKind::Stepped(stepped)) = (&self.waits, &*self.clock.0) {
            stepped.alarms.borrow_mut().retain(|alarm| !Rc::ptr_eq(alarm, own));
        }
    }
}

/// The start of a stepped clock: not 0, which some state machines take for "never".
pub const STEPPED_START: Instant = Instant::from_millis(1_000);
/// The slowest pace.
pub const MIN_FACTOR: f64 = 0.001;
/// The fastest pace of a clock that runs by itself.
pub const MAX_FACTOR: f64 = 1_000.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn run<T>(future: impl Future<Output = T>) -> T {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(future)
    }

    fn millis(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn a_stepped_clock_moves_only_when_told_and_wakes_what_is_due() {
        run(async {
            let clock = Clock::new(Pace::Stepped);
            let (soon, late) = (clock.alarm().unwrap(), clock.alarm().unwrap());
            assert_eq!(clock.next_deadline(), Instant::NEVER);
            soon.arm(STEPPED_START + millis(4)).unwrap();
            late.arm(STEPPED_START + millis(3_600_000)).unwrap();
            assert_eq!(clock.next_deadline(), STEPPED_START + millis(4));
            clock.step_to(clock.next_deadline());
            assert!(clock.has_due());
            assert_eq!(clock.next_deadline(), STEPPED_START + millis(3_600_000));
            soon.expired().await.unwrap();
            assert!(!clock.has_due());
            assert_eq!(clock.now(), STEPPED_START + millis(4));
            // Moved to later after it was due once.
            soon.arm(clock.now()).unwrap();
            soon.arm(clock.now() + millis(1)).unwrap();
            tokio::select! {
                biased;
                fired = soon.expired() => panic!("fired: {fired:?}"),
                fired = late.expired() => panic!("fired: {fired:?}"),
                () = tokio::task::yield_now() => {}
            }
            drop(soon);
            clock.step_to(clock.next_deadline());
            late.expired().await.unwrap();
            assert_eq!(clock.now(), STEPPED_START + millis(3_600_000));
            clock.step_to(STEPPED_START);
            assert_eq!(clock.now(), STEPPED_START + millis(3_600_000), "never backwards");
        });
    }

    #[test]
    fn a_scaled_clock_and_its_alarms_keep_their_ratio() {
        run(async {
            for factor in [0.5, 1.0, 50.0] {
                let clock = Clock::new(Pace::Factor(factor));
                let ClockKind::Scaled(scale) = *clock.0 else { panic!() };
                let alarm = clock.alarm().unwrap();
                let deadline = clock.now() + Duration::from_micros((10_000.0 * factor) as u64);
                alarm.arm(deadline).unwrap();
                alarm.expired().await.unwrap();
                assert!(clock.now() >= deadline);
                let real = scale.real(deadline).saturating_since(scale.since).as_micros();
                assert!((10_000..11_000).contains(&real) || real > 11_000 && factor < 1.0, "{real}");
                assert!(scale.shown_at(scale.real(deadline)) + Duration::from_micros(1) >= deadline);
            }
        });
    }
}
