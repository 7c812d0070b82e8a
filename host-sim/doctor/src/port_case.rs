//! A field port under examination.

use proto_core::config::{Port, Recipe};
use proto_core::engine::PortCounters;

use crate::finding::FindingPlace;
use crate::record::PortRecord;
use crate::{Case, state};

/// A port and its data within the window.
pub(crate) struct PortCase<'a> {
    pub(crate) case: &'a Case<'a>,
    pub(crate) port: &'a Port,
    pub(crate) recipe: &'a Recipe,
    pub(crate) place: FindingPlace,
    pub(crate) status: &'a state::ObservedPort,
    pub(crate) record: &'a PortRecord,
    /// Increments within the window.
    pub(crate) counters: PortCounters,
}
