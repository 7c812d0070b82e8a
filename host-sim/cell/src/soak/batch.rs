//! Many runs on several threads; the results do not depend on the number of threads.

use std::collections::BTreeMap;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

use proto_core::time::Duration;

use super::{Level, Report, Scenario, Share, Soak};
use crate::{FaultKind, Invariant, Kind, OUTCOMES, Rng, Violation};

/// Maximum length of one run.
pub const RUN_LENGTH: Duration = Duration::from_secs(600);

/// A span of virtual time, split into runs with separate seeds.
#[derive(Debug)]
pub struct Batch {
    scenarios: Vec<Scenario>,
    level: Level,
    seed: u64,
    span: Duration,
    run_length: Duration,
    /// Number of runs in all shares.
    runs: usize,
    share: Share,
    next: AtomicUsize,
    stop: AtomicBool,
    done: Mutex<BTreeMap<usize, Report>>,
    /// Virtual time that has passed, including that of unfinished runs.
    elapsed_us: AtomicU64,
    failed: Mutex<Option<Failure>>,
}

/// A failed run.
#[derive(Debug, Clone, PartialEq)]
pub struct Failure {
    /// Index of the run in the batch.
    pub run: usize,
    /// Seed of the run itself.
    pub seed: u64,
    /// The cell's name.
    pub cell: String,
    /// Time since the run's start.
    pub after: Duration,
    /// The violation.
    pub what: Violation,
}

/// Progress of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Virtual time that has passed.
    pub elapsed: Duration,
    /// Number of finished runs.
    pub runs: usize,
}

/// The sums of all finished runs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Total {
    /// Number of finished runs.
    pub runs: usize,
    /// Number of all runs of the batch.
    pub of: usize,
    /// Virtual time.
    pub span: Duration,
    /// Number of runs of each cell, and their virtual time.
    pub cells: BTreeMap<String, (usize, Duration)>,
    /// Faults of each kind.
    pub faults: BTreeMap<FaultKind, u64>,
    /// Number of frames received and sent, by cell and port.
    pub ports: BTreeMap<(String, String), (u64, u64)>,
    /// Number of sends and receives, by kind of link.
    pub links: BTreeMap<String, (u64, u64)>,
    /// Number of entries in the traces.
    pub events: u64,
    /// Number of values written to the controller that were checked.
    pub writes: u64,
    /// Number of checks of each invariant.
    pub checks: BTreeMap<Invariant, u64>,
    /// The outcomes of events of judged devices.
    pub outcomes: BTreeMap<String, u64>,
    /// A hash of the traces of all runs.
    pub hash: u64,
}

impl Batch {
    /// A batch of `span` virtual time in all, with these cells in turn.
    pub fn new(scenarios: Vec<Scenario>, level: Level, seed: u64, span: Duration) -> Self {
        let (run_length, runs) = split(span, scenarios.len());
        Self {
            scenarios,
            level,
            seed,
            span,
            run_length,
            runs,
            share: Share::default(),
            next: AtomicUsize::new(0),
            stop: AtomicBool::new(false),
            done: Mutex::new(BTreeMap::new()),
            elapsed_us: AtomicU64::new(0),
            failed: Mutex::new(None),
        }
    }

    /// Restricts the batch to the runs of one share.
    #[must_use]
    pub fn only(mut self, share: Share) -> Self {
        self.share = share;
        self.next = AtomicUsize::new(self.share_runs().start);
        self
    }

    /// Number of runs in all shares.
    pub fn runs(&self) -> usize {
        self.runs
    }

    /// The runs of this share.
    pub fn share_runs(&self) -> Range<usize> {
        self.share.runs(self.runs)
    }

    /// The share.
    pub fn share(&self) -> Share {
        self.share
    }

    /// The level of faults.
    pub fn level(&self) -> Level {
        self.level
    }

    /// The seed of the batch.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Virtual time of all shares.
    pub fn whole_span(&self) -> Duration {
        self.span
    }

    /// Virtual time of this share.
    pub fn span(&self) -> Duration {
        let runs = self.share_runs();
        self.between(runs)
    }

    /// The digests of this share's runs, in order; `None` for an unfinished run.
    pub fn digests(&self) -> impl Iterator<Item = Option<u64>> {
        let done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        let digests: Vec<_> =
            self.share_runs().map(|run| done.get(&run).map(|report| report.digest)).collect();
        digests.into_iter()
    }

    /// The names of the cells, each with a hash of its configuration and of the first moments of its first run. The
    /// hashes are equal on two machines that would run the batch in the same way.
    pub fn fingerprints(&self) -> Vec<(String, u64)> {
        let first_moments = |nth: usize, scenario: &Scenario| {
            let mut soak = Soak::new(scenario, self.seed_of(nth), self.level).ok()?;
            soak.run_to(SAMPLE);
            Some(soak.report().digest)
        };
        let of = |(nth, scenario): (usize, &Scenario)| {
            // A panic is reported when that run is executed as part of a share.
            let sample = catch_unwind(AssertUnwindSafe(|| first_moments(nth, scenario))).ok().flatten();
            let words = [scenario.hash(), sample.unwrap_or(0)];
            (scenario.name.clone(), words.into_iter().fold(0, mix))
        };
        self.scenarios.iter().enumerate().map(of).collect()
    }

    /// The seed of a run. Its remainder selects the cell.
    pub fn seed_of(&self, run: usize) -> u64 {
        let cells = self.scenarios.len().max(1) as u64;
        let mut rng = Rng::new(self.seed ^ (run as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        // Seeds are short enough to type.
        let drawn = rng.below(1 << 40);
        drawn - drawn % cells + run as u64 % cells
    }

    /// The cell that the seed of a run selects.
    pub fn scenario_of(scenarios: &[Scenario], seed: u64) -> Option<&Scenario> {
        scenarios.get((seed % scenarios.len().max(1) as u64) as usize)
    }

    /// Executes runs until all are done, one fails, or [`Batch::stop`] is called. Several threads may call this at the
    /// same time.
    pub fn work(&self) {
        while !self.stop.load(Relaxed) {
            let run = self.next.fetch_add(1, Relaxed);
            if run >= self.share_runs().end {
                return;
            }
            self.execute(run);
        }
    }

    /// Stops the current runs.
    pub fn stop(&self) {
        self.stop.store(true, Relaxed);
    }

    /// The progress.
    pub fn progress(&self) -> Progress {
        let runs = self.done.lock().unwrap_or_else(PoisonError::into_inner).len();
        Progress { elapsed: Duration::from_micros(self.elapsed_us.load(Relaxed)), runs }
    }

    /// The failure with the lowest run index.
    pub fn failure(&self) -> Option<Failure> {
        self.failed.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The sums of the runs finished so far.
    pub fn total(&self) -> Total {
        let done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        let mut total = Total { of: self.share_runs().len(), ..Total::default() };
        for (&run, report) in done.iter() {
            let cell = Self::scenario_of(&self.scenarios, self.seed_of(run)).map_or("", |cell| &cell.name);
            total.add(run, cell, report);
        }
        total
    }

    fn execute(&self, run: usize) {
        let seed = self.seed_of(run);
        let Some(scenario) = Self::scenario_of(&self.scenarios, seed) else { return };
        let length = self.between(run..run + 1);
        let mut soak = match Soak::new(scenario, seed, self.level) {
            Ok(soak) => soak,
            // Cannot happen: the caller has built each cell before.
            Err(error) => panic!("{}: {error}", scenario.name),
        };
        let mut reached = Duration::ZERO;
        while reached < length && soak.cell().violation().is_none() {
            if self.stop.load(Relaxed) {
                return;
            }
            let next = (reached + SLICE).min(length);
            // A panic is a violation like any other.
            let done = catch_unwind(AssertUnwindSafe(|| soak.run_to(next)));
            if done.is_err() {
                let what = Violation::panic(soak.cell().now());
                return self.fail(Failure {
                    run,
                    seed,
                    cell: scenario.name.clone(),
                    after: soak.elapsed(),
                    what,
                });
            }
            self.elapsed_us.fetch_add(next.as_micros() - reached.as_micros(), Relaxed);
            reached = next;
        }
        let report = soak.report();
        match report.violation.clone() {
            Some((what, after)) => self.fail(Failure { run, seed, cell: scenario.name.clone(), after, what }),
            None => {
                self.done.lock().unwrap_or_else(PoisonError::into_inner).insert(run, report);
            }
        }
    }

    /// Virtual time of some runs.
    fn between(&self, runs: Range<usize>) -> Duration {
        let before = |run: usize| self.run_length.saturating_mul(run as u64).min(self.span).as_micros();
        Duration::from_micros(before(runs.end) - before(runs.start))
    }

    fn fail(&self, failure: Failure) {
        let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        if failed.as_ref().is_none_or(|before| failure.run < before.run) {
            *failed = Some(failure);
        }
        self.stop();
    }
}

impl Total {
    fn add(&mut self, run: usize, cell: &str, report: &Report) {
        self.runs += 1;
        self.span = self.span + report.span;
        let of_cell = self.cells.entry(cell.to_owned()).or_default();
        *of_cell = (of_cell.0 + 1, of_cell.1 + report.span);
        for (&kind, count) in &report.faults {
            *self.faults.entry(kind).or_default() += count;
        }
        for (port, received, sent) in &report.ports {
            let sum = self.ports.entry((cell.to_owned(), port.clone())).or_default();
            *sum = (sum.0 + received, sum.1 + sent);
        }
        for (link, sent, received) in &report.links {
            let sum = self.links.entry((*link).to_owned()).or_default();
            *sum = (sum.0 + sent, sum.1 + received);
        }
        self.events += report.events;
        self.writes += report.writes;
        for (&invariant, count) in &report.checks {
            *self.checks.entry(invariant).or_default() += count;
        }
        for (&outcome, count) in &report.outcomes {
            *self.outcomes.entry(outcome.to_owned()).or_default() += count;
        }
        self.fold(run, report.digest);
    }

    /// The outcomes of events that were too rare, each with its count, after a long harsh run of all cells with judged
    /// devices. Empty for any other run.
    pub fn rare_outcomes(&self, level: Level) -> Vec<(&'static str, u64)> {
        let spans = |kind| self.cells.iter().filter(move |(name, _)| Kind::of(name) == Some(kind));
        let span =
            |kind| spans(kind).map(|(_, (_, span))| *span).fold(Duration::ZERO, |all, span| all + span);
        if level != Level::Harsh || Kind::ALL.into_iter().any(|kind| span(kind) < LONG) {
            return Vec::new();
        }
        let count = |name| self.outcomes.get(name).copied().unwrap_or_default();
        OUTCOMES.into_iter().map(|name| (name, count(name))).filter(|(_, count)| *count < OFTEN).collect()
    }

    /// Adds the digest of the next finished run to the hash.
    pub(super) fn fold(&mut self, run: usize, digest: u64) {
        self.hash = [run as u64, digest].into_iter().fold(self.hash, mix);
    }
}

/// The length of a run, and the number of runs.
pub(super) fn split(span: Duration, cells: usize) -> (Duration, usize) {
    // Each cell gets a run, even if `span` is short.
    let share = span.as_micros().div_ceil(cells.max(1) as u64).max(1);
    let run_length = RUN_LENGTH.min(Duration::from_micros(share));
    (run_length, span.as_micros().div_ceil(run_length.as_micros()) as usize)
}

fn mix(hash: u64, word: u64) -> u64 {
    (hash.rotate_left(5) ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15)
}

/// In this much time of each judged cell, every outcome of an event occurs often. It is a little less than the share of
/// one cell in a day of all cells.
const LONG: Duration = Duration::from_secs(3_600);
/// How often every outcome occurs at least in that time.
const OFTEN: u64 = 100;
/// The first part of a run, which counts for its cell's fingerprint.
const SAMPLE: Duration = Duration::from_secs(1);

/// The time between two checks whether to stop.
const SLICE: Duration = Duration::from_secs(2);
