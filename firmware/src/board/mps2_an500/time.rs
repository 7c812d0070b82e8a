//! The time driver: microseconds since the start, and an alarm.

use core::cell::RefCell;
use core::task::Waker;

use critical_section::{CriticalSection, Mutex};
use embassy_time_driver::Driver;
use embassy_time_queue_utils::Queue;

use super::Irq;
use super::registers::{DUAL_TIMER, FPGAIO, TIMER0, read, write};

/// FPGAIO's counter, which increments every `PRESCALE + 1` cycles of 25 MHz.
const COUNTER: u32 = FPGAIO + 0x18;
const PRESCALE: u32 = FPGAIO + 0x1C;
// Registers of TIMER0.
const CTRL: u32 = TIMER0;
const VALUE: u32 = TIMER0 + 0x4;
const RELOAD: u32 = TIMER0 + 0x8;
const INTCLEAR: u32 = TIMER0 + 0xC;
const CTRL_ALARM: u32 = 0b1001;
const CYCLES_PER_MICRO: u64 = 25;
/// Longest alarm, in microseconds; a later one is set in steps. The limit also ensures that no overflow of the counter
/// is missed.
const LONGEST: u64 = 60_000_000;

struct TimerDriver {
    state: Mutex<RefCell<TimerState>>,
}

struct TimerState {
    queue: Queue,
    /// The last value read from the counter, and the number of its overflows.
    last: u32,
    rounds: u32,
}

embassy_time_driver::time_driver_impl!(static CLOCK: TimerDriver = TimerDriver {
    state: Mutex::new(RefCell::new(TimerState { queue: Queue::new(), last: 0, rounds: 0 })),
});

pub(super) fn start() {
    write(PRESCALE, 24);
    write(COUNTER, 0);
    write(RELOAD, (LONGEST * CYCLES_PER_MICRO) as u32);
    write(CTRL, CTRL_ALARM);
    Irq::TIMER0.enable();
    on_alarm();
}

impl TimerState {
    fn now(&mut self) -> u64 {
        let counter = read(COUNTER);
        if counter < self.last {
            self.rounds += 1;
        }
        self.last = counter;
        u64::from(self.rounds) << 32 | u64::from(counter)
    }

    /// Wakes expired timers and sets the alarm for the next one. It does so with one register access, because each
    /// access costs the emulator some microseconds.
    fn rearm(&mut self) {
        let now = self.now();
        let next = self.queue.next_expiration(now);
        let wait = next.saturating_sub(now).clamp(1, LONGEST);
        write(VALUE, (wait * CYCLES_PER_MICRO) as u32);
    }
}

impl TimerDriver {
    fn with<T>(&self, f: impl FnOnce(&mut TimerState) -> T) -> T {
        critical_section::with(|cs: CriticalSection<'_>| f(&mut self.state.borrow_ref_mut(cs)))
    }
}

impl Driver for TimerDriver {
    fn now(&self) -> u64 {
        self.with(TimerState::now)
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        self.with(|state| {
            if state.queue.schedule_wake(at, waker) {
                state.rearm();
            }
        });
    }
}

pub(super) fn on_alarm() {
    write(INTCLEAR, 1);
    CLOCK.with(TimerState::rearm);
}

/// Makes a timer of the emulator expire soon ([`super::LanRegisters`]).
pub(super) fn wake_emulator() {
    const LOAD: u32 = DUAL_TIMER;
    const CONTROL: u32 = DUAL_TIMER + 0x8;
    /// Enabled, one shot, 32 bits, no interrupt.
    const ONE_SHOT: u32 = 0xC3;
    if read(CONTROL) != ONE_SHOT {
        write(LOAD, 25);
        write(CONTROL, ONE_SHOT);
    }
    write(LOAD, 25);
}
