//! Configurations that are stored, tried, confirmed and taken back.
//!
//! In: requests of people, the results of the driver's work, the current time. Out: what the driver has to do next.
//! Does not know what a configuration contains or where it is stored: in files on a host, in flash on a board.
//!
//! One revision is *live*: it is marked in the store, and runs after a restart. Another revision runs only *on trial*,
//! until it is confirmed, its time is over, or it fails. Whatever happens to the store, to the power or to the person
//! who applied it, the revision that runs in the end is a confirmed one.
//!
//! The contract is that of the engine: report one change, then call [`Revisions::poll_output`] until it returns
//! [`RevisionOutput::Sleep`]. The driver executes each other output and reports its result before the next call.

use core::fmt::{self, Write as _};

use heapless::{String, Vec};
use proto_core::time::{Duration, Instant};

use crate::guard::Refusal;
use crate::request::cut;
use crate::response::StatusCode;

/// Maximum number of revisions that are kept.
pub const MAX_REVISIONS: usize = 8;
/// Shortest and longest trial.
pub const TRIAL: core::ops::RangeInclusive<Duration> = Duration::from_secs(1)..=Duration::from_secs(3600);
/// How long to wait before a live revision that did not start is started again: the first pause, and the longest.
const RETRY: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(10));

/// A stored configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Revision {
    /// Its number, higher than those of all revisions before it.
    pub number: u32,
    /// The beginning of the hash of its contents, since two stores may use the same numbers.
    pub digest: u32,
}

/// The ETag of a revision, such as `"3-0badcafe"` with its quotes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Etag(pub Revision);

impl fmt::Display for Etag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "\"{}-{:08x}\"", self.0.number, self.0.digest)
    }
}

impl Etag {
    /// Parses an ETag. `None` if the text is not exactly as displayed.
    pub fn parse(text: &str) -> Option<Revision> {
        let (number, digest) = cut(text.strip_prefix('"')?.strip_suffix('"')?, b'-')?;
        let revision =
            Revision { number: number.parse().ok()?, digest: u32::from_str_radix(digest, 16).ok()? };
        let mut same = String::<24>::new();
        write!(same, "{}", Self(revision)).ok()?;
        (same == text).then_some(revision)
    }
}

/// The revision that a change is based on, from `If-Match`. `Some(None)` stands for a field that is not one ETag.
///
/// # Errors
/// `If-Match` is missing, or is not one ETag.
pub fn base_of(if_match: Option<Option<Revision>>) -> core::result::Result<Revision, Refusal> {
    match if_match {
        Some(Some(base)) => Ok(base),
        Some(None) => Err(Refusal::new(
            StatusCode::PRECONDITION_FAILED,
            "If-Match must be one ETag, such as \"3-0badcafe\"",
        )),
        None => Err(Refusal::new(
            StatusCode::PRECONDITION_REQUIRED,
            "If-Match is needed: the ETag of the revision that this one was made from",
        )),
    }
}

/// What the store holds at the start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stored {
    /// All revisions, the oldest first.
    pub kept: Vec<Revision, MAX_REVISIONS>,
    /// Number of the live revision.
    pub live: u32,
    /// Number of the revision that was live before.
    pub previous: Option<u32>,
}

/// The revisions and their state.
#[derive(Debug, Clone)]
pub struct Revisions {
    kept: Vec<Revision, MAX_REVISIONS>,
    live: u32,
    previous: Option<u32>,
    waiting: Option<u32>,
    phase: RevisionPhase,
    last: Option<(u32, Ended)>,
    /// The output of the phase has not been returned yet.
    is_due: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RevisionPhase {
    /// The live revision runs.
    Live,
    /// A revision is being written; then `forget` is removed.
    Storing { revision: Revision, forget: Option<u32> },
    /// A revision is being started for a trial of this length.
    StartingTrial { number: u32, trial: Duration },
    /// A revision is on trial until then.
    Trial { number: u32, until: Instant },
    /// A revision on trial was confirmed and is being marked as live.
    Confirming { number: u32, until: Instant },
    /// The revision that was live before is being started.
    Returning { number: u32 },
    /// It runs and is being marked as live.
    Marking { number: u32 },
    /// The live revision is being started.
    StartingLive { wait: Duration },
    /// The live revision did not start. Nothing runs until the next attempt.
    Down { until: Instant, wait: Duration },
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// A person confirmed it.
    Confirmed,
    /// Nobody confirmed it in time.
    NotConfirmed,
    /// A person took it back.
    TakenBack,
    /// The revision could not be started, or ended by itself.
    Failed,
}

impl Ended {
    /// A word for people and statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::NotConfirmed => "not-confirmed",
            Self::TakenBack => "taken-back",
            Self::Failed => "failed",
        }
    }
}

/// What the driver has to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RevisionOutput {
    /// Store the configuration that was given with [`Revisions::put`], then remove `forget`. Report
    /// [`Result::Stored`].
    Store {
        /// Number and digest of the configuration.
        revision: Revision,
        /// A revision that is to be removed.
        forget: Option<u32>,
    },
    /// Output the safe values, end what runs, and start this revision. Report [`Result::Started`].
    Run {
        /// Number of the revision.
        number: u32,
    },
    /// Mark one revision as live and the other as the one before, atomically even if the power fails. Report
    /// [`Result::Marked`].
    Mark {
        /// Number of the live revision.
        live: u32,
        /// Number of the revision before.
        previous: u32,
    },
    /// Nothing to do until then.
    Sleep {
        /// When to call [`Revisions::poll_output`] again.
        until: Instant,
    },
}

/// The result of a [`RevisionOutput`]: `true` if it was done, `false` if nothing was changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Result {
    /// The result of [`RevisionOutput::Store`].
    Stored(bool),
    /// The result of [`RevisionOutput::Run`]. After `false` nothing runs.
    Started(bool),
    /// The result of [`RevisionOutput::Mark`].
    Marked(bool),
    /// The revision on trial ended by itself.
    Ended,
}

/// Why a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refused {
    /// Another operation is in progress, or nothing runs at the moment.
    Busy,
    /// A revision is on trial: confirm it or take it back first.
    OnTrial,
    /// No revision is on trial.
    NotOnTrial,
    /// The change is not based on the newest revision, which is this one.
    Changed(Revision),
    /// No number was given, and no stored revision waits to be applied.
    NothingWaits,
    /// There is no such revision.
    Unknown,
    /// The revision runs already.
    Runs,
    /// The trial is shorter or longer than allowed.
    Trial,
    /// No other revision was live before.
    NoPrevious,
}

impl Refused {
    /// The status of the response.
    pub const fn status(self) -> StatusCode {
        match self {
            Self::Changed(_) => StatusCode::PRECONDITION_FAILED,
            Self::Unknown => StatusCode::NOT_FOUND,
            Self::Trial => StatusCode::BAD_REQUEST,
            _ => StatusCode::CONFLICT,
        }
    }
}

/// The text of the response.
impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |at: &Duration| (at.as_millis() / 1_000) as u32;
        f.write_str(match self {
            Self::Busy => "something else is being done; try again",
            Self::OnTrial => "a revision is on trial; confirm it or roll it back first",
            Self::NotOnTrial => "no revision is on trial",
            Self::Changed(base) => {
                return write!(f, "the configuration was changed meanwhile; the newest is {}", Etag(*base));
            }
            Self::NothingWaits => "no stored revision waits; name one",
            Self::Unknown => "there is no such revision",
            Self::Runs => "it is live already",
            Self::Trial => {
                let (min, max) = (seconds(TRIAL.start()), seconds(TRIAL.end()));
                return write!(f, "confirm_s is out of range; allowed: {min}..={max}");
            }
            Self::NoPrevious => "no other revision was live before",
        })
    }
}

impl Revisions {
    /// Starts with what the store holds. The live revision runs, or is about to be started by the driver. `None` if the
    /// store does not hold the live revision.
    pub fn new(stored: Stored) -> Option<Self> {
        let Stored { kept, live, previous } = stored;
        let has = |number: u32| kept.iter().any(|revision| revision.number == number);
        let is_sorted = kept.is_sorted_by(|one, next| one.number < next.number);
        let previous = previous.filter(|&number| has(number) && number != live);
        (has(live) && is_sorted).then_some(Self {
            live,
            previous,
            kept,
            waiting: None,
            phase: RevisionPhase::Live,
            last: None,
            is_due: false,
        })
    }

    /// Continues a trial that began before a restart of the program: `number` runs until `until`. Returns `false` if
    /// that revision is not stored, or is the live one.
    pub fn resume_trial(&mut self, number: u32, until: Instant) -> bool {
        let is_other = number != self.live && self.revision(number).is_some();
        if is_other {
            self.enter(RevisionPhase::Trial { number, until });
        }
        is_other
    }

    /// Restores the last trial that ended before a restart of the program, and how it ended.
    pub fn resume_last(&mut self, last: Option<(u32, Ended)>) {
        self.last = last;
    }

    /// Removes the revisions that are no longer stored, except the live one and the one before it.
    pub fn keep_only(&mut self, is_kept: impl Fn(u32) -> bool) {
        let needed = [Some(self.live), self.previous];
        self.kept.retain(|kept| needed.contains(&Some(kept.number)) || is_kept(kept.number));
        self.waiting = self.waiting.filter(|number| is_kept(*number));
    }

    /// All stored revisions, the oldest first.
    pub fn kept(&self) -> &[Revision] {
        &self.kept
    }

    /// The revision that runs after a restart.
    pub fn live(&self) -> u32 {
        self.live
    }

    /// The revision that was live before.
    pub fn previous(&self) -> Option<u32> {
        self.previous
    }

    /// The revision that was stored but not applied yet.
    pub fn waiting(&self) -> Option<u32> {
        self.waiting
    }

    /// The revision that runs; `None` while none does.
    pub fn running(&self) -> Option<u32> {
        match self.phase {
            RevisionPhase::Live | RevisionPhase::Storing { .. } => Some(self.live),
            RevisionPhase::Trial { number, .. }
            | RevisionPhase::Confirming { number, .. }
            | RevisionPhase::Marking { number } => Some(number),
            _ => None,
        }
    }

    /// The revision on trial, and the end of the trial.
    pub fn trial(&self) -> Option<(u32, Instant)> {
        match self.phase {
            RevisionPhase::Trial { number, until } | RevisionPhase::Confirming { number, until } => {
                Some((number, until))
            }
            _ => None,
        }
    }

    /// The last trial that ended, and how.
    pub fn last(&self) -> Option<(u32, Ended)> {
        self.last
    }

    /// The revision that a change has to be based on: the waiting one if there is one, otherwise the live one.
    pub fn base(&self) -> Option<Revision> {
        self.revision(self.waiting.unwrap_or(self.live))
    }

    /// The revision with this number.
    pub fn revision(&self, number: u32) -> Option<Revision> {
        self.kept.iter().copied().find(|revision| revision.number == number)
    }

    /// A person stores a configuration that was made from `base`. Returns its number. It is kept once the store has
    /// succeeded.
    pub fn put(&mut self, base: Revision, digest: u32) -> core::result::Result<u32, Refused> {
        self.must_rest()?;
        match self.base() {
            Some(newest) if newest != base => return Err(Refused::Changed(newest)),
            None => return Err(Refused::Busy),
            Some(_) => {}
        }
        let newest = self.kept.iter().map(|revision| revision.number).max().unwrap_or(0);
        let revision = Revision { number: newest.saturating_add(1), digest };
        let needed = [Some(self.live), self.previous, self.waiting];
        let unneeded =
            self.kept.iter().map(|revision| revision.number).find(|&number| !needed.contains(&Some(number)));
        let forget = unneeded.filter(|_| self.kept.is_full());
        self.enter(RevisionPhase::Storing { revision, forget });
        Ok(revision.number)
    }

    /// A person applies a revision, by default the waiting one. Returns its number.
    pub fn apply(&mut self, number: Option<u32>, trial: Duration) -> core::result::Result<u32, Refused> {
        self.must_rest()?;
        if !TRIAL.contains(&trial) {
            return Err(Refused::Trial);
        }
        let number = number.or(self.waiting).ok_or(Refused::NothingWaits)?;
        if self.revision(number).is_none() {
            return Err(Refused::Unknown);
        }
        if number == self.live {
            return Err(Refused::Runs);
        }
        if self.waiting == Some(number) {
            self.waiting = None;
        }
        self.enter(RevisionPhase::StartingTrial { number, trial });
        Ok(number)
    }

    /// A person confirms the revision on trial. Returns its number. It is live once it is marked.
    pub fn confirm(&mut self, now: Instant) -> core::result::Result<u32, Refused> {
        match self.phase {
            RevisionPhase::Trial { number, until } if now < until => {
                self.enter(RevisionPhase::Confirming { number, until });
                Ok(number)
            }
            RevisionPhase::Live | RevisionPhase::Trial { .. } => Err(Refused::NotOnTrial),
            _ => Err(Refused::Busy),
        }
    }

    /// A person takes back the revision on trial, or, without a trial, the live one. Returns the number of the revision
    /// that runs next.
    pub fn roll_back(&mut self) -> core::result::Result<u32, Refused> {
        match (self.phase, self.previous) {
            (RevisionPhase::Trial { number, .. }, _) => {
                self.end_trial(number, Ended::TakenBack);
                Ok(self.live)
            }
            (RevisionPhase::Live, Some(number)) => {
                self.enter(RevisionPhase::Returning { number });
                Ok(number)
            }
            (RevisionPhase::Live, None) => Err(Refused::NoPrevious),
            _ => Err(Refused::Busy),
        }
    }

    /// Reports the result of an output. Results of other outputs than the current one are ignored.
    pub fn handle(&mut self, now: Instant, result: Result) {
        if self.is_due && result != Result::Ended {
            return;
        }
        match (self.phase, result) {
            (RevisionPhase::Storing { revision, forget }, Result::Stored(is_done)) => {
                if is_done {
                    self.kept.retain(|kept| Some(kept.number) != forget);
                    // Cannot fail: removing `forget` made room.
                    let _ = self.kept.push(revision);
                    self.waiting = Some(revision.number);
                }
                self.enter(RevisionPhase::Live);
            }
            (RevisionPhase::StartingTrial { number, trial }, Result::Started(true)) => {
                self.enter(RevisionPhase::Trial { number, until: now + trial });
            }
            (RevisionPhase::StartingTrial { number, .. }, Result::Started(false))
            | (RevisionPhase::Trial { number, .. }, Result::Ended) => {
                self.end_trial(number, Ended::Failed);
            }
            (RevisionPhase::Confirming { number, .. }, Result::Marked(true)) => {
                self.last = Some((number, Ended::Confirmed));
                (self.previous, self.live) = (Some(self.live), number);
                self.enter(RevisionPhase::Live);
            }
            (RevisionPhase::Confirming { number, until }, Result::Marked(false)) => {
                self.enter(RevisionPhase::Trial { number, until })
            }
            (RevisionPhase::Returning { number }, Result::Started(true)) => {
                self.enter(RevisionPhase::Marking { number })
            }
            (RevisionPhase::Returning { number }, Result::Started(false)) => {
                self.end_trial(number, Ended::Failed)
            }
            (RevisionPhase::Marking { number }, Result::Marked(true)) => {
                (self.previous, self.live) = (Some(self.live), number);
                self.enter(RevisionPhase::Live);
            }
            // The revision that runs must be the one that runs after a restart.
            (RevisionPhase::Marking { number }, Result::Marked(false)) => {
                self.end_trial(number, Ended::Failed)
            }
            (RevisionPhase::StartingLive { .. }, Result::Started(true)) => self.enter(RevisionPhase::Live),
            (RevisionPhase::StartingLive { wait }, Result::Started(false)) => {
                self.enter(RevisionPhase::Down { until: now + wait, wait })
            }
            _ => {}
        }
    }

    /// The next task for the driver. Call it again until it returns [`RevisionOutput::Sleep`].
    pub fn poll_output(&mut self, now: Instant) -> RevisionOutput {
        match self.phase {
            RevisionPhase::Trial { number, until } if now >= until => {
                self.end_trial(number, Ended::NotConfirmed)
            }
            RevisionPhase::Down { until, wait } if now >= until => {
                self.enter(RevisionPhase::StartingLive { wait: wait.saturating_mul(2).min(RETRY.1) });
            }
            _ => {}
        }
        let until = match self.phase {
            RevisionPhase::Trial { until, .. } | RevisionPhase::Down { until, .. } => until,
            _ => Instant::NEVER,
        };
        if !core::mem::take(&mut self.is_due) {
            return RevisionOutput::Sleep { until };
        }
        match self.phase {
            RevisionPhase::Storing { revision, forget } => RevisionOutput::Store { revision, forget },
            RevisionPhase::StartingTrial { number, .. } | RevisionPhase::Returning { number } => {
                RevisionOutput::Run { number }
            }
            RevisionPhase::StartingLive { .. } => RevisionOutput::Run { number: self.live },
            RevisionPhase::Confirming { number, .. } | RevisionPhase::Marking { number } => {
                RevisionOutput::Mark { live: number, previous: self.live }
            }
            RevisionPhase::Live | RevisionPhase::Trial { .. } | RevisionPhase::Down { .. } => {
                RevisionOutput::Sleep { until }
            }
        }
    }

    /// Refuses unless the live revision runs and nothing is in progress.
    fn must_rest(&self) -> core::result::Result<(), Refused> {
        match self.phase {
            RevisionPhase::Live => Ok(()),
            RevisionPhase::Trial { .. } | RevisionPhase::Confirming { .. } => Err(Refused::OnTrial),
            _ => Err(Refused::Busy),
        }
    }

    fn end_trial(&mut self, number: u32, why: Ended) {
        self.last = Some((number, why));
        self.enter(RevisionPhase::StartingLive { wait: RETRY.0 });
    }

    fn enter(&mut self, phase: RevisionPhase) {
        self.phase = phase;
        self.is_due =
            !matches!(phase, RevisionPhase::Live | RevisionPhase::Trial { .. } | RevisionPhase::Down { .. });
    }
}
