//! Modbus TCP on a port: the header before each request, and which request a reply belongs to (docs/engine.md section
//! 13).
//!
//! In: requests without a header, and received bytes. Out: frames, and their exchanges. A reply belongs to the request
//! with its transaction id, so nothing has to wait for late replies here.

use crate::device::Probe;
use crate::modbus::adu::{PREFIX_LEN, frame_len};
use crate::modbus::rtu::CRC_LEN;

/// Number of newest requests whose replies are recognized when late. Replies to older ones belong to no exchange.
const KEPT: usize = 4;

/// Marks an answered request. No exchange has this index: a port has fewer.
const ANSWERED: u8 = u8::MAX;

#[derive(Debug, Clone)]
pub(crate) struct Transactions {
    /// The id of the newest request. It continues over reconnects, and wraps.
    pub newest: u16,
    /// The newest requests with their exchanges, in the slot of their id; [`ANSWERED`] after a reply.
    unanswered: [(u16, u8); KEPT],
    /// There was a connection before.
    pub was_open: bool,
    /// Frames can no longer be found: the connection has to be closed.
    pub is_lost: bool,
}

impl Transactions {
    pub(crate) const fn new() -> Self {
        Self { newest: 0, unanswered: [(0, ANSWERED); KEPT], was_open: false, is_lost: false }
    }

    /// The connection is gone; no reply comes over another one.
    pub(crate) const fn forget(&mut self) {
        self.unanswered = [(0, ANSWERED); KEPT];
        self.is_lost = false;
    }

    /// Puts the header before an exchange's request, an RTU frame that stands after the room for the header. Returns
    /// the total length.
    pub(crate) fn begin(&mut self, exchange: u8, len: usize, out: &mut [u8]) -> Option<usize> {
        self.newest = self.newest.wrapping_add(1);
        let ([t1, t0], len) = (self.newest.to_be_bytes(), len.saturating_sub(CRC_LEN));
        // At most 255, since a PDU has at most 253 bytes.
        let [l1, l0] = (len as u16).to_be_bytes();
        *out.first_chunk_mut()? = [t1, t0, 0, 0, l1, l0];
        if let Some(slot) = self.unanswered.get_mut(slot_of(self.newest)) {
            *slot = (self.newest, exchange);
        }
        Some(len.saturating_add(PREFIX_LEN))
    }

    /// The exchange of an unanswered request, which is answered now.
    pub(crate) fn take(&mut self, id: u16) -> Option<u8> {
        let (_, exchange) = self.unanswered.get_mut(slot_of(id)).filter(|(of, _)| *of == id)?;
        Some(core::mem::replace(exchange, ANSWERED)).filter(|exchange| *exchange != ANSWERED)
    }
}

fn slot_of(id: u16) -> usize {
    usize::from(id) % KEPT
}

/// Matches the start of a connection's bytes. After a wrong header no frame can be found: [`Probe::Other`].
pub(crate) fn probe(bytes: &[u8]) -> Probe {
    let Some(prefix) = bytes.first_chunk() else {
        return Probe::Partial(PREFIX_LEN.saturating_sub(bytes.len()));
    };
    match frame_len(prefix) {
        Ok(len) if len <= bytes.len() => Probe::Frame(len),
        Ok(len) => Probe::Partial(len.saturating_sub(bytes.len())),
        Err(_) => Probe::Other(bytes.len()),
    }
}

/// The data of a good reply, and the code of a refusal.
pub(crate) fn content(frame: &[u8]) -> (&[u8], Option<u8>) {
    let body = frame.get(PREFIX_LEN..).unwrap_or(&[]);
    (body.get(3..).unwrap_or(&[]), body.get(2).copied())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_wrap_and_name_the_exchange_of_each_request() {
        let mut all = Transactions::new();
        for nth in 1..=70_000_u32 {
            let mut out = [0; 14];
            let exchange = (nth % 32) as u8;
            assert_eq!(all.begin(exchange, 8, &mut out), Some(12));
            let [t1, t0] = (nth as u16).to_be_bytes();
            assert_eq!(out[..6], [t1, t0, 0, 0, 0, 6]);
            // Every third is answered, in any order.
            if nth % 3 == 0 {
                let id = nth.wrapping_sub(2) as u16;
                assert_eq!(all.take(id), Some((nth.wrapping_sub(2) % 32) as u8));
                assert_eq!(all.take(id), None, "once");
            }
        }
        assert_eq!(all.take(0x1234), None);
        let newest = 70_000_u32 as u16;
        assert_eq!(all.take(newest.wrapping_sub(KEPT as u16)), None, "forgotten");
        all.forget();
        assert_eq!(all.take(newest), None, "of another connection");
    }

    #[test]
    fn a_wrong_header_is_known_from_six_bytes() {
        assert_eq!(probe(&[0, 1, 0, 0]), Probe::Partial(2));
        assert_eq!(probe(&[0, 1, 0, 0, 0, 5, 3]), Probe::Partial(4));
        assert_eq!(probe(&[0, 1, 0, 0, 0, 3, 3, 0x83, 2, 9]), Probe::Frame(9));
        for wrong in [[0, 1, 1, 0, 0, 5], [0, 1, 0, 1, 0, 5], [0, 1, 0, 0, 0, 1], [0, 1, 0, 0, 1, 0]] {
            assert_eq!(probe(&wrong), Probe::Other(6), "{wrong:?}");
        }
    }
}
