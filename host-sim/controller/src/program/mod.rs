//! Robot programs: Rhai scripts that run in lock-step with the model's clock (docs/simulated-controller.md section 4).
//!
//! In: a compiled [`Script`], and answers to its calls. Out: one [`Call`] after the other, the program's
//! variables, and how it ended. Does not know ports, registers or motion.
//!
//! A script runs on a thread of its own, but never in parallel with the model: each call hands control to the model,
//! which returns it with the reply and waits for the next call. A program thus sees the same instants in the same order
//! in every run, however fast the machine is.
//!
//! A script that never waits is suspended after [`SLICE_OPERATIONS`] operations, until [`SLICE`] after the start of the
//! slice. Everything else thus keeps its timing, and every run is still the same.
//!
//! The limits are at the end of this file. A program that exceeds one ends with an error.

mod calls;
mod link;
mod script;
mod text;

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::Scalar;
use rhai::Scope;

pub(super) use script::named;
pub use script::{Script, ScriptError};
pub(super) use text::shortened;

/// A program's variables by name: numbers, booleans, strings, arrays and maps of them.
pub type Variables = BTreeMap<String, serde_json::Value>;

/// A call of a program to the model.
#[derive(Debug, Clone, PartialEq)]
pub enum Call {
    /// Wait for the next frame of the port's user recipe.
    Receive {
        /// The port's name.
        port: String,
        /// Timeout, after which the reply is [`CallReply::Done`].
        limit: Option<Duration>,
    },
    /// Send a frame of the port's user recipe. The reply is whether the port was ready and has sent it, as
    /// [`CallReply::Bit`]; [`CallReply::Done`] counts as true.
    Send {
        /// The port's name.
        port: String,
        /// On CAN, the id of the frame; needed if the output part has several.
        id: Option<i64>,
        /// One value for each field.
        values: Vec<f64>,
    },
    /// Return the value of an item.
    Get {
        /// Its name.
        name: String,
    },
    /// Set an item.
    Set {
        /// Its name.
        name: String,
        /// The value.
        value: f64,
    },
    /// Move the joints, and wait for the end of the move.
    MoveJ {
        /// rad.
        target: [f64; 6],
        /// rad/s.
        speed_rad_s: f64,
    },
    /// Move the TCP on a straight line, and wait for the end of the move.
    MoveL {
        /// X, Y, Z in m, Rx, Ry, Rz in rad, in the base frame.
        pose: [f64; 6],
        /// m/s.
        speed_m_s: f64,
    },
    /// Wait for this time.
    Wait(Duration),
    /// Write a line to the log.
    Log(String),
    /// Continue in the next slice. Scripts do not call this: it happens after too many operations.
    GiveWay {
        /// Earliest start of the next slice.
        until: Instant,
    },
}

/// The model's answer to a [`Call`].
#[derive(Debug, Clone, PartialEq)]
pub enum CallReply {
    /// The call is done.
    Done,
    /// A received frame; on CAN with its id.
    Frame {
        /// The id.
        id: Option<CanId>,
        /// Values of the fields.
        values: Vec<Scalar>,
    },
    /// An item's value.
    Value(Scalar),
    /// A bit's value, or whether a frame was sent.
    Bit(bool),
    /// The call failed; the program may catch the error.
    Error(String),
    /// The program must end.
    Abort,
}

/// How a program ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum End {
    /// The program reached its end.
    Finished,
    /// The program was aborted.
    Aborted,
    /// The program did not catch an error: one line, with the position in the script.
    Failed(String),
}

/// The state of a program.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress {
    /// The program waits for the reply to a call.
    Calling(Call),
    /// The program has ended.
    Ended(End),
}

/// A started program.
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
    /// Starts the script and runs it up to its first call.
    ///
    /// # Errors
    /// If the operating system cannot create a thread.
    pub fn start(script: &Script, now: Instant) -> std::io::Result<Self> {
        Self::start_with(script, &[], now)
    }

    /// As [`Self::start`], with further scripts that this script can call by name.
    ///
    /// # Errors
    /// If the operating system cannot create a thread.
    pub fn start_with(script: &Script, scripts: &[Script], now: Instant) -> std::io::Result<Self> {
        let (answers, answers_end) = sync_channel(0);
        let (events_end, events) = sync_channel(0);
        let variables = Arc::new(Mutex::new(Variables::new()));
        let link =
            link::ScriptLink::new(events_end, answers_end, Arc::clone(&variables), scripts.to_vec(), now);
        let own = script.clone();
        let thread = std::thread::Builder::new()
            .name(format!("program {}", script.name()))
            .stack_size(STACK_BYTES)
            .spawn(move || run(link, &own))?;
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

    /// The program's state.
    pub fn progress(&self) -> &Progress {
        &self.progress
    }

    /// Answers the pending call and runs the program up to the next call.
    pub fn answer(&mut self, now: Instant, answer: CallReply) {
        if matches!(self.progress, Progress::Ended(_)) {
            return;
        }
        if let Some(answers) = &self.answers {
            // Fails only if the thread has ended, which `wait` notices.
            let _ = answers.send(link::Stamped { now, answer });
        }
        self.wait();
    }

    /// The variables at the program's last call, including those that have gone out of scope.
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
        // Without the channels, the script's pending call returns an error that the script cannot catch.
        self.answers = None;
        self.events = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn run(link: link::ScriptLink, script: &Script) {
    let link = Arc::new(link);
    let mut engine = script::engine();
    link::watch(&mut engine, &link);
    calls::register(&mut engine, &link);
    let mut scope = Scope::new();
    let result = engine.run_ast_with_scope(&mut scope, &script.ast());
    link.end(&scope, result);
}

/// Duration of a slice, in the model's time.
pub const SLICE: Duration = Duration::from_millis(1);
/// Operations of a script in a slice: about 0.1 ms on a present machine.
pub const SLICE_OPERATIONS: u64 = 500;
/// Operations that a call counts for, because it switches threads twice.
const CALL_OPERATIONS: u64 = 50;
const MAX_STRING: usize = 4_096;
/// Maximum number of items in an array, including nested arrays, and in a map.
const MAX_ITEMS: usize = 1_024;
const MAX_VARIABLES: usize = 128;
/// Maximum depth of function calls.
const MAX_CALLS: usize = 24;
const MAX_DEPTH: usize = 32;
/// Maximum number of programs that have called one another and not returned.
const MAX_NESTED: usize = 8;
/// Each nested program may use its full depth of function calls.
const STACK_BYTES: usize = (1 + MAX_NESTED) * (8 << 20);

#[cfg(test)]
mod tests;
