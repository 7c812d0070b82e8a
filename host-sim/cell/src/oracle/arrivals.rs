//! What the controller receives, and its effect on the controller's inputs.

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::field::{Coils, Cut};
use super::frame::{Frame, Raw};
use super::wire::{Asked, Inputs};
use super::{Invariant, Oracle};

impl Oracle {
    /// The controller has received bytes on a connection, which changed its inputs from `before` to `after`.
    pub(crate) fn arrived(
        &mut self,
        conn: u64,
        link: LinkId,
        bytes: &[u8],
        (before, after): (&Inputs, &[u8]),
        slowest: Duration,
        now: Instant,
    ) {
        let result = self.controller.arrived(conn, bytes);
        self.judge(now, &[Invariant::Transport], result);
        self.delivered(conn, bytes.len(), slowest, now);
        self.robot.applied(before, after, now);
        let mut expected = None;
        match link {
            LinkId::MODBUS => {
                let Self { controller, map, .. } = self;
                controller.requests(conn, bytes, |pdu| match map.request(pdu) {
                    Some(Asked::Write(values)) => {
                        let expected = expected.get_or_insert(*before);
                        values.iter().for_each(|value| put(expected, *value));
                    }
                    Some(Asked::WriteBits(Coils { var, mask, on })) => {
                        let byte = &mut expected.get_or_insert(*before)[var.image_offset()];
                        *byte = *byte & !mask | on;
                    }
                    _ => {}
                });
            }
            LinkId::COMMAND | LinkId::URGENT | LinkId::STATE => {}
            _ => {
                let Self { controller, spec, .. } = self;
                let Some(frame) = spec.link(link).and_then(|link| link.input.as_ref()) else { return };
                let held = controller.held(conn);
                held.extend_from_slice(bytes);
                let mut cut = Cut::default();
                while let Some(payload) = cut.next(frame, held) {
                    put_frame(expected.get_or_insert(*before), frame, payload);
                }
                held.drain(..cut.len());
            }
        }
        self.registers(before, expected.as_ref(), after, now);
    }

    /// As [`Self::arrived`], for a datagram.
    pub(crate) fn arrived_datagram(
        &mut self,
        link: LinkId,
        tag: u64,
        bytes: &[u8],
        (before, after): (&Inputs, &[u8]),
        slowest: Duration,
        now: Instant,
    ) {
        let result = self.controller.arrived_datagram(u64::from(link.0), bytes);
        self.judge(now, &[Invariant::Transport], result);
        self.datagram_delivered(tag, slowest, now);
        self.robot.applied(before, after, now);
        let mut expected = None;
        if let Some(frame) = self.spec.link(link).and_then(|link| link.input.as_ref())
            && let Some(payload) = frame.payload_of(bytes)
        {
            put_frame(expected.get_or_insert(*before), frame, payload);
        }
        self.registers(before, expected.as_ref(), after, now);
    }

    /// A write is applied as a whole or, if the controller refuses it, has no effect.
    fn registers(&mut self, before: &Inputs, expected: Option<&Inputs>, after: &[u8], now: Instant) {
        let result = if after == before || expected.is_some_and(|expected| after == expected) {
            Ok(())
        } else {
            Err((Invariant::Registers, "the controller's inputs are not the values written".to_owned()))
        };
        self.judge(now, &[Invariant::Registers], result);
    }
}

/// The controller accepts a frame.
fn put_frame(inputs: &mut Inputs, frame: &Frame, payload: &[u8]) {
    let mut rest = payload;
    for &var in &frame.written {
        let (bytes, after) = rest.split_at(var.size());
        rest = after;
        let mut raw = Raw::default();
        raw[..bytes.len()].copy_from_slice(bytes);
        put(inputs, (var, raw));
    }
}

fn put(inputs: &mut Inputs, (var, raw): (SysVar, Raw)) {
    let at = var.image_offset();
    let mask = if var.is_bits() { var.valid_bits() } else { 0xFF };
    for (place, byte) in inputs[at..at + var.size()].iter_mut().zip(raw) {
        *place = byte & mask;
    }
}
