//! Results of commands, on their way from the link that sent or dropped them to the ports that picked them. Links do
//! not know ports, so the engine carries the results.

use heapless::Vec;

use super::stops::{COMMAND_QUEUE, MAX_STOPS, Waiting};
use crate::engine::io::{PortId, ReplyCode};

#[derive(Debug, Clone, Copy)]
pub(crate) struct Outcome {
    pub port: PortId,
    /// The number of the command among those of its port.
    pub nth: u32,
    /// [`ReplyCode::NotSent`] if it was dropped.
    pub code: ReplyCode,
}

/// All results that the engine has not carried yet, in order.
#[derive(Debug, Clone)]
pub(crate) struct Outcomes(Vec<Outcome, MOST>);

/// Every waiting command, and two in flight on each of the two connections.
const MOST: usize = COMMAND_QUEUE + MAX_STOPS + 4;

impl Outcomes {
    pub(crate) const fn new() -> Self {
        Self(Vec::new())
    }

    pub(crate) fn push(&mut self, command: Waiting, code: ReplyCode) {
        // Cannot fail: no command begins before the results of earlier ones are carried away.
        let _ = self.0.push(Outcome { port: command.port, nth: command.nth, code });
    }

    /// Takes all results in order.
    pub(crate) fn take(&mut self, mut tell: impl FnMut(Outcome)) {
        for &outcome in &self.0 {
            tell(outcome);
        }
        self.0.clear();
    }
}
