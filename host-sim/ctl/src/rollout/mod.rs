//! A firmware for many boards: batch by batch, each board judged by its health before and after.
//!
//! In: boards behind [`RolloutBoard`], a [`RolloutPlan`]. Out: a [`RolloutReport`] with the outcome of each board, and
//! completed steps. Does not know networks or clocks: a board waits for itself. Keeps no state: the boards report what
//! they run, so an interrupted rollout continues when it is started again.

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

/// One board of a rollout. Each step returns once it is done or has failed permanently.
pub trait RolloutBoard: Sync {
    /// What the board runs.
    ///
    /// # Errors
    /// The board is not reached, or does not take this firmware.
    fn inspect(&self) -> Result<BoardInfo, Failure>;
    /// The board's health.
    fn health(&self) -> Result<Health, Failure>;
    /// Sends the firmware, or its missing part. The running firmware continues.
    ///
    /// # Errors
    /// The firmware is refused, or the board is not reached for long.
    fn push(&self) -> Result<(), Failure>;
    /// Starts the trial: returns once the board is back with the firmware.
    ///
    /// # Errors
    /// The trial is refused, or the board does not come back with the firmware.
    fn begin(&self) -> Result<(), Failure>;
    /// Confirms the firmware on trial.
    fn confirm(&self) -> Result<(), Failure>;
    /// Ends the trial: returns once the board runs the previous firmware.
    ///
    /// # Errors
    /// The request is refused, or the board does not come back.
    fn back(&self) -> Result<(), Failure>;
    /// Time since some instant before the rollout.
    fn now(&self) -> Duration;
    /// Waits.
    fn wait(&self, time: Duration);
}

/// What a board runs in comparison with the firmware of the rollout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BoardInfo {
    /// The version that runs.
    pub version: String,
    /// What remains to be done.
    pub state: BoardState,
}

/// How far a board is in the rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardState {
    /// The board runs another firmware.
    Other,
    /// The board runs this firmware on trial.
    OnTrial,
    /// The board has another firmware on trial.
    OtherOnTrial,
    /// The board runs this firmware, confirmed.
    Confirmed,
}

/// How a rollout goes through the boards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RolloutPlan {
    /// Boards in a batch, at most [`MAX_AT_ONCE`](crate::MAX_AT_ONCE) of them at the same time; the next batch begins
    /// once this one has ended.
    pub batch: usize,
    /// Begin no further batch once a board has failed.
    pub stop_on_failure: bool,
    /// How long a board on trial may take to be as healthy as before.
    pub patience: Duration,
    /// How long a board must be as healthy as before without a break.
    pub settled: Duration,
}

/// The outcome of a board.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BoardOutcome {
    /// Not started: another board has failed, or the end was requested.
    NotBegun,
    /// The board already ran this firmware.
    Already,
    /// The board runs this firmware, confirmed, and is as healthy as before.
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
    /// The previous firmware.
    Before,
    /// The new firmware on trial, which the board takes back itself when the time is over.
    OnTrial,
    /// The new firmware.
    New,
    /// The board did not say.
    Unknown,
}

/// A step of a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum RolloutStep {
    /// The board is asked what it runs.
    Inspect,
    /// The firmware is sent.
    Push,
    /// The trial is started.
    Begin,
    /// The health is compared with that before.
    Health,
    /// The firmware is confirmed.
    Confirm,
}

/// A board and its outcome.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RolloutEntry {
    /// Its name.
    pub name: String,
    /// The version before, if the board has reported it.
    pub was: Option<String>,
    /// The health before.
    pub before: Option<Health>,
    /// The newest health.
    pub after: Option<Health>,
    /// The outcome.
    pub outcome: BoardOutcome,
}

/// Progress of a rollout.
#[derive(Debug, Clone, Copy)]
pub enum RolloutEvent<'a> {
    /// A step of a board begins.
    Step(&'a str, RolloutStep),
    /// A board has ended.
    Ended(&'a RolloutEntry),
    /// A batch has ended; this is the report so far.
    Batch(&'a RolloutReport),
}

/// Takes the firmware of this version to all boards. Once `stop` is requested, boards that have begun are brought to
/// their end and no further board begins.
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
        // An earlier rollout has ended here; the health before it is unknown.
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
                    // The board took longer than the timeout.
                    Left::OnTrial | Left::New => {}
                    left => return failed(RolloutStep::Begin, &failure, left),
                }
            }
        }
    }
    begins(RolloutStep::Health);
    if let Err(why) = recover(board, plan, entry) {
        let failure = Failure::refused(why);
        // A firmware that has confirmed itself stays: there is no trial to take back.
        let left = match board.back() {
            Ok(()) => Left::Before,
            Err(_) => left(board),
        };
        return failed(RolloutStep::Health, &failure, left);
    }
    begins(RolloutStep::Confirm);
    let refused = board.confirm().err();
    // Also correct if the firmware has confirmed itself meanwhile.
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

/// Waits until a board has been as healthy as before for some time without a break.
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
    /// The name in a document.
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
    /// The name in a document.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Before => "before",
            Self::OnTrial => "on_trial",
            Self::New => "new",
            Self::Unknown => "unknown",
        }
    }
}

/// The health of a gateway without problems.
const RUNNING: &str = "running";
/// Poll interval of a board on trial.
const LOOK: Duration = Duration::from_secs(1);
