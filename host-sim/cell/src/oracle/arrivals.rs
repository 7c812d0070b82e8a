//! What the controller receives, and its effect on the controller's inputs.

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::bits::Coils;
use super::field::LineWatch;
use super::spec::{Frame, Raw, written};
use super::wire::Asked;
use super::{Invariant, Oracle};

impl Oracle {
    /// The controller has received bytes on a connection, which changed its inputs from `before` to
    /// `after`.
    pub(crate) fn arrived(
        &mut self,
        conn: u64,
        link: LinkId,
        bytes: &[u8],
        (before, after): (&[u8], &[u8]),
        slowest: Duration,
        now: Instant,
    ) {
        let result = self.controller.arrived(conn, bytes);
        self.judge(now, &[Invariant::Transport], result);
        self.delivered(conn, bytes.len(), slowest, now);
        self.robot.applied(before, after, now);
        let mut expected = before.to_vec();
        match link {
            LinkId::MODBUS => {
                for pdu in self.controller.requests(conn, bytes) {
                    match self.map.request(&pdu) {
                        Some(Asked::Write(values)) => put_all(&mut expected, &values),
                        Some(Asked::WriteBits(Coils { var, mask, on })) => {
                            let byte = &mut expected[var.image_offset()];
                            *byte = *byte & !mask | on;
                        }
                        _ => {}
                    }
                }
            }
            LinkId::COMMAND | LinkId::URGENT | LinkId::STATE => {}
            _ => {
                let Some(frame) = self.spec.link(link).and_then(|link| link.input.clone()) else { return };
                let mut held = std::mem::take(self.controller.held(conn));
                held.extend_from_slice(bytes);
                let mut line = LineWatch { held, ..LineWatch::default() };
                for payload in line.cut(&frame) {
                    put_all(&mut expected, &values_of(&frame, &payload));
                }
                *self.controller.held(conn) = line.held;
            }
        }
        self.registers(before, &expected, after, now);
    }

    /// Same, for a datagram.
    pub(crate) fn arrived_datagram(
        &mut self,
        link: LinkId,
        tag: u64,
        bytes: &[u8],
        (before, after): (&[u8], &[u8]),
        slowest: Duration,
        now: Instant,
    ) {
        let result = self.controller.arrived_datagram(u64::from(link.0), bytes);
        self.judge(now, &[Invariant::Transport], result);
        self.datagram_delivered(tag, slowest, now);
        self.robot.applied(before, after, now);
        let mut expected = before.to_vec();
        if let Some(frame) = self.spec.link(link).and_then(|link| link.input.as_ref())
            && let Some(payload) = frame.payload_of(bytes)
        {
            put_all(&mut expected, &values_of(frame, payload));
        }
        self.registers(before, &expected, after, now);
    }

    /// A write is applied as a whole or, if the controller refuses it, not at all.
    fn registers(&mut self, before: &[u8], expected: &[u8], after: &[u8], now: Instant) {
        let result = if after == expected || after == before {
            Ok(())
        } else {
            Err((Invariant::Registers, "the controller's inputs are not the values written".to_owned()))
        };
        self.judge(now, &[Invariant::Registers], result);
    }
}

fn values_of(frame: &Frame, payload: &[u8]) -> Vec<(SysVar, Raw)> {
    let mut rest = payload;
    let vars = frame.fields.iter().flat_map(written);
    let values = vars.map(|var| {
        let (bytes, after) = rest.split_at(var.size());
        rest = after;
        let mut raw = Raw::default();
        raw[..bytes.len()].copy_from_slice(bytes);
        (var, raw)
    });
    values.collect()
}

fn put_all(image: &mut [u8], values: &[(SysVar, Raw)]) {
    for (var, raw) in values {
        let at = var.image_offset();
        let mask = if var.is_bits() { var.valid_bits() } else { 0xFF };
        for (place, byte) in image[at..at + var.size()].iter_mut().zip(raw) {
            *place = byte & mask;
        }
    }
}
