//! What links with one connection have in common. Their supervisor decides when to open the connection and when to give
//! it up; the command link has two connections and decides for both itself.

use crate::engine::values::store::Store;
use crate::time::Instant;

pub(crate) trait Connection {
    /// The connection came up.
    fn opened(&mut self, store: &mut Store);

    /// The connection is gone, and with it what was in flight.
    fn lost(&mut self, store: &mut Store);

    /// Takes bytes, or one datagram, from the controller. If the image has to be checked after each frame, only the
    /// first frame is taken, and the bytes after it are returned.
    fn received<'b>(&mut self, bytes: &'b [u8], store: &mut Store) -> &'b [u8];

    /// The transport has taken everything.
    fn sent(&mut self) {}

    /// The peer's transport has acknowledged all but `left` bytes.
    fn acked(&mut self, _left: u32, _store: &mut Store) {}

    /// Handles what is due, except in the supervisor.
    fn advance(&mut self, _store: &mut Store) {}

    /// When something is due without an input, except in the supervisor.
    fn deadline(&self) -> Instant {
        Instant::NEVER
    }
}
