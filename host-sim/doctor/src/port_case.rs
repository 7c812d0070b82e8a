//! A field port under examination.

use proto_core::config::{Port, Recipe};
use proto_core::engine::PortCounters;

use crate::finding::{Cause, Finding, FindingPlace, Severity, finding};
use crate::record::PortRecord;
use crate::{Case, state};

/// A port and what was seen of it in the window.
pub(crate) struct PortCase<'a> {
    pub(crate) case: &'a Case<'a>,
    pub(crate) port: &'a Port,
    pub(crate) recipe: &'a Recipe,
    pub(crate) place: FindingPlace,
    pub(crate) status: &'a state::ObservedPort,
    pub(crate) record: &'a PortRecord,
    /// Counted within the window.
    pub(crate) counters: PortCounters,
}

impl PortCase<'_> {
    pub(crate) fn found(
        &self,
        severity: Severity,
        cause: Cause,
        seen: impl Into<String>,
        expected: impl Into<String>,
        likely: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        finding((severity, &self.place, cause), seen, expected, likely, remedy)
    }

    pub(crate) fn fault(
        &self,
        cause: Cause,
        seen: impl Into<String>,
        expected: impl Into<String>,
        likely: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        self.found(Severity::Fault, cause, seen, expected, likely, remedy)
    }

    pub(crate) fn warning(
        &self,
        cause: Cause,
        seen: impl Into<String>,
        expected: impl Into<String>,
        likely: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Finding {
        self.found(Severity::Warning, cause, seen, expected, likely, remedy)
    }
}
