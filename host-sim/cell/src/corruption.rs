//! Gateways with faults: inputs and outputs of the engine are changed on their way, and the model has to report it.

use proto_core::engine::{Endpoint, Input, LinkId, Output, PortId, Transport};
use proto_core::time::Instant;

use super::Cell;

/// An output that replaces one of the engine's.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Forged {
    Link(LinkId, Vec<u8>),
    Port(PortId, Vec<u8>),
    Open(LinkId),
}

/// Returns bytes for the engine that replace those of the input. `None` leaves the input unchanged.
pub(super) type Inward = Box<dyn FnMut(Instant, &Input<'_>) -> Option<Vec<u8>>>;
/// Returns outputs that replace an output, or precede a `Sleep`. `None` leaves the output unchanged.
pub(super) type Outward = Box<dyn FnMut(Instant, &Input<'_>, &Output<'_>) -> Option<Vec<Forged>>>;

/// The changes to inputs and outputs.
pub(super) struct Corruption {
    pub inward: Inward,
    pub outward: Outward,
}

impl std::fmt::Debug for Corruption {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Corruption")
    }
}

impl Forged {
    pub(super) fn as_output(&self) -> Output<'_> {
        match self {
            Self::Link(link, bytes) => Output::LinkSend { link: *link, bytes },
            Self::Port(port, bytes) => Output::PortSend { port: *port, bytes },
            Self::Open(link) => {
                Output::LinkOpen { link: *link, to: Endpoint::new(Transport::Tcp { port: 0 }, "") }
            }
        }
    }
}

impl Cell {
    /// Changes inputs and outputs from now on.
    pub(super) fn corrupt(&mut self, inward: Option<Inward>, outward: Option<Outward>) {
        self.corruption = Some(Corruption {
            inward: inward.unwrap_or_else(|| Box::new(|_, _| None)),
            outward: outward.unwrap_or_else(|| Box::new(|_, _, _| None)),
        });
    }

    pub(super) fn forged_input(&mut self, input: &Input<'_>) -> Option<Vec<u8>> {
        let now = self.now;
        self.corruption.as_mut().and_then(|corruption| (corruption.inward)(now, input))
    }

    pub(super) fn forged_outputs(&mut self, input: &Input<'_>, output: &Output<'_>) -> Option<Vec<Forged>> {
        let now = self.now;
        self.corruption.as_mut().and_then(|corruption| (corruption.outward)(now, input, output))
    }
}

/// The same input with other bytes.
pub(super) fn instead<'a>(input: &Input<'a>, bytes: Option<&'a [u8]>) -> Input<'a> {
    match (*input, bytes) {
        (Input::PortBytes { port, .. }, Some(bytes)) => Input::PortBytes { port, bytes },
        (Input::LinkBytes { link, .. }, Some(bytes)) => Input::LinkBytes { link, bytes },
        (input, _) => input,
    }
}
