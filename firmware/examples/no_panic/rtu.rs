//! Modbus RTU, both sides of a line.

use core::hint::black_box;

use proto_core::modbus::rtu::{
    Adu, Echo, MAX_ADU, Operation, Slave, Timing, checksum, reply_len, request_len,
};
use proto_core::time::{Duration, Instant};

use crate::protocols::AnyBank;
use crate::{any, bytes, out_buf};

pub(crate) fn all() {
    rtu_frames();
    rtu_operations(any(Operation::ReadCoils { address: 0, count: 1 }));
    rtu_slave();
}

fn timing() -> Timing {
    let timing = Timing::new(any(115_200), any(11)).with_silence(any(Duration::ZERO));
    any(timing.with_turnaround(any(Duration::ZERO)))
}

#[inline(never)]
fn rtu_frames() {
    let mut out = [0; MAX_ADU];
    let _ = black_box(Adu::parse(bytes()));
    let adu = any(Adu { address: 1, pdu: bytes() });
    black_box(adu.encoded_len());
    let _ = black_box(adu.encode(out_buf(&mut out)));
    black_box((checksum(bytes()), request_len(bytes()), reply_len(bytes())));
    let timing = timing();
    black_box((timing.t1_5(), timing.silence(), timing.turnaround(), timing.of(any(7))));
}

#[inline(never)]
fn rtu_operations(operation: Operation) {
    let _ = black_box(operation.check());
    black_box((operation.function(), operation.reads(), operation.place()));
    black_box((operation.request_len(), operation.reply_len()));
    black_box((operation.written_len(), operation.read_len()));
}

#[inline(never)]
fn rtu_slave() {
    let Some(mut slave) = Slave::new(timing(), any(Echo::Absent), any(5)) else { return };
    let (slave, now, mut out) = (black_box(&mut slave), any(Instant::ZERO), [0; MAX_ADU]);
    slave.received(bytes(), now);
    black_box(slave.poll(any(now), &mut AnyBank, &mut out));
    black_box((slave.deadline(), slave.counters()));
}
