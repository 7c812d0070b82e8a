//! When findings begin and end, so that a log has two lines for each and not one a second.

use proto_core::time::{Duration, Instant};

use crate::finding::{Cause, Finding, FindingPlace};

/// A finding is reported once it was found twice in a row, and its end once it was absent for this long.
const GONE_FOR: Duration = Duration::from_secs(5);
/// Minimum time between two reports of the same place and cause.
const REPORT_AGAIN: Duration = Duration::from_secs(60);
/// More kinds of findings than a gateway has.
const MAX_KNOWN: usize = 256;

/// A change that is worth a line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// A finding has begun.
    Begins(Finding),
    /// It is over.
    Ends {
        /// What it was about.
        place: FindingPlace,
        /// Its cause.
        cause: Cause,
    },
}

/// The findings so far.
#[derive(Debug, Default)]
pub struct Watch {
    known: Vec<Known>,
}

#[derive(Debug)]
struct Known {
    place: FindingPlace,
    cause: Cause,
    first_at: Instant,
    newest_at: Instant,
    reported_at: Option<Instant>,
    is_reported: bool,
}

impl Watch {
    /// No findings yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes the findings of this instant; returns what has changed. To be called about once a second.
    pub fn update(&mut self, now: Instant, findings: &[Finding]) -> Vec<Change> {
        let mut changes = Vec::new();
        for finding in findings {
            let is_same = |known: &&mut Known| known.place == finding.place && known.cause == finding.cause;
            let Some(known) = self.known.iter_mut().find(is_same) else {
                if self.known.len() < MAX_KNOWN {
                    self.known.push(Known {
                        place: finding.place.clone(),
                        cause: finding.cause,
                        first_at: now,
                        newest_at: now,
                        reported_at: None,
                        is_reported: false,
                    });
                }
                continue;
            };
            if now.saturating_since(known.newest_at) >= GONE_FOR {
                known.first_at = now;
            }
            known.newest_at = now;
            let may_report = known.reported_at.is_none_or(|at| now.saturating_since(at) >= REPORT_AGAIN);
            if !known.is_reported && known.first_at < now && may_report {
                (known.is_reported, known.reported_at) = (true, Some(now));
                changes.push(Change::Begins(finding.clone()));
            }
        }
        for known in &mut self.known {
            if known.is_reported && now.saturating_since(known.newest_at) >= GONE_FOR {
                known.is_reported = false;
                changes.push(Change::Ends { place: known.place.clone(), cause: known.cause });
            }
        }
        self.known.retain(|known| now.saturating_since(known.newest_at) < REPORT_AGAIN);
        changes
    }
}
