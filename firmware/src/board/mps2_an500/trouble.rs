//! Tasks that do what no task may, so that it can be seen what follows: named by the third semihosting
//! argument (`arg=stall`). They exist in this emulated board's image only.

use core::future::pending;
use core::hint::{black_box, spin_loop};
use core::pin::pin;

use embassy_time::{Duration, Timer};
use firmware::tasks::watchdog::{Pulse, TaskName};

use super::storage;
use crate::start::Tasks;

#[derive(Debug, Clone, Copy)]
enum Trouble {
    /// Waits for ever without an answer.
    Stall,
    /// Never gives the processor back.
    Spin,
    Panic,
    /// Recursion without an end.
    Overflow,
    /// Reads where nothing is.
    Fault,
}

/// Starts the trouble that was asked for.
pub(super) fn start(tasks: &Tasks) {
    let asked = storage::argument(2, |name| {
        Some(match name {
            "stall" => Trouble::Stall,
            "spin" => Trouble::Spin,
            "panic" => Trouble::Panic,
            "overflow" => Trouble::Overflow,
            "fault" => Trouble::Fault,
            _ => return None,
        })
    });
    if let Some(trouble) = asked.flatten() {
        tasks.spawn(TaskName::Board(0), |pulse| make(pulse, trouble));
    }
}

#[embassy_executor::task]
async fn make(pulse: &'static Pulse, trouble: Trouble) -> ! {
    let making = async {
        pulse.idle(pin!(Timer::after(AFTER))).await;
        match trouble {
            Trouble::Stall => pending().await,
            Trouble::Spin => loop {
                spin_loop();
            },
            Trouble::Panic => panic!("as asked"),
            Trouble::Overflow => panic!("{} levels deep and still there", overflow(0)),
            Trouble::Fault => {
                let nowhere = core::ptr::with_exposed_provenance::<u32>(NOWHERE);
                // SAFETY: there is nothing to read, which is what is wanted: the read faults.
                let value = unsafe { nowhere.read_volatile() };
                panic!("{value} where nothing is")
            }
        }
    };
    pulse.run(pin!(making)).await
}

#[allow(unconditional_recursion, reason = "that is what is asked for")]
fn overflow(depth: u32) -> u32 {
    let room = black_box([depth; 64]);
    overflow(depth + 1) + room[0]
}

/// All is well until then.
const AFTER: Duration = Duration::from_millis(500);
/// Between the devices.
const NOWHERE: usize = 0xB000_0000;
