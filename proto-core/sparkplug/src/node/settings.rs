//! What a node is called, and how it speaks to its server.

use core::fmt;

use heapless::String;
use proto_core::time::Duration;

use crate::topic::{Id, MAX_ID};

/// The longest name of a user or a client, and the longest password, in bytes.
pub const MAX_TEXT: usize = 129;

/// A name or a password. It is never printed.
#[derive(Clone, PartialEq, Eq, Default)]
pub struct Credential(String<MAX_TEXT>);

impl Credential {
    /// A text; `None` if it is longer than [`MAX_TEXT`].
    pub fn new(text: &str) -> Option<Self> {
        String::try_from(text).ok().map(Self)
    }

    /// The text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Credential {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Text(..)")
    }
}

/// What a node is called, and how it speaks to its server.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Settings {
    /// Its group.
    pub group: Id,
    /// Its name, unique in the group.
    pub node: Id,
    /// The host application without which nothing is told; `None` if it is told in any case.
    pub primary_host: Option<Id>,
    /// Its name for the server, which no other client may have.
    pub client_id: Credential,
    /// The user and the password.
    pub login: Option<(Credential, Credential)>,
    /// After one and a half times this without a packet the server says that the node is dead; whole seconds,
    /// 5 s to 18 h.
    pub keep_alive: Duration,
}

impl Settings {
    /// Of a node that is not made yet; all its bytes are zero.
    pub(crate) const fn empty() -> Self {
        Self {
            group: Id::empty(),
            node: Id::empty(),
            primary_host: None,
            client_id: Credential(String::new()),
            login: None,
            keep_alive: Duration::ZERO,
        }
    }

    /// A node without a password or a primary host, with a keep-alive of 30 s; for its server it is called
    /// `group/node`.
    pub fn new(group: Id, node: Id) -> Self {
        let mut client_id = String::new();
        let _ = client_id.push_str(group.as_str());
        let _ = client_id.push('/');
        let _ = client_id.push_str(node.as_str());
        let keep_alive = Duration::from_secs(30);
        Self { group, node, primary_host: None, client_id: Credential(client_id), login: None, keep_alive }
    }

    /// The keep-alive as CONNECT has it: seconds.
    pub(super) fn keep_alive_s(&self) -> u16 {
        let seconds = self.keep_alive.as_millis() / 1_000;
        u16::try_from(seconds).unwrap_or(u16::MAX).max(5)
    }

    /// The time between two signs of life, and for the server's answer.
    pub(super) fn ping_interval(&self) -> Duration {
        Duration::from_millis(u64::from(self.keep_alive_s()).saturating_mul(500))
    }
}

const _: () = assert!(MAX_TEXT > 2 * MAX_ID);
