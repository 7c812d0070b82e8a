//! Timelines: operations at given times and when conditions begin to hold (docs/control.md section 6).
//!
//! In: a file's text, then the time and the controller after each change. Out: the operations that are due, and the
//! next deadline. Does not execute them and does not know clocks.

mod file;

use std::collections::VecDeque;

use proto_core::time::{Duration, Instant};

use super::Controller;
use super::condition::Condition;
use super::operations::Operation;

/// A timeline that runs. Call [`Self::observe`] after each change of the controller, then [`Self::due`] until it
/// returns `None`, and again at [`Self::deadline`].
#[derive(Debug, Clone)]
pub struct Timeline {
    steps: Vec<TimelineStep>,
    /// The time of the first call.
    began: Option<Instant>,
}

#[derive(Debug, Clone)]
struct TimelineStep {
    trigger: StepTrigger,
    operation: Operation,
    /// When the step is due, earliest first.
    due: VecDeque<Instant>,
    /// When the step was last executed.
    done: Option<Instant>,
}

#[derive(Debug, Clone)]
enum StepTrigger {
    At(Duration),
    When {
        condition: Box<Condition>,
        after: Duration,
        repeat: bool,
        /// Whether the condition held at the last call.
        held: bool,
        /// Number of the first event that counts.
        since: u64,
    },
    /// The step was due and will not be again.
    Over,
}

impl Timeline {
    /// Records which conditions have begun to hold.
    pub fn observe(&mut self, now: Instant, controller: &Controller) {
        let began = *self.began.get_or_insert(now);
        for step in &mut self.steps {
            match &mut step.trigger {
                StepTrigger::At(time) => {
                    step.due.push_back(began + *time);
                    step.trigger = StepTrigger::Over;
                }
                StepTrigger::When { condition, after, repeat, held, since } => {
                    // A wrong condition was refused when the file was read.
                    let holds = controller.holds(condition, *since) == Ok(true);
                    if !std::mem::replace(held, holds) && holds {
                        if step.due.len() < MAX_DUE {
                            // Lets time pass after a step whose operation fulfils its own condition.
                            let again = step.done.map_or(now, |done| done + MIN_INTERVAL);
                            step.due.push_back((now + *after).max(again));
                        }
                        if condition.event.is_some() {
                            // The next such event fulfils it again.
                            (*since, *held) = (controller.newest_event() + 1, false);
                        }
                        if !*repeat {
                            step.trigger = StepTrigger::Over;
                        }
                    }
                }
                StepTrigger::Over => {}
            }
        }
    }

    /// The next operation that is due, in the order of the file, with the number of its step, from 1.
    pub fn due(&mut self, now: Instant) -> Option<(usize, Operation)> {
        let mut steps = self.steps.iter_mut().zip(1..);
        let (step, number) = steps.find(|(step, _)| step.due.front().is_some_and(|due| *due <= now))?;
        step.due.pop_front();
        step.done = Some(now);
        Some((number, step.operation.clone()))
    }

    /// When the next step is due; [`Instant::NEVER`] if none waits for a time.
    pub fn deadline(&self) -> Instant {
        let due = self.steps.iter().filter_map(|step| step.due.front());
        due.min().copied().unwrap_or(Instant::NEVER)
    }

    /// Number of steps.
    pub fn len(&self) -> usize {
        self.steps.len()
    }

    /// Whether there are no steps.
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }
}

/// Maximum number of pending times of a repeated step with `after_s`; further times are missed.
const MAX_DUE: usize = 1_000;
/// Minimum time between two executions of a step.
const MIN_INTERVAL: Duration = Duration::from_millis(1);

#[cfg(test)]
#[path = "timeline_tests.rs"]
mod tests;
