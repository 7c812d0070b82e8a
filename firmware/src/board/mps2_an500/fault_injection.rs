//! Fault injection for tests, chosen by the third semihosting argument (`arg=stall`; another word, such as `none`, is
//! no fault). It exists only in the image of this emulated board.

use core::future::pending;
use core::hint::{black_box, spin_loop};
use core::pin::pin;

use embassy_time::{Duration, Timer};
use firmware::tasks::watchdog::{Pulse, TaskName};

use super::arguments::argument;
use crate::board::Tasks;

#[derive(Debug, Clone, Copy)]
enum InjectedFault {
    /// Waits forever without answering the checks of the task watch.
    Stall,
    /// Never yields.
    Spin,
    Panic,
    Overflow,
    Fault,
}

pub(super) fn start<const N: usize>(tasks: &Tasks<N>) {
    let asked = argument(2, |name| {
        Some(match name {
            "stall" => InjectedFault::Stall,
            "spin" => InjectedFault::Spin,
            "panic" => InjectedFault::Panic,
            "overflow" => InjectedFault::Overflow,
            "fault" => InjectedFault::Fault,
            _ => return None,
        })
    });
    if let Some(fault) = asked.flatten() {
        tasks.spawn(TaskName::Board(0), |pulse| make(pulse, fault));
    }
}

#[embassy_executor::task]
async fn make(pulse: &'static Pulse, fault: InjectedFault) -> ! {
    let making = async {
        pulse.idle(pin!(Timer::after(AFTER))).await;
        match fault {
            InjectedFault::Stall => pending().await,
            InjectedFault::Spin => loop {
                spin_loop();
            },
            InjectedFault::Panic => panic!("as asked"),
            InjectedFault::Overflow => panic!("{} levels deep and still there", overflow(0)),
            InjectedFault::Fault => {
                let nowhere = core::ptr::with_exposed_provenance::<u32>(NOWHERE);
                // SAFETY: there is no memory at this address, so nothing is aliased; the read faults, as intended.
                let value = unsafe { nowhere.read_volatile() };
                panic!("{value} where nothing is")
            }
        }
    };
    pulse.run(pin!(making)).await
}

#[allow(unconditional_recursion, reason = "overflows the stack")]
fn overflow(depth: u32) -> u32 {
    let buf = black_box([depth; 64]);
    overflow(depth + 1) + buf[0]
}

/// Time from the start to the fault.
const AFTER: Duration = Duration::from_millis(500);
/// An address without memory.
const NOWHERE: usize = 0xB000_0000;
