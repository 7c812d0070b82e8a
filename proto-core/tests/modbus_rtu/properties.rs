//! Any bytes, cut anywhere.

use proptest::collection::vec;
use proptest::prelude::*;
use proto_core::modbus::rtu::{
    Adu, Echo, Exchange, MAX_ADU, Master, Operation, Output, Reply, Slave, Timing, When, checksum,
};
use proto_core::time::{Duration, Instant};

use crate::line::{Bank, MS, original};

const TIMING: Timing = Timing::new(115_200, 11);

fn framed(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0xA5; MAX_ADU];
    let len = Adu { address, pdu }.encode(&mut out).unwrap();
    assert!(out[len..].iter().all(|&byte| byte == 0xA5));
    out[..len].to_vec()
}

fn operation() -> impl Strategy<Value = Operation> {
    (0..10_u8, 0..60_u16, 1..=40_u16, 1..=40_u16).prop_map(|(which, address, count, writes)| match which {
        0 => Operation::ReadCoils { address, count },
        1 => Operation::ReadDiscreteInputs { address, count },
        2 => Operation::ReadHoldingRegisters { address, count },
        3 => Operation::ReadInputRegisters { address, count },
        4 => Operation::WriteCoil { address },
        5 => Operation::WriteRegister { address },
        6 => Operation::WriteCoils { address, count },
        7 => Operation::WriteRegisters { address, count },
        8 => Operation::MaskWriteRegister { address, mask: writes.wrapping_mul(0x1357) },
        _ => Operation::ReadWriteRegisters {
            read_address: address,
            read_count: count,
            write_address: 7,
            write_count: writes,
        },
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

/// A master that has just sent its only request.
fn asking(operation: Operation, echo: Echo) -> (Master<1>, Vec<u8>, Instant) {
    let exchange = Exchange { slave: 17, operation, when: When::START, timeout: MS(50), retries: 0 };
    let mut master = Master::new(TIMING, echo, &[exchange], Instant::ZERO).unwrap();
    let mut out = [0xA5; MAX_ADU];
    let mut now = master.deadline();
    loop {
        match master.poll(
            now,
            |_, data| !data.iter_mut().any(|byte| core::mem::replace(byte, 0x5A) != 0),
            &mut out,
        ) {
            Some(Output::Send(len)) => {
                let frame = &out[..len];
                assert_eq!(
                    (len, Adu::parse(frame).map(|adu| adu.address)),
                    (operation.request_len(), Ok(17))
                );
                return (master, frame.to_vec(), now + TIMING.of(len));
            }
            Some(other) => panic!("{other:?}"),
            None => now = master.deadline(),
        }
    }
}

/// What comes of bytes in these pieces; `None` if it is no reply.
fn answer(master: &mut Master<1>, bytes: &[u8], piece: usize, mut now: Instant) -> Option<Vec<u8>> {
    let (mut out, mut answer) = ([0xA5; MAX_ADU], None);
    for piece in bytes.chunks(piece) {
        now += TIMING.of(piece.len());
        master.received(piece, now);
        while let Some(output) = master.poll(now, |_, _| false, &mut out) {
            match output {
                Output::Reply { reply: Reply::Registers(words), .. } => {
                    answer = Some(words.as_be_bytes().to_vec())
                }
                Output::Reply { reply: Reply::Coils(coils), .. } => answer = Some(coils.packed().to_vec()),
                Output::Reply { reply: Reply::Written, .. } => answer = Some(vec![]),
                _ => {}
            }
        }
    }
    answer
}

fn has_right_crc(frame: &[u8]) -> bool {
    let (body, crc) = frame.split_at(frame.len() - 2);
    framed(body[0], &body[1..]).ends_with(crc)
}

proptest! {
    #[test]
    fn the_reply_is_found_however_it_is_cut_and_whatever_is_before_it(
        operation in operation(),
        seed in any::<u8>(),
        noise in vec(any::<u8>(), 0..6),
        piece in 1..300_usize,
    ) {
        let (mut master, request, now) = asking(operation, Echo::Absent);
        let reply = good_reply(&request, seed);
        // What looks like the beginning of a longer reply hides what follows until the line is silent.
        prop_assume!(!noise.contains(&17));
        let bytes = [&noise[..], &reply].concat();
        let data = match request[1] { 1..=4 | 23 => reply[3..reply.len() - 2].to_vec(), _ => vec![] };
        prop_assert_eq!(answer(&mut master, &bytes, piece, now), Some(data));
        prop_assert_eq!(master.stray_bytes() as usize, noise.len());
    }

    #[test]
    fn behind_its_echo_the_reply_is_found_and_the_echo_is_none(
        operation in operation(),
        seed in any::<u8>(),
        piece in 1..300_usize,
    ) {
        let (mut master, request, now) = asking(operation, Echo::Heard);
        let alone = &mut master.clone();
        prop_assert_eq!(answer(alone, &request, piece, now), None);
        let reply = good_reply(&request, seed);
        let bytes = [&request[..], &reply].concat();
        prop_assert!(answer(&mut master, &bytes, piece, now).is_some());
        prop_assert_eq!(master.stray_bytes(), 0);
    }

    #[test]
    fn a_changed_reply_is_never_accepted(
        operation in operation(),
        seed in any::<u8>(),
        changes in vec((any::<prop::sample::Index>(), 1..=255_u8), 1..4),
        piece in 1..300_usize,
    ) {
        let (mut master, request, now) = asking(operation, Echo::Absent);
        let good = good_reply(&request, seed);
        let mut reply = good.clone();
        for (at, change) in changes {
            let at = at.index(reply.len());
            reply[at] ^= change;
        }
        let crc = u16::from_le_bytes(*reply.last_chunk().unwrap());
        prop_assume!(reply != good && checksum(&reply[..reply.len() - 2]) != crc);
        prop_assert_eq!(answer(&mut master, &reply, piece, now), None);
    }

    #[test]
    fn any_bytes_leave_a_master_that_asks_again(
        operation in operation(),
        bytes in vec(prop_oneof![3 => any::<u8>(), 1 => Just(17), 1 => 1..24_u8], 0..1500),
        piece in 1..100_usize,
        gaps in any::<u64>(),
    ) {
        let (mut master, _, mut now) = asking(operation, Echo::Absent);
        let mut out = [0xA5; MAX_ADU];
        for (nth, piece) in bytes.chunks(piece).enumerate() {
            now += if gaps >> (nth % 64) & 1 == 1 { MS(5) } else { Duration::from_micros(90) };
            master.received(piece, now);
            while master.poll(now, |_, _| true, &mut out).is_some() {}
        }
        master.request(0, now);
        let mut sent = false;
        for _ in 0..20 {
            now = now.max(master.deadline());
            while let Some(output) = master.poll(now, |_, _| true, &mut out) {
                sent |= matches!(output, Output::Send(_));
            }
        }
        prop_assert!(sent);
    }

    #[test]
    fn a_slave_answers_requests_and_nothing_else(
        requests in vec((15..20_u8, operation(), any::<bool>()), 1..6),
        damage in proptest::option::of((any::<prop::sample::Index>(), 1..=255_u8)),
        // Fewer than a silence has.
        piece in 1..18_usize,
    ) {
        let mut slave = Slave::new(TIMING, Echo::Absent, 17).unwrap();
        let (mut bank, mut out, mut now) = (Bank::new(17), [0xA5; MAX_ADU], Instant::from_millis(1));
        let damaged = damage.map(|(at, _)| at.index(requests.len()));
        for (nth, (address, operation, _)) in requests.iter().enumerate() {
            let (_, mut request, _) = asking(*operation, Echo::Absent);
            request = framed(*address, &request[1..request.len() - 2]);
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
                prop_assert_eq!((adu.address, adu.pdu[0] & 0x7F), (17, operation.function()));
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
        others in vec((18..30_u8, operation(), any::<u8>()), 0..4),
        address in 0..190_u16,
        piece in 1..300_usize,
    ) {
        let mut frames = Vec::new();
        for (other, operation, seed) in &others {
            let (_, request, _) = asking(*operation, Echo::Absent);
            let request = framed(*other, &request[1..request.len() - 2]);
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
