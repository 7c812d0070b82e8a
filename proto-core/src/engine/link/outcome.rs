//! What became of commands, on its way from the link that sent or dropped them to the ports that
//! picked them: links know no ports, so the engine carries it.

use heapless::Vec;

use super::stops::{COMMAND_QUEUE, MAX_STOPS, Waiting};
use crate::engine::io::{PortId, ReplyCode};

/// One command's end.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Outcome {
    pub port: PortId,
    /// How many commands the port had picked with it.
    pub nth: u32,
    /// [`ReplyCode::NotSent`] of one that was dropped.
    pub code: ReplyCode,
}

/// All ends since the engine carried the last ones away, in order.
#[derive(Debug, Clone)]
pub(crate) struct Outcomes(Vec<Outcome, MOST>);

/// Every command that waits, and two under way on each of the two connections.
const MOST: usize = COMMAND_QUEUE + MAX_STOPS + 4;

impl Outcomes {
    pub(crate) const fn new() -> Self {
        Self(Vec::new())
    }

    pub(crate) fn push(&mut self, command: Waiting, code: ReplyCode) {
        // There is room: no command begins before the ends of those before it are carried away.
        let _ = self.0.push(Outcome { port: command.port, nth: command.nth, code });
    }

    /// Hands over all of them, in order.
    pub(crate) fn take(&mut self, mut tell: impl FnMut(Outcome)) {
        for &outcome in &self.0 {
            tell(outcome);
        }
        self.0.clear();
    }
}
