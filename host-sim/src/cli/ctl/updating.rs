//! `ctl update FILE` with an inventory: the rollout of a firmware, with progress lines and a report.

use std::io::Write;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

use recipe_ctl::rollout::{self, RolloutBoard, RolloutEvent, RolloutPlan, RolloutReport};
use recipe_ctl::update::Downgrade;
use recipe_ctl::{Failure, Member, Rollout, Stop, Update, Verdict};
use recipe_runtime::out::print_stderr;

use super::{RequestOptions, write};

/// A firmware for the boards of an inventory.
#[derive(Debug)]
pub(super) struct Updating<'a> {
    /// The file.
    pub(super) update: Update,
    /// How long a board has it on trial, in seconds.
    pub(super) trial_s: u32,
    /// Whether it may be older than what runs.
    pub(super) downgrade: Downgrade,
    /// In which batches.
    pub(super) rollout: Rollout,
    /// The file for the report.
    pub(super) report: Option<&'a Path>,
}

impl Updating<'_> {
    pub(super) fn roll_out(
        &self,
        members: &[Member],
        stop: &Stop,
        run: RequestOptions,
        out: &mut dyn Write,
    ) -> Result<Verdict, Failure> {
        let boards = rollout::real_boards(members, &self.update, run.timeout, self.trial_s, self.downgrade)?;
        let report = self.through(&rollout::version_of(&self.update)?, &boards, stop)?;
        if run.json {
            writeln!(out, "{}", recipe_ctl::shown::json(&report.document()))?;
        } else {
            out.write_all(report.table(run.view).as_bytes())?;
        }
        out.flush()?;
        let verdict = report.verdict();
        if verdict.is_ok() && !run.json {
            writeln!(out, "{}", report.summary())?;
        }
        verdict
    }

    /// All boards, and the report in its file.
    fn through<B: RolloutBoard>(
        &self,
        version: &str,
        boards: &[(String, B)],
        stop: &Stop,
    ) -> Result<RolloutReport, Failure> {
        // Check that the report can be written before anything is done.
        self.keep(&RolloutReport::before(version, boards.iter().map(|(name, _)| name.as_str())))?;
        let unkept = Mutex::new(None);
        let report = rollout::roll_out(version, boards, self.plan(), stop, &|event| match event {
            RolloutEvent::Step(name, step) => {
                print_stderr(format_args!("{}: {step}", recipe_ctl::shown::line(name)))
            }
            RolloutEvent::Ended(entry) => print_stderr(RolloutReport::line(entry)),
            RolloutEvent::Batch(report) => {
                *unkept.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = self.keep(report).err();
            }
        });
        if let Some(failure) = unkept.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner) {
            print_stderr(failure.message());
        }
        Ok(report)
    }

    fn keep(&self, report: &RolloutReport) -> Result<(), Failure> {
        let Some(path) = self.report else { return Ok(()) };
        write(path, format!("{:#}\n", report.document()).as_bytes(), true)
    }

    fn plan(&self) -> RolloutPlan {
        RolloutPlan {
            batch: self.rollout.batch,
            stop_on_failure: self.rollout.stop_on_failure,
            // The other half of the trial is for its restart, and for taking it back.
            patience: Duration::from_secs(self.trial_s.into()) / 2,
            settled: SETTLED,
        }
    }
}

/// Printed when the end is requested.
pub(super) const ENDING: &str = "ends once the boards in hand have; a second time ends at once, and a board on trial confirms itself \
     or goes back";
/// As long as a board takes to confirm itself.
const SETTLED: Duration = Duration::from_secs(10);
