//! A firmware for many boards: batch by batch, each board judged by its health before and after.
//!
//! In: boards behind [`RolloutBoard`], a [`RolloutPlan`]. Out: a [`RolloutReport`] with what became of each board, and steps as they are
//! done. Knows no network and no clock: a board waits for itself. Keeps no state: the boards say what they run, so the
//! same rollout, begun again, goes on where the one before has ended.

mod board;
mod report;

use std::fmt;
use std::time::Duration;

use crate::failure::Failure;
use crate::fleet::side_by_side;
use crate::stop::Stop;
use crate::update::Health;

pub use board::{Real, real_boards, version_of};
pub use report::RolloutReport;

/// One board of a rollout. Each step returns once it is done, or has failed for good.
pub trait RolloutBoard: Sync {
    /// What it runs.
    ///
    /// # Errors
    /// It is not reached, or is no board that takes this firmware.
    fn inspect(&self) -> Result<BoardInfo, Failure>;
    /// How it does.
    fn health(&self) -> Result<Health, Failure>;
    /// Sends the firmware, or what is missing of it. What runs stays.
    ///
    /// # Errors
    /// It is refused, or the board not reached for long.
    fn push(&self) -> Result<(), Failure>;
    /// Runs it on trial: returns once the board is back with it.
    ///
    /// # Errors
    /// It is refused, or the board does not come back with it.
    fn begin(&self) -> Result<(), Failure>;
    /// Confirms the firmware on trial.
    fn confirm(&self) -> Result<(), Failure>;
    /// Takes back what is on trial: returns once the board runs the firmware before.
    ///
    /// # Errors
    /// It is refused, or the board does not come back.
    fn back(&self) -> Result<(), Failure>;
    /// Time since any instant before the rollout.
    fn now(&self) -> Duration;
    /// Waits.
    fn wait(&self, time: Duration);
}

/// What a board runs, compared with the firmware of the rollout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BoardInfo {
    /// The version that runs.
    pub version: String,
    /// What is to be done about it.
    pub state: BoardState,
}

/// How far a board is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardState {
    /// It runs another firmware.
    Other,
    /// It runs this one on trial.
    OnTrial,
    /// It has another firmware on trial, from someone else.
    OtherOnTrial,
    /// It runs this one, confirmed.
    Confirmed,
}

/// How a rollout goes through the boards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RolloutPlan {
    /// So many at a time, at most [`MAX_AT_ONCE`](crate::MAX_AT_ONCE) of them side by side; the next ones begin once these have ended.
    pub batch: usize,
    /// Begin no further batch once a board has failed.
    pub stop_on_failure: bool,
    /// How long a board on trial may take until it does as well as before.
    pub patience: Duration,
    /// A board does as well once it has for so long without a break.
    pub settled: Duration,
}

/// What became of a board.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BoardOutcome {
    /// Not started: another board has failed, or the end was requested.
    NotBegun,
    /// It has run this firmware before.
    Already,
    /// It runs this firmware, confirmed, and does as well as before.
    Updated,
    /// A step has failed.
    Failed {
        /// The step.
        step: RolloutStep,
        /// The reason.
        why: String,
        /// What the board runs now.
        left: Left,
    },
}

/// What a board runs after a failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Left {
    /// The firmware before.
    Before,
    /// The new one, on trial: the board takes it back itself when its time is over.
    OnTrial,
    /// The new one.
    New,
    /// The board did not say.
    Unknown,
}

/// A step of a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum RolloutStep {
    /// It is asked what it runs.
    Inspect,
    /// The firmware is sent.
    Push,
    /// It begins to run on trial.
    Begin,
    /// Its health is compared with that before.
    Health,
    /// It is confirmed.
    Confirm,
}

/// A board and what became of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RolloutEntry {
    /// Its name.
    pub name: String,
    /// The version that ran before, if it has said.
    pub was: Option<String>,
    /// How it did before.
    pub before: Option<Health>,
    /// How it did last.
    pub after: Option<Health>,
    /// What became of it.
    pub outcome: BoardOutcome,
}

/// Something that has happened.
#[derive(Debug, Clone, Copy)]
pub enum RolloutEvent<'a> {
    /// A step of a board begins.
    Step(&'a str, RolloutStep),
    /// A board has ended.
    Ended(&'a RolloutEntry),
    /// A batch has ended; this is the report so far.
    Batch(&'a RolloutReport),
}

/// Takes the firmware of this version to all boards. Once `stop` is asked, boards that have begun are brought to their
/// end and no further one begins.
pub fn roll_out<B: RolloutBoard>(
    version: &str,
    boards: &[(String, B)],
    plan: RolloutPlan,
    stop: &Stop,
    notify: &(dyn Fn(RolloutEvent<'_>) + Sync),
) -> RolloutReport {
    let mut report = RolloutReport::before(version, boards.iter().map(|(name, _)| name.as_str()));
    let size = plan.batch.max(1);
    for (boards, nth) in boards.chunks(size).zip(0..) {
        if stop.is_asked() || plan.stop_on_failure && report.failed().next().is_some() {
            break;
        }
        let ended = side_by_side(
            boards,
            stop,
            |(name, _)| RolloutEntry::new(name),
            |(name, board)| {
                let mut entry = RolloutEntry::new(name);
                entry.outcome = run_board(board, plan, &mut entry, notify);
                notify(RolloutEvent::Ended(&entry));
                entry
            },
        );
        for (entry, ended) in report.entries.iter_mut().skip(nth * size).zip(ended) {
            *entry = ended;
        }
        report.was_stopped |= stop.is_asked();
        notify(RolloutEvent::Batch(&report));
    }
    report.was_stopped |= stop.is_asked();
    report
}

fn run_board<B: RolloutBoard>(
    board: &B,
    plan: RolloutPlan,
    entry: &mut RolloutEntry,
    notify: &(dyn Fn(RolloutEvent<'_>) + Sync),
) -> BoardOutcome {
    let name = entry.name.clone();
    let begins = |step| notify(RolloutEvent::Step(&name, step));
    begins(RolloutStep::Inspect);
    let seen = match board.inspect() {
        Ok(seen) => seen,
        Err(failure) => return failed(RolloutStep::Inspect, &failure, Left::Unknown),
    };
    entry.was = Some(seen.version);
    match seen.state {
        BoardState::Confirmed => {
            entry.after = board.health().ok();
            return BoardOutcome::Already;
        }
        BoardState::OtherOnTrial => {
            let why = Failure::refused("another firmware is on trial; confirm it or take it back first");
            return failed(RolloutStep::Inspect, &why, Left::Unknown);
        }
        // A rollout before has ended there; how the board did before is not known any more.
        BoardState::OnTrial => {}
        BoardState::Other => {
            entry.before = match board.health() {
                Ok(health) => Some(health),
                Err(failure) => return failed(RolloutStep::Inspect, &failure, Left::Before),
            };
            begins(RolloutStep::Push);
            if let Err(failure) = board.push() {
                return failed(RolloutStep::Push, &failure, Left::Before);
            }
            begins(RolloutStep::Begin);
            if let Err(failure) = board.begin() {
                match left(board) {
                    // It took longer than somebody has waited.
                    Left::OnTrial | Left::New => {}
                    left => return failed(RolloutStep::Begin, &failure, left),
                }
            }
        }
    }
    begins(RolloutStep::Health);
    if let Err(why) = recover(board, plan, entry) {
        let failure = Failure::refused(why);
        // What it confirmed itself stays: nothing is on trial that could be taken back.
        let left = match board.back() {
            Ok(()) => Left::Before,
            Err(_) => left(board),
        };
        return failed(RolloutStep::Health, &failure, left);
    }
    begins(RolloutStep::Confirm);
    let refused = board.confirm().err();
    // Also right if the board has confirmed itself meanwhile.
    match (board.inspect(), refused) {
        (Ok(BoardInfo { state: BoardState::Confirmed, .. }), _) => BoardOutcome::Updated,
        (seen, Some(failure)) => failed(RolloutStep::Confirm, &failure, left_of(seen)),
        (Err(failure), None) => failed(RolloutStep::Confirm, &failure, Left::Unknown),
        (seen, None) => {
            let why = Failure::refused("it was confirmed, and does not run this firmware for good");
            failed(RolloutStep::Confirm, &why, left_of(seen))
        }
    }
}

/// Waits until a board does as well as before, for a while without a break.
fn recover<B: RolloutBoard>(board: &B, plan: RolloutPlan, entry: &mut RolloutEntry) -> Result<(), String> {
    let begun = board.now();
    let mut well_since = None;
    loop {
        let now = board.now();
        let (is_well, why) = match (board.health(), &entry.before) {
            (Ok(after), before) => {
                let (is_well, why) = match before {
                    Some(before) => (after.is_as_good_as(before), "it does worse than before"),
                    None => (after.word == RUNNING, "it does not do well"),
                };
                entry.after = Some(after);
                (is_well, why.to_owned())
            }
            (Err(failure), _) => (false, failure.message().to_owned()),
        };
        well_since = is_well.then(|| well_since.unwrap_or(now));
        if well_since.is_some_and(|since| now.saturating_sub(since) >= plan.settled) {
            return Ok(());
        }
        if now.saturating_sub(begun) >= plan.patience {
            return Err(why);
        }
        board.wait(LOOK);
    }
}

fn failed(step: RolloutStep, failure: &Failure, left: Left) -> BoardOutcome {
    BoardOutcome::Failed { step, why: failure.message().to_owned(), left }
}

fn left<B: RolloutBoard>(board: &B) -> Left {
    left_of(board.inspect())
}

fn left_of(seen: Result<BoardInfo, Failure>) -> Left {
    match seen.map(|seen| seen.state) {
        Ok(BoardState::Other) => Left::Before,
        Ok(BoardState::OnTrial) => Left::OnTrial,
        Ok(BoardState::Confirmed) => Left::New,
        Ok(BoardState::OtherOnTrial) | Err(_) => Left::Unknown,
    }
}

impl RolloutEntry {
    fn new(name: &str) -> Self {
        Self { name: name.to_owned(), was: None, before: None, after: None, outcome: BoardOutcome::NotBegun }
    }
}

impl RolloutStep {
    /// In a document.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Inspect => "inspect",
            Self::Push => "push",
            Self::Begin => "try",
            Self::Health => "health",
            Self::Confirm => "confirm",
        }
    }
}

impl fmt::Display for RolloutStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Inspect => "is asked what it runs",
            Self::Push => "gets the firmware",
            Self::Begin => "restarts with it on trial",
            Self::Health => "is compared with before",
            Self::Confirm => "keeps it",
        })
    }
}

impl Left {
    /// In a document.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Before => "before",
            Self::OnTrial => "on_trial",
            Self::New => "new",
            Self::Unknown => "unknown",
        }
    }
}

/// The health of a gateway where nothing is wrong.
const RUNNING: &str = "running";
/// Time between two looks at a board on trial.
const LOOK: Duration = Duration::from_secs(1);
