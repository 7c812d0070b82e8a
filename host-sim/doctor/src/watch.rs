//! Tracks when findings begin and end: a log gets two lines for each instead of one a second.

use proto_core::time::{Duration, Instant};

use crate::finding::{Cause, Finding, FindingPlace};

/// How long a finding must be absent to end. It begins when it is found twice in a row.
const GONE_FOR: Duration = Duration::from_secs(5);
/// Minimum time between two reports of the same place and cause.
const REPORT_AGAIN: Duration = Duration::from_secs(60);
/// Maximum number of known findings, more than a gateway has.
const MAX_KNOWN: usize = 256;

/// A change that is logged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// A finding has begun.
    Begins(Finding),
    /// A finding has ended.
    Ends {
        /// What the finding was about.
        place: FindingPlace,
        /// The cause of the finding.
        cause: Cause,
    },
}

/// Findings that have begun.
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

    /// Compares the findings of this instant with the earlier ones and returns the changes. To be called about once a
    /// second.
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
