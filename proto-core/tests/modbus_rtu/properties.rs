//! Any bytes, cut anywhere.

use proptest::collection::vec;
use proptest::prelude::*;
use proto_core::modbus::rtu::{Adu, Echo, MAX_ADU, Slave, Timing};
use proto_core::time::{Duration, Instant};

use crate::bank::{Bank, MS, original};

const TIMING: Timing = Timing::new(115_200, 11);

fn framed(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0xA5; MAX_ADU];
    let len = Adu { address, pdu }.encode(&mut out).unwrap();
    assert!(out[len..].iter().all(|&byte| byte == 0xA5));
    out[..len].to_vec()
}

/// The PDU of a request, with 0x5A for each byte that is written.
fn request() -> impl Strategy<Value = Vec<u8>> {
    (0..10_usize, 0..60_u16, 1..=40_u16, 1..=40_u16).prop_map(|(which, address, count, writes)| {
        let (coil_bytes, register_bytes) = (usize::from(count.div_ceil(8)), usize::from(count) * 2);
        let (address, count) = (address.to_be_bytes(), count.to_be_bytes());
        let data = |len: usize| [vec![len as u8], vec![0x5A; len]].concat();
        let function = [1, 2, 3, 4, 5, 6, 15, 16, 22, 23][which];
        let head = [&[function][..], &address].concat();
        match function {
            1..=4 => [head, count.to_vec()].concat(),
            5 => [head, vec![0, 0]].concat(),
            6 => [head, vec![0x5A; 2]].concat(),
            15 => [head, count.to_vec(), data(coil_bytes)].concat(),
            16 => [head, count.to_vec(), data(register_bytes)].concat(),
            22 => {
                let mask = writes.wrapping_mul(0x1357);
                let bits = 0x5A5A & mask;
                [head, (!mask).to_be_bytes().to_vec(), bits.to_be_bytes().to_vec()].concat()
            }
            _ => {
                let written = [&7_u16.to_be_bytes()[..], &writes.to_be_bytes()].concat();
                [head, count.to_vec(), written, data(usize::from(writes) * 2)].concat()
            }
        }
    })
}

/// What a slave with the data `seed`, `seed` + 1 ... replies to this request.
fn good_reply(request: &[u8], seed: u8) -> Vec<u8> {
    let count = usize::from(u16::from_be_bytes([request[4], request[5]]));
    let data = |len: usize| {
        let values = (0..len).map(|nth| seed.wrapping_add(nth as u8));
        [request[1], len as u8].into_iter().chain(values).collect()
    };
    let pdu: Vec<u8> = match request[1] {
        1 | 2 => data(count.div_ceil(8)),
        3 | 4 | 23 => data(count * 2),
        22 => request[1..8].to_vec(),
        _ => request[1..6].to_vec(),
    };
    framed(request[0], &pdu)
}

fn has_right_crc(frame: &[u8]) -> bool {
    let (body, crc) = frame.split_at(frame.len() - 2);
    framed(body[0], &body[1..]).ends_with(crc)
}

proptest! {
    #[test]
    fn a_slave_answers_requests_and_nothing_else(
        requests in vec((15..20_u8, request()), 1..6),
        damage in proptest::option::of((any::<prop::sample::Index>(), 1..=255_u8)),
        // Fewer than a silence has.
        piece in 1..18_usize,
    ) {
        let mut slave = Slave::new(TIMING, Echo::Absent, 17).unwrap();
        let (mut bank, mut out, mut now) = (Bank::new(17), [0xA5; MAX_ADU], Instant::from_millis(1));
        let damaged = damage.map(|(at, _)| at.index(requests.len()));
        for (nth, (address, pdu)) in requests.iter().enumerate() {
            let mut request = framed(*address, pdu);
            let is_damaged = damaged == Some(nth);
            if let (true, Some((at, change))) = (is_damaged, damage) {
                let at = at.index(request.len());
                request[at] ^= change;
            }
            for piece in request.chunks(piece) {
                now += TIMING.of(piece.len());
                prop_assert_eq!(slave.poll(now, &mut bank, &mut out), None, "the line is not silent");
                slave.received(piece, now);
            }
            now = slave.deadline();
            let reply = slave.poll(now, &mut bank, &mut out);
            prop_assert_eq!(reply.is_some(), *address == 17 && !is_damaged);
            if let Some(len) = reply {
                let adu = Adu::parse(&out[..len]).unwrap();
                prop_assert_eq!((adu.address, adu.pdu[0] & 0x7F), (17, pdu[0]));
            }
            now += MS(2);
        }
    }

    #[test]
    fn any_bytes_leave_a_slave_that_answers(
        bytes in vec(prop_oneof![3 => any::<u8>(), 1 => Just(17), 1 => 0..24_u8], 0..1500),
        piece in 1..700_usize,
        gaps in any::<u64>(),
    ) {
        let mut slave = Slave::new(TIMING, Echo::Heard, 17).unwrap();
        let (mut bank, mut out, mut now) = (Bank::new(17), [0xA5; MAX_ADU], Instant::from_millis(1));
        for (nth, piece) in bytes.chunks(piece).enumerate() {
            slave.received(piece, now);
            now += if gaps >> (nth % 64) & 1 == 1 { MS(5) } else { Duration::from_micros(90) };
            slave.poll(now, &mut bank, &mut out);
        }
        now += MS(5);
        slave.poll(now, &mut bank, &mut out);
        slave.received(&framed(17, &[3, 0, 199, 0, 1]), now + MS(1));
        let len = slave.poll(now + MS(5), &mut bank, &mut out).unwrap();
        prop_assert_eq!(Adu::parse(&out[..len]).unwrap().pdu.len(), 4);
    }

    #[test]
    fn requests_that_came_without_a_silence_are_told_apart_and_the_newest_is_answered(
        others in vec((18..30_u8, request(), any::<u8>()), 0..4),
        address in 0..190_u16,
        piece in 1..300_usize,
    ) {
        let mut frames = Vec::new();
        for (other, pdu, seed) in &others {
            let request = framed(*other, pdu);
            frames.extend([good_reply(&request, *seed), request]);
        }
        let [a1, a0] = address.to_be_bytes();
        frames.push(framed(17, &[3, a1, a0, 0, 2]));
        let stream = frames.concat();
        prop_assume!(stream.len() <= 512);
        // Without silence only the CRC tells frames apart: one in 65536 bursts has another reading.
        let mut start = 0;
        for frame in &frames {
            let rest = &stream[start..];
            start += frame.len();
            let others = (4..=rest.len().min(MAX_ADU)).filter(|&len| len != frame.len());
            prop_assume!(!others.into_iter().any(|len| has_right_crc(&rest[..len])));
        }
        let mut slave = Slave::new(TIMING, Echo::Absent, 17).unwrap();
        let (mut bank, mut out, mut now) = (Bank::new(17), [0xA5; MAX_ADU], Instant::from_millis(1));
        for piece in stream.chunks(piece) {
            now += TIMING.of(piece.len());
            slave.received(piece, now);
        }
        let len = slave.poll(slave.deadline(), &mut bank, &mut out).unwrap();
        let words = [original(17, address), original(17, address + 1)];
        let expected = framed(17, &[3, 4, 17, words[0] as u8, 17, words[1] as u8]);
        prop_assert_eq!(&out[..len], expected);
        prop_assert_eq!(slave.counters().others as usize, others.len() * 2);
    }
}
