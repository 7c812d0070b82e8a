//! Real-time scheduling of the calling thread, where the system allows it.

use std::fmt;
use std::io;

/// The scheduling requested for a thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scheduling {
    /// As any other thread.
    #[default]
    Ordinary,
    /// SCHED_FIFO at its lowest priority if the system allows it: before ordinary threads, after every
    /// other real-time thread.
    FifoIfAllowed,
}

/// The scheduling a thread got.
#[derive(Debug)]
pub enum Scheduled {
    /// Not requested.
    Ordinary,
    /// SCHED_FIFO.
    Fifo,
    /// The system refused.
    Refused(io::Error),
}

impl Scheduled {
    /// One word for `ready` lines and counters.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Ordinary | Self::Refused(_) => "ordinary",
            Self::Fifo => "fifo",
        }
    }
}

impl fmt::Display for Scheduled {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ordinary => f.write_str("ordinary scheduling"),
            Self::Fifo => f.write_str("SCHED_FIFO"),
            Self::Refused(why) => write!(f, "ordinary scheduling, SCHED_FIFO was refused: {why}"),
        }
    }
}

/// Applies the scheduling to the calling thread.
pub fn apply(scheduling: Scheduling) -> Scheduled {
    match scheduling {
        Scheduling::Ordinary => Scheduled::Ordinary,
        Scheduling::FifoIfAllowed => {
            let param = libc::sched_param { sched_priority: 1 };
            // SAFETY: 0 names the calling thread, and `param` outlives the call that reads it.
            match unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const param) } {
                0 => Scheduled::Fifo,
                _ => Scheduled::Refused(io::Error::last_os_error()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_result_is_what_the_system_did() {
        // On a thread of its own, so that no other test is affected.
        let (outcome, policy) = std::thread::spawn(|| {
            let outcome = apply(Scheduling::FifoIfAllowed);
            // SAFETY: 0 names the calling thread; nothing is passed by reference.
            (outcome, unsafe { libc::sched_getscheduler(0) })
        })
        .join()
        .unwrap();
        assert_eq!(matches!(outcome, Scheduled::Fifo), policy == libc::SCHED_FIFO, "{outcome}");
    }
}
