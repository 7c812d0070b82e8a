//! The document `edge`: status and settings of the edge node (docs/api.md section 10).

use core::fmt::{self, Write};

use recipe_api::json;
use recipe_api::response::{ContentType, StatusCode};
use recipe_sparkplug::document::{DocumentError, NodeDocument};

use super::Console;
use super::answer::{Reply, TextBuffer, busy};
use super::arguments::ConsoleRequest;
use crate::fmt::DisplayText;
use crate::tasks::edge::View;
use crate::tasks::store::{StoreLock, StoreRequest};
use crate::warn;

impl Console {
    /// Reply with the document and this status.
    #[inline(never)]
    pub(super) fn edge(&self, buf: &mut [u8], status: StatusCode) -> Reply {
        Reply::new(buf, status, ContentType::Json, |out| self.write_edge(out))
    }

    fn write_edge(&self, out: &mut TextBuffer<'_>) -> fmt::Result {
        let node = &self.node;
        let state = match node.edge.view() {
            View::Off => "off",
            View::Cannot(_) => "cannot",
            View::Runs(session) if session.is_online => "online",
            View::Runs(_) => "offline",
        };
        write!(out, "{{\"state\":\"{state}\"")?;
        match node.edge.view() {
            View::Off => {}
            View::Cannot(why) => write_why(out, &why)?,
            View::Runs(session) => {
                if let Some(failure) = session.failure {
                    write_why(out, &failure)?;
                }
                if let Some(document) = node.document {
                    out.write_str(",\"broker\":")?;
                    json::write_text(out, format_args!("{}:{}", document.host, document.port))?;
                    for (name, id) in [("group", &document.settings.group), ("node", &document.settings.node)]
                    {
                        write!(out, ",\"{name}\":")?;
                        json::write_text(out, id.as_str())?;
                    }
                    if let Some((server, port)) = &document.time_server {
                        out.write_str(",\"time_server\":")?;
                        json::write_text(out, format_args!("{server}:{port}"))?;
                    }
                }
                write!(out, ",\"utc\":{}", node.clock.is_known())?;
                if let Some(bd_seq) = session.bd_seq {
                    write!(out, ",\"bd_seq\":{bd_seq}")?;
                }
                write!(out, ",\"metrics\":{},\"counters\":{{", session.metrics)?;
                let counters = session.counters;
                let all = [
                    ("sessions", counters.sessions.into()),
                    ("births", counters.births.into()),
                    ("rebirths", counters.rebirths.into()),
                    ("data", counters.data),
                    ("historical", counters.historical),
                    ("lost", counters.lost),
                    ("kept", counters.kept as u64),
                    ("refused", counters.refused.into()),
                    ("unreadable", counters.unreadable.into()),
                    ("failures", counters.failures.into()),
                    ("left_out", counters.left_out.into()),
                ];
                for (nth, (name, count)) in all.into_iter().enumerate() {
                    let comma = if nth == 0 { "" } else { "," };
                    write!(out, "{comma}\"{name}\":{count}")?;
                }
                out.write_char('}')?;
            }
        }
        if let Some(publishes) = node.edge.next() {
            write!(out, ",\"next\":\"{}\"", if publishes { "other" } else { "off" })?;
        }
        out.write_char('}')
    }

    /// Reply after settings were stored.
    pub(super) fn edge_stored(
        &self,
        buf: &mut [u8],
        peer: core::net::Ipv4Addr,
        publishes: bool,
        restart: bool,
    ) -> Reply {
        self.node.edge.set_next(publishes);
        warn!("{} has changed the settings of the edge node", DisplayText(&peer));
        self.edge(buf, if restart { StatusCode::ACCEPTED } else { StatusCode::OK })
    }
}

/// The request that stores the settings that were sent, or the reply if they are refused.
#[inline(never)]
pub(super) fn settings<'a>(
    buf: &mut [u8],
    request: ConsoleRequest<'a>,
) -> Result<(StoreRequest, StoreLock<'a>), Reply> {
    let restart = match request.head.yes {
        None => false,
        Some(true) => true,
        Some(false) => {
            return Err(Reply::error(buf, StatusCode::BAD_REQUEST, "restart is out of range; allowed: yes"));
        }
    };
    let Some((len, lock)) = request.image else { return Err(busy(buf)) };
    match lock.look(len, read) {
        Ok(publishes) => Ok((StoreRequest::Edge { len, publishes, restart }, lock)),
        Err(error) => Err(Reply::error(buf, StatusCode::UNPROCESSABLE, error)),
    }
}

/// Not inlined, to free its stack frame before the request to the store task.
#[inline(never)]
fn read(bytes: &[u8]) -> Result<bool, DocumentError> {
    NodeDocument::empty().decode(bytes)
}

fn write_why(out: &mut TextBuffer<'_>, why: &dyn fmt::Display) -> fmt::Result {
    out.write_str(",\"why\":")?;
    json::write_text(out, why)
}
