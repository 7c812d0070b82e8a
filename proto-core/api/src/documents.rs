//! The documents `status` and `values` of a gateway, as JSON in pieces.
//!
//! In: a [`Status`] for each piece. Out: text. A piece is at most one port or one of its peers, one link, one
//! histogram, or [`VALUES_AT_ONCE`] variables, so a driver with little memory can send each piece before it makes the
//! next. Each piece may show a later instant than the one before; the document is well-formed all the same. Unknown
//! values are absent.

use core::fmt::{self, Write};

use proto_core::engine::Status;
use proto_core::sysvar::{COUNT, SysVar};
use serde::Serialize;

use crate::json::{self, JsonError};
use crate::number::Whole;

/// Number of variables in a piece.
pub const VALUES_AT_ONCE: usize = 32;

/// A document.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Document {
    /// Ports, links, the controller's states and latencies.
    Status,
    /// The known variables.
    Values,
}

/// A document that is being written.
#[derive(Debug, Clone)]
pub struct Pieces {
    next: DocumentStep,
}

#[derive(Debug, Clone, Copy)]
enum DocumentStep {
    Status,
    Port(usize),
    /// A peer of a port, both by index.
    Peer {
        port: usize,
        nth: usize,
    },
    Link(usize),
    Controller,
    Latency,
    Values,
    /// Variables from this place on. It is a place and not a count, so a variable that becomes known meanwhile moves no
    /// other.
    ValuesFrom {
        from: usize,
        is_first: bool,
    },
    End,
}

impl Pieces {
    /// Starts at the beginning of a document.
    pub const fn of(document: Document) -> Self {
        let next = match document {
            Document::Status => DocumentStep::Status,
            Document::Values => DocumentStep::Values,
        };
        Self { next }
    }

    /// Writes the next piece, which may be empty. Returns `false` if none is left.
    ///
    /// # Errors
    /// If `out` has no room. The document cannot be continued after that.
    pub fn write_next(&mut self, status: Status<'_>, out: &mut impl Write) -> Result<bool, JsonError> {
        self.next = match self.next {
            DocumentStep::Status => {
                let (time, sleeps) = (Whole(status.at().as_micros()), status.sleeps());
                let health = status.health().name();
                write!(out, "{{\"time_us\":{time},\"sleeps\":{sleeps},\"health\":\"{health}\",\"ports\":{{")?;
                DocumentStep::Port(0)
            }
            DocumentStep::Port(nth) => match status.ports().nth(nth) {
                Some(port) => {
                    let mut open = Open { out, is_end_held: false };
                    entry(&mut open, nth == 0, port.name, &port.without_peers())?;
                    match port.peers().next() {
                        Some(_) => {
                            out.write_str(",\"peers\":{")?;
                            DocumentStep::Peer { port: nth, nth: 0 }
                        }
                        None => {
                            out.write_char('}')?;
                            DocumentStep::Port(nth.saturating_add(1))
                        }
                    }
                }
                None => {
                    out.write_str("},\"links\":{")?;
                    DocumentStep::Link(0)
                }
            },
            DocumentStep::Peer { port, nth } => {
                let peer = status.ports().nth(port).and_then(|port| port.peers().nth(nth));
                match peer {
                    Some(peer) => {
                        entry(out, nth == 0, peer.number, &peer)?;
                        DocumentStep::Peer { port, nth: nth.saturating_add(1) }
                    }
                    None => {
                        out.write_str("}}")?;
                        DocumentStep::Port(port.saturating_add(1))
                    }
                }
            }
            DocumentStep::Link(nth) => match status.links().nth(nth) {
                Some(link) => {
                    entry(out, nth == 0, link.name, &link)?;
                    DocumentStep::Link(nth.saturating_add(1))
                }
                None => {
                    out.write_char('}')?;
                    DocumentStep::Controller
                }
            },
            DocumentStep::Controller => {
                if let Some(controller) = status.controller() {
                    out.write_char(',')?;
                    entry(out, true, "controller", &controller)?;
                }
                DocumentStep::Latency
            }
            DocumentStep::Latency => {
                out.write_char(',')?;
                entry(out, true, "latency", status.latency())?;
                out.write_char('}')?;
                DocumentStep::End
            }
            DocumentStep::Values => {
                write!(out, "{{\"time_us\":{},\"values\":{{", Whole(status.at().as_micros()))?;
                DocumentStep::ValuesFrom { from: 0, is_first: true }
            }
            DocumentStep::ValuesFrom { from, mut is_first } => {
                let to = from.saturating_add(VALUES_AT_ONCE);
                let here =
                    status.variables().filter(|known| (from..to).contains(&place(known.var, known.bit)));
                for known in here {
                    entry(out, is_first, known.name(), &known)?;
                    is_first = false;
                }
                match to < PLACES {
                    true => DocumentStep::ValuesFrom { from: to, is_first },
                    false => {
                        out.write_str("}}")?;
                        DocumentStep::End
                    }
                }
            }
            DocumentStep::End => return Ok(false),
        };
        Ok(true)
    }

    /// Writes the whole document from one status.
    pub fn write_all(mut self, status: Status<'_>, out: &mut impl Write) -> Result<(), JsonError> {
        while self.write_next(status, out)? {}
        Ok(())
    }
}

/// Omits the closing brace of an object, so more entries can be added.
struct Open<'w, W> {
    out: &'w mut W,
    is_end_held: bool,
}

impl<W: Write> Write for Open<'_, W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        if text.is_empty() {
            return Ok(());
        }
        if core::mem::take(&mut self.is_end_held) {
            self.out.write_char('}')?;
        }
        match text.strip_suffix('}') {
            Some(rest) => {
                self.is_end_held = true;
                self.out.write_str(rest)
            }
            None => self.out.write_str(text),
        }
    }
}

/// The place of a variable, or of one of its bits; bits come after all variables.
fn place(var: SysVar, bit: Option<u8>) -> usize {
    match bit {
        None => var.ordinal(),
        Some(bit) => var.ordinal().saturating_mul(8).saturating_add(bit.into()).saturating_add(COUNT),
    }
}

const PLACES: usize = COUNT * 9;

fn entry(
    out: &mut impl Write,
    is_first: bool,
    key: impl fmt::Display,
    value: &impl Serialize,
) -> Result<(), JsonError> {
    if !is_first {
        out.write_char(',')?;
    }
    json::write_text(out, key)?;
    out.write_char(':')?;
    json::write(out, value)
}
