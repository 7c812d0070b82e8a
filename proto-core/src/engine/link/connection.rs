//! What the links that are one connection each have in common. Their supervisor decides when the
//! connection is opened and given up; the command link, which has two, decides for both by itself.

use crate::engine::values::store::Store;
use crate::time::Instant;

pub(crate) trait Connection {
    /// The connection came up.
    fn opened(&mut self, store: &mut Store);

    /// The connection is gone, and with it what was under way.
    fn lost(&mut self, store: &mut Store);

    /// Bytes, or one datagram, from the controller. When the image is looked at after each frame, only
    /// the first frame is taken; the bytes behind it are left.
    fn received<'b>(&mut self, bytes: &'b [u8], store: &mut Store) -> &'b [u8];

    /// The transport took everything.
    fn sent(&mut self) {}

    /// The peer's transport has acknowledged all but `left` bytes.
    fn acked(&mut self, _left: u32, _store: &mut Store) {}

    /// Looks at the clock, the supervisor apart.
    fn advance(&mut self, _store: &mut Store) {}

    /// When it has something to do by itself, the supervisor apart.
    fn deadline(&self) -> Instant {
        Instant::NEVER
    }
}
