//! What the session needs of a gateway, of any kind.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use tempfile::TempDir;

/// A gateway with one panel at its port `device`, and its controller.
pub(crate) trait Target {
    /// The folder of the session: files and the key `key` are there.
    fn folder(&self) -> &TempDir;

    /// The text of a configuration of this gateway. `timeout_ms` tells revisions apart.
    fn config(&self, timeout_ms: u32) -> String;

    /// Starts it with what it keeps, or with this file if it has never run.
    fn start(&mut self, file: &Path);

    /// Whether it knows the names of frames and fields.
    fn has_names(&self) -> bool {
        true
    }

    /// Gives it the key of the session, if it takes one while it runs.
    fn claim(&mut self) {}

    /// Ends it at once, in the middle of whatever it does.
    fn kill(&mut self);

    /// Where its API is, while it runs.
    fn address(&self) -> SocketAddr;

    /// The address that it knows itself by, if it is another one.
    fn host(&self) -> Option<&'static str> {
        None
    }

    /// A trial that nobody will confirm, in seconds.
    fn short_trial_s(&self) -> u32 {
        1
    }

    /// Longer than a push takes, from the start of the program that asks for it.
    fn push_takes(&self) -> Duration {
        Duration::from_millis(40)
    }

    /// Connects the panel, which from now on sends its frame again and again.
    fn plug(&mut self);

    /// Takes the panel away.
    fn pull(&mut self);
}
