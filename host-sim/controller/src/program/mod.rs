//! Robot programs: Rhai scripts that run in lock-step with the model's clock
//! (docs/simulated-controller.md section 4).
//!
//! In: a compiled [`Script`] and answers to its calls. Out: one [`Call`] after the other, the
//! program's variables, and how it ended. Knows nothing of ports, registers or motion.
//!
//! A script runs on a thread of its own, but never beside the model: each of its calls hands
//! control to the model, and the model's answer hands it back and waits for the next call. So a
//! program sees the same instants in the same order in every run, however fast the machine is.
//!
//! A script that does not wait for anything is cut in slices by what it does, not by a clock: after
//! [`SLICE_OPERATIONS`] operations the model goes on without it until [`SLICE`] after the slice began.
//! So everything else keeps its timing, and every run is still the same.
//!
//! Bounds: the sizes at the end of this file. A program that exceeds one ends with an error.

mod link;
mod script;

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::Scalar;

pub use script::{Script, ScriptError};

/// A program's variables by name: numbers, booleans, strings, arrays and maps of them.
pub type Variables = BTreeMap<String, serde_json::Value>;

/// What a program asks the model to do.
#[derive(Debug, Clone, PartialEq)]
pub enum Call {
    /// The next frame of the port's user recipe, whenever it comes.
    Receive {
        /// The port's name.
        port: String,
    },
    /// Send a frame of the port's user recipe.
    Send {
        /// The port's name.
        port: String,
        /// Which frame, on CAN.
        id: Option<i64>,
        /// One value a field.
        values: Vec<f64>,
    },
    /// The value of an item.
    Get {
        /// Its name.
        name: String,
    },
    /// Give an item a value.
    Set {
        /// Its name.
        name: String,
        /// The value.
        value: f64,
    },
    /// Move the joints and wait for their arrival.
    MoveJ {
        /// rad.
        target: [f64; 6],
        /// rad/s.
        speed_rad_s: f64,
    },
    /// Wait.
    Wait(Duration),
    /// A line for the log.
    Log(String),
    /// Go on at the next slice. No script asks for this, what it does is enough.
    GiveWay {
        /// When the next slice begins, at the earliest.
        until: Instant,
    },
}

/// What the model answers.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// Done.
    Done,
    /// A received frame; on CAN with its id.
    Frame {
        /// The id.
        id: Option<CanId>,
        /// Its fields' values.
        values: Vec<Scalar>,
    },
    /// An item's value.
    Value(Scalar),
    /// A bit's value.
    Bit(bool),
    /// It cannot be done; the program may catch this.
    Error(String),
    /// The program must end.
    Abort,
}

/// How a program ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum End {
    /// It came to its last line.
    Finished,
    /// It was told to.
    Aborted,
    /// An error that it did not catch: one line, with the place in the script.
    Failed(String),
}

/// Where a program stands.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress {
    /// It waits for the answer to a call.
    Calling(Call),
    /// It has ended.
    Ended(End),
}

/// A program that was started.
#[derive(Debug)]
pub struct Program {
    name: String,
    progress: Progress,
    /// `None` only while the program is being dropped.
    answers: Option<SyncSender<link::Stamped>>,
    events: Option<Receiver<Progress>>,
    variables: Arc<Mutex<Variables>>,
    thread: Option<JoinHandle<()>>,
}

impl Program {
    /// Starts the script and lets it run up to its first call.
    ///
    /// # Errors
    /// The operating system's, when it gives no thread.
    pub fn start(script: &Script, now: Instant) -> std::io::Result<Self> {
        let (answers, answers_end) = sync_channel(0);
        let (events_end, events) = sync_channel(0);
        let variables = Arc::new(Mutex::new(Variables::new()));
        let link = link::Link::new(events_end, answers_end, Arc::clone(&variables), now);
        let ast = script.ast();
        let thread = std::thread::Builder::new()
            .name(format!("program {}", script.name()))
            .stack_size(STACK_BYTES)
            .spawn(move || link::run(link, &ast))?;
        let mut program = Self {
            name: script.name().to_owned(),
            progress: Progress::Ended(End::Aborted),
            answers: Some(answers),
            events: Some(events),
            variables,
            thread: Some(thread),
        };
        program.wait();
        Ok(program)
    }

    /// The program's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Where it stands.
    pub fn progress(&self) -> &Progress {
        &self.progress
    }

    /// Answers the call it waits for and lets it run up to the next one.
    pub fn answer(&mut self, now: Instant, answer: Answer) {
        if matches!(self.progress, Progress::Ended(_)) {
            return;
        }
        if let Some(answers) = &self.answers {
            // An error means that the thread is gone, which `wait` finds out.
            let _ = answers.send(link::Stamped { now, answer });
        }
        self.wait();
    }

    /// The variables as they were when the program last called, those that have gone out of scope
    /// included.
    pub fn variables(&self) -> Variables {
        self.variables.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn wait(&mut self) {
        let event = self.events.as_ref().and_then(|events| events.recv().ok());
        self.progress = event.unwrap_or_else(|| {
            Progress::Ended(End::Failed("the script's thread ended without a result".to_owned()))
        });
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // With both ends gone the script's pending call returns an error that it cannot catch.
        self.answers = None;
        self.events = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// How long a slice is, in the model's time.
pub const SLICE: Duration = Duration::from_millis(1);
/// Operations of a script in a slice: some 0.1 ms on a machine of today.
pub const SLICE_OPERATIONS: u64 = 500;
/// What a call counts for, since it hands control to and fro.
const CALL_OPERATIONS: u64 = 50;
/// Longest string.
const MAX_STRING: usize = 4_096;
/// Most items in an array, those of arrays inside it included; and in a map.
const MAX_ITEMS: usize = 1_024;
/// Most variables at a time.
const MAX_VARIABLES: usize = 128;
/// Deepest nesting of function calls.
const MAX_CALLS: usize = 24;
/// Deepest nesting of expressions.
const MAX_DEPTH: usize = 32;
const STACK_BYTES: usize = 8 << 20;

#[cfg(test)]
mod tests;
