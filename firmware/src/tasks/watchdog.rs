//! Checks that every task still runs; the watchdog is fed only then.
//!
//! Each task has a [`Pulse`]. A wait that may never end, such as for a byte, goes through [`Pulse::idle`], which
//! answers the checks meanwhile. A task that hangs anywhere else does not answer: it is named in the log, and the
//! watchdog is not fed. A task that never yields keeps the feeder from running, with the same effect; an interrupt can
//! then get the name of the task from [`running`].

use core::cell::{Cell, RefCell};
use core::fmt;
use core::future::{Future, poll_fn};
use core::pin::Pin;
use core::sync::atomic::{AtomicU16, Ordering};

use embassy_sync::waitqueue::WakerRegistration;
use embassy_time::{Duration, Timer};
use proto_core::engine::{LinkKind, PortId};

use crate::fmt::DisplayText;
use crate::{error, info};

/// A task, by its name in the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskName {
    /// Calls the engine at its deadlines.
    Engine,
    /// An RS-485 port.
    Serial(PortId),
    /// A CAN port.
    Can(PortId),
    /// A link to the controller.
    Link(LinkKind),
    /// The network stack.
    Network,
    /// Logs the address.
    Address,
    /// Logs the state of ports and links.
    Status,
    /// The status LED.
    Led,
    /// Logs why nothing runs.
    Refused,
    /// A task of the board's own.
    Board(u8),
    /// The store task.
    Store,
    /// A connection of the console.
    Console(u8),
    /// Polls the button.
    Button,
    /// The edge node.
    Edge,
    /// Queries a server for UTC.
    Time,
}

impl TaskName {
    /// Never 0.
    fn code(self) -> u16 {
        let (kind, number) = match self {
            Self::Engine => (1, 0),
            Self::Serial(port) => (2, port.0),
            Self::Can(port) => (3, port.0),
            Self::Link(LinkKind::Command) => (4, 0),
            Self::Link(LinkKind::State) => (5, 0),
            Self::Link(LinkKind::Modbus) => (6, 0),
            Self::Link(LinkKind::RecipeUdp) => (7, 0),
            Self::Link(LinkKind::RecipeTcpListen { port }) => (8, port.0),
            Self::Link(LinkKind::RecipeUdpListen { port }) => (9, port.0),
            Self::Network => (10, 0),
            Self::Address => (11, 0),
            Self::Status => (12, 0),
            Self::Led => (13, 0),
            Self::Refused => (14, 0),
            Self::Board(number) => (15, number),
            Self::Link(LinkKind::Urgent) => (16, 0),
            Self::Link(LinkKind::ModbusDevice { port }) => (23, port.0),
            Self::Link(_) => (17, 0),
            Self::Store => (18, 0),
            Self::Console(number) => (19, number),
            Self::Button => (20, 0),
            Self::Edge => (21, 0),
            Self::Time => (22, 0),
        };
        u16::from_be_bytes([kind, number])
    }

    fn from_code(code: u16) -> Option<Self> {
        let [_, number] = code.to_be_bytes();
        let port = PortId(number);
        let names = [
            Self::Engine,
            Self::Serial(port),
            Self::Can(port),
            Self::Link(LinkKind::Command),
            Self::Link(LinkKind::State),
            Self::Link(LinkKind::Modbus),
            Self::Link(LinkKind::RecipeUdp),
            Self::Link(LinkKind::RecipeTcpListen { port }),
            Self::Link(LinkKind::RecipeUdpListen { port }),
            Self::Network,
            Self::Address,
            Self::Status,
            Self::Led,
            Self::Refused,
            Self::Board(number),
            Self::Link(LinkKind::Urgent),
            Self::Store,
            Self::Console(number),
            Self::Button,
            Self::Edge,
            Self::Time,
            Self::Link(LinkKind::ModbusDevice { port }),
        ];
        names.into_iter().find(|name| name.code() == code)
    }
}

impl fmt::Display for TaskName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Engine => f.write_str("engine"),
            Self::Serial(port) => write!(f, "RS-485 port {}", port.0),
            Self::Can(port) => write!(f, "CAN port {}", port.0),
            Self::Link(kind) => write!(f, "link {}", kind.name()),
            Self::Network => f.write_str("network"),
            Self::Address => f.write_str("address"),
            Self::Status => f.write_str("status"),
            Self::Led => f.write_str("LED"),
            Self::Refused => f.write_str("refused"),
            Self::Board(number) => write!(f, "board {number}"),
            Self::Store => f.write_str("store"),
            Self::Console(number) => write!(f, "console {number}"),
            Self::Button => f.write_str("button"),
            Self::Edge => f.write_str("edge node"),
            Self::Time => f.write_str("time"),
        }
    }
}

/// The running task; `None` between tasks. For interrupts, and for the crash record.
pub fn running() -> Option<TaskName> {
    TaskName::from_code(RUNNING.load(Ordering::Relaxed))
}

/// A task's answers to the watchdog's checks.
pub struct Pulse {
    name: Cell<Option<TaskName>>,
    has_answered: Cell<bool>,
    /// The task was named in the log and has not answered since.
    is_suspect: Cell<bool>,
    waker: RefCell<WakerRegistration>,
}

impl Pulse {
    const fn new() -> Self {
        Self {
            name: Cell::new(None),
            has_answered: Cell::new(false),
            is_suspect: Cell::new(false),
            waker: RefCell::new(WakerRegistration::new()),
        }
    }

    /// Waits for something that may never happen, and answers checks meanwhile.
    ///
    /// A wait that always ends within a quarter of the watchdog's period need not use this.
    pub async fn idle<F: Future>(&self, mut wait: Pin<&mut F>) -> F::Output {
        poll_fn(|cx| {
            self.has_answered.set(true);
            self.waker.borrow_mut().register(cx.waker());
            wait.as_mut().poll(cx)
        })
        .await
    }

    /// Polls the whole task, and makes it known to [`running`] meanwhile.
    pub async fn run<F: Future>(&self, mut task: Pin<&mut F>) -> F::Output {
        let code = self.name.get().map_or(0, TaskName::code);
        poll_fn(|cx| {
            // Restored afterwards, because this task may have interrupted a task of another executor.
            let before = RUNNING.swap(code, Ordering::Relaxed);
            let result = task.as_mut().poll(cx);
            RUNNING.store(before, Ordering::Relaxed);
            result
        })
        .await
    }

    fn request(&self) {
        self.has_answered.set(false);
        self.waker.borrow_mut().wake();
    }
}

/// The pulses of all tasks: at most `N`.
pub struct TaskWatch<const N: usize> {
    pulses: [Pulse; N],
    count: Cell<usize>,
}

impl<const N: usize> TaskWatch<N> {
    /// Without tasks.
    pub const fn new() -> Self {
        Self { pulses: [const { Pulse::new() }; N], count: Cell::new(0) }
    }

    /// From here on the watchdog is fed only if this task answers. `None` if there are too many tasks.
    pub fn register(&self, name: TaskName) -> Option<&Pulse> {
        let pulse = self.pulses.get(self.count.get())?;
        self.count.set(self.count.get().saturating_add(1));
        pulse.name.set(Some(name));
        Some(pulse)
    }

    /// Returns whether all tasks have answered since the last round; if so, begins a new round of checks. Each missing
    /// answer is logged once, and once more when it arrives.
    fn round(&self, mut tell: impl FnMut(TaskName, PulseFault)) -> bool {
        let registered = || self.pulses.iter().take(self.count.get());
        for pulse in registered() {
            let has_answered = pulse.has_answered.get();
            if pulse.is_suspect.replace(!has_answered) == has_answered
                && let Some(name) = pulse.name.get()
            {
                tell(name, if has_answered { PulseFault::Late } else { PulseFault::Missing });
            }
        }
        let all = registered().all(|pulse| pulse.has_answered.get());
        if all {
            registered().for_each(Pulse::request);
        }
        all
    }
}

impl<const N: usize> Default for TaskWatch<N> {
    fn default() -> Self {
        Self::new()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PulseFault {
    Missing,
    Late,
}

/// Feeds a watchdog with this `period` forever, four times per period while all tasks answer.
pub async fn run<const N: usize>(watch: &TaskWatch<N>, period: Duration, mut feed: impl FnMut()) -> ! {
    let quarter = period / 4;
    loop {
        Timer::after(quarter).await;
        if watch.round(log_answer) {
            feed();
        }
    }
}

fn log_answer(name: TaskName, answer: PulseFault) {
    match answer {
        PulseFault::Missing => {
            error!("task {} does not respond: the watchdog is not fed", DisplayText(&name))
        }
        PulseFault::Late => info!("task {} responds again", DisplayText(&name)),
    }
}

/// [`TaskName::code`] of the running task.
static RUNNING: AtomicU16 = AtomicU16::new(0);

#[cfg(test)]
mod tests;
