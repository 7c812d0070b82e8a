//! Splits a connection's bytes into packets (docs/wire/state.md section 3, D8).
//!
//! In: bytes in chunks of any size, from the connection's first byte on. Out: packets, each checked for alignment,
//! alone and against earlier ones. Does not search for the beginning of a packet, because the stream has no mark. The
//! owner of the connection reopens it if [`StateStream::is_lost`].

use super::alignment::{Earlier, Misaligned};
use super::view::{LEN, StateView};
use crate::wire::runs::copy_long;

/// After this many misaligned packets in a row the connection must be reopened.
pub const MAX_MISALIGNED: u32 = 3;

/// One connection to port 2001.
#[derive(Debug, Clone)]
pub struct StateStream {
    buffer: [u8; LEN],
    /// Number of held bytes of an incomplete packet; [`LEN`] after a packet was completed and returned.
    len: usize,
    packets: u32,
    misaligned: u32,
    in_a_row: u32,
    earlier: Earlier,
}

impl StateStream {
    /// A stream before its first byte.
    pub const fn new() -> Self {
        Self { buffer: [0; LEN], len: 0, packets: 0, misaligned: 0, in_a_row: 0, earlier: Earlier::NONE }
    }

    /// Takes bytes from the front of `chunk` until a packet is complete. `None` if all of `chunk` is taken and no
    /// packet is complete.
    ///
    /// A packet that is complete in `chunk` is not copied.
    pub fn next_packet<'s, 'c: 's>(
        &'s mut self,
        chunk: &mut &'c [u8],
    ) -> Option<Result<StateView<'s>, Misaligned>> {
        if self.len >= LEN {
            self.len = 0;
        }
        let view = match chunk.split_first_chunk() {
            Some((whole, rest)) if self.len == 0 => {
                *chunk = rest;
                StateView::from_array(whole)
            }
            _ => {
                let room = self.buffer.get_mut(self.len..).unwrap_or(&mut []);
                let count = room.len().min(chunk.len());
                let (taken, rest) = chunk.split_at_checked(count)?;
                copy_long(room.get_mut(..count)?, taken);
                *chunk = rest;
                self.len = self.len.saturating_add(count);
                if self.len < LEN {
                    return None;
                }
                StateView::from_array(&self.buffer)
            }
        };
        match self.earlier.check(view.as_bytes()) {
            Ok(()) => {
                self.packets = self.packets.wrapping_add(1);
                self.in_a_row = 0;
                Some(Ok(view))
            }
            Err(misaligned) => {
                self.misaligned = self.misaligned.wrapping_add(1);
                self.in_a_row = self.in_a_row.saturating_add(1);
                Some(Err(misaligned))
            }
        }
    }

    /// Takes bytes that do not complete a packet. Returns `false`, with nothing taken, if they do, or if there are
    /// none.
    pub(crate) fn hold(&mut self, chunk: &[u8]) -> bool {
        let held = self.pending();
        let end = held.saturating_add(chunk.len());
        if end >= LEN || chunk.is_empty() {
            return false;
        }
        let Some(room) = self.buffer.get_mut(held..end) else { return false };
        copy_long(room, chunk);
        self.len = end;
        true
    }

    /// Misaligned packets since the last good one.
    pub const fn misaligned_in_a_row(&self) -> u32 {
        self.in_a_row
    }

    /// Whether the connection must be closed and reopened.
    pub const fn is_lost(&self) -> bool {
        self.in_a_row >= MAX_MISALIGNED
    }

    /// Number of good packets, over all connections, wrapping.
    pub const fn packets(&self) -> u32 {
        self.packets
    }

    /// Number of misaligned packets, over all connections, wrapping.
    pub const fn misaligned(&self) -> u32 {
        self.misaligned
    }

    /// Number of held bytes of an incomplete packet.
    pub const fn pending(&self) -> usize {
        if self.len < LEN { self.len } else { 0 }
    }

    /// Drops an incomplete packet and what earlier packets showed, for a new connection; the counters stay.
    pub const fn reset(&mut self) {
        self.len = 0;
        self.in_a_row = 0;
        self.earlier = Earlier::NONE;
    }
}

impl Default for StateStream {
    fn default() -> Self {
        Self::new()
    }
}
