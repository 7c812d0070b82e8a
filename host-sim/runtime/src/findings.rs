//! What is shared about findings: their newest texts, and the controller's states behind a failed command.

use std::net::{TcpStream, ToSocketAddrs};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use proto_core::config::ControllerLink;
use proto_core::engine::{ReplyCode, Status};
use proto_core::time::Instant;
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::{StateStream, States};
use recipe_doctor::Finding;
use serde_json::{Value, json};

/// Texts of the newest findings of a running gateway. Clones share them.
#[derive(Debug, Clone, Default)]
pub(crate) struct FindingTexts(Arc<Mutex<Vec<String>>>);

impl FindingTexts {
    pub(crate) fn to_json(&self) -> Value {
        json!(*self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub(crate) fn replace(&self, findings: &[Finding]) {
        let texts = findings.iter().map(Finding::to_string).collect();
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = texts;
    }
}

/// When the newest command failed for a reason that the state stream did not show.
pub(crate) fn unexplained(status: Status<'_>) -> Option<Instant> {
    let failed = status.ports().filter(|port| port.reply == ReplyCode::Fail);
    let failed = failed.filter_map(|port| port.last_failed);
    failed.filter(|failed| failed.controller.is_none()).map(|failed| failed.at).max()
}

/// Reads the controller's states from one packet of its state stream. Sends nothing.
pub(crate) fn look_at_states(controller: &ControllerLink) -> Option<States> {
    let dialect = Dialect::named(&controller.dialect)?;
    let place = (controller.address.as_str(), controller.state_port).to_socket_addrs().ok()?.next()?;
    let mut connection = TcpStream::connect_timeout(&place, MAX_LOOK).ok()?;
    connection.set_read_timeout(Some(MAX_LOOK)).ok()?;
    let (mut stream, mut chunk) = (StateStream::new(), [0; 2048]);
    for _ in 0..MAX_READS {
        let len = std::io::Read::read(&mut connection, &mut chunk).ok().filter(|len| *len > 0)?;
        let mut rest = &chunk[..len];
        while let Some(packet) = stream.next_packet(&mut rest) {
            if let Ok(view) = packet {
                return Some(view.states(&dialect));
            }
        }
    }
    None
}

/// How long a connection and a packet of the state stream may take.
const MAX_LOOK: Duration = Duration::from_secs(1);
/// More reads than a few packets need.
const MAX_READS: usize = 16;
