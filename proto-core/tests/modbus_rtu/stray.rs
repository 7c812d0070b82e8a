//! Bytes that a line gives while its direction changes, before a request and behind it.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proto_core::modbus::rtu::{Echo, MAX_ADU, Slave, Timing};
use proto_core::time::Instant;

use crate::bank::{Bank, MS};

const TIMING: Timing = Timing::new(115_200, 11);
const OWN: u8 = 17;

fn crc(bytes: &[u8]) -> [u8; 2] {
    let crc = bytes.iter().fold(0xFFFF_u16, |crc, &byte| {
        (0..8).fold(crc ^ u16::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    });
    crc.to_le_bytes()
}

fn sealed(bytes: &[u8]) -> Vec<u8> {
    [bytes, &crc(bytes)].concat()
}

/// A slave, and what its master reads and writes.
struct Bench {
    slave: Slave,
    bank: Bank,
    now: Instant,
}

impl Bench {
    fn new(echo: Echo) -> Self {
        let slave = Slave::new(TIMING, echo, OWN).unwrap();
        Self { slave, bank: Bank::new(OWN), now: Instant::from_millis(1) }
    }

    /// What is replied to bytes between two silences.
    fn hear(&mut self, burst: &[u8]) -> Option<Vec<u8>> {
        self.now += MS(50);
        self.slave.received(burst, self.now);
        self.now = self.slave.deadline().min(self.now + MS(50));
        let mut out = [0xA5; MAX_ADU];
        let reply = self.slave.poll(self.now, &mut self.bank, &mut out);
        let again = self.slave.poll(self.now + MS(50), &mut self.bank, &mut [0; MAX_ADU]);
        assert_eq!(again, None, "answered twice");
        reply.map(|len| out[..len].to_vec())
    }
}

#[track_caller]
fn is_written(burst: &[u8], expected: bool) {
    let mut bench = Bench::new(Echo::Absent);
    let reply = bench.hear(burst);
    assert_eq!(reply.is_some_and(|reply| reply == WRITE()), expected, "{burst:02x?}");
    let wrong = u32::from(!expected);
    assert_eq!(
        (bench.bank.words[3], bench.slave.counters().wrong),
        (if expected { 7 } else { 0x1103 }, wrong)
    );
}

const WRITE: fn() -> Vec<u8> = || sealed(&[OWN, 6, 0, 3, 0, 7]);

#[test]
fn one_false_byte_on_each_side_is_no_part_of_a_request() {
    for before in [&[][..], &[0], &[0xFF]] {
        for behind in [&[][..], &[0], &[0xFF]] {
            is_written(&[before, &WRITE(), behind].concat(), true);
        }
    }
}

#[test]
fn nothing_else_is_forgiven() {
    let write = WRITE();
    for (before, behind) in
        [(&[0, 0][..], &[][..]), (&[0xFF, 0], &[]), (&[0x55], &[]), (&[], &[0x55]), (&[0], &[0xFE])]
    {
        is_written(&[before, &write, behind].concat(), false);
    }
    let mut damaged = write.clone();
    damaged[5] ^= 1;
    is_written(&[&[0], &damaged[..]].concat(), false);
    is_written(&[&damaged[..], &[0]].concat(), false);
    is_written(&[&[0xFF], &write[..7], &[0xFF]].concat(), false);
}

#[test]
fn a_zero_behind_a_request_whose_register_looks_like_a_byte_count() {
    // 17 3 4 ...: with the zero, whose CRC is right as well, as long as a reply of four bytes.
    let read = sealed(&[OWN, 3, 4, 0, 0, 1]);
    let alone = Bench::new(Echo::Absent).hear(&read);
    assert_eq!(alone, Some(sealed(&[OWN, 0x83, 2])), "no such register");
    assert_eq!(Bench::new(Echo::Absent).hear(&[&read[..], &[0]].concat()), alone);
}

#[test]
fn a_request_to_another_slave_stays_one() {
    for before in [&[][..], &[0], &[0xFF]] {
        for behind in [&[][..], &[0], &[0xFF]] {
            let mut bench = Bench::new(Echo::Absent);
            let burst = [before, &sealed(&[18, 6, 0, 3, 0, 7]), behind].concat();
            assert_eq!(bench.hear(&burst), None);
            assert_eq!((bench.bank.words[3], bench.slave.counters().others), (0x1103, 1), "{burst:02x?}");
            assert_eq!(bench.slave.counters().wrong, 0);
        }
    }
}

#[test]
fn a_broadcast_is_carried_out_without_a_reply() {
    for before in [&[][..], &[0], &[0xFF]] {
        for behind in [&[][..], &[0], &[0xFF]] {
            let mut bench = Bench::new(Echo::Absent);
            assert_eq!(bench.hear(&[before, &sealed(&[0, 6, 0, 3, 0, 7]), behind].concat()), None);
            assert_eq!((bench.bank.words[3], bench.slave.counters().broadcasts), (7, 1));
        }
    }
}

#[test]
fn a_burst_that_can_be_read_in_two_ways_is_not_carried_out() {
    // Coils of all slaves, and a frame of slave 0xA8; or a false byte, registers of slave 15, and a reply of
    // slave 18. The CRC of each is right.
    let to_all = [0, 15, 0x10, 2, 0, 0x25, 5, 6, 1, 2, 3, 4, 0x11, 0x7B];
    let both = [&to_all[..], &[0xA8, 0xEA, 18, 3, 2, 1, 2, 0xBD, 0xD6]].concat();
    for (burst, broadcasts, wrong) in [(&to_all[..], 1, 0), (&both, 0, 1), (&both[1..], 0, 0)] {
        let mut bench = Bench::new(Echo::Absent);
        bench.bank.coils = vec![false; 0x1_0000];
        assert_eq!(bench.hear(burst), None);
        assert_eq!(bench.bank.coils.contains(&true), broadcasts == 1, "{burst:02x?}");
        let counters = bench.slave.counters();
        assert_eq!((counters.broadcasts, counters.wrong), (broadcasts, wrong), "{burst:02x?}");
    }
}

#[test]
fn the_echo_of_a_write_behind_a_false_byte_is_no_request() {
    for before in [&[][..], &[0], &[0xFF]] {
        let mut bench = Bench::new(Echo::Heard);
        let reply = bench.hear(&WRITE()).unwrap();
        assert_eq!(bench.hear(&[before, &reply].concat()), None);
        assert_eq!(bench.slave.counters().answered, 1);
        // And the next request behind the echo.
        let reply = bench.hear(&WRITE()).unwrap();
        let next = sealed(&[OWN, 3, 0, 3, 0, 1]);
        let burst = [before, &reply, &[0xFF], &next, &[0]].concat();
        assert_eq!(bench.hear(&burst), Some(sealed(&[OWN, 3, 2, 0, 7])));
    }
}

/// What a burst leads to: writes to all, and the request that is answered.
type Deeds = (Vec<Vec<u8>>, Option<Vec<u8>>);

/// The lengths that a frame with these first bytes can have.
fn lengths(bytes: &[u8]) -> Vec<usize> {
    let counted = |at: usize| bytes.get(at).map(|&count| at + 1 + usize::from(count) + 2);
    let request = match bytes.get(1) {
        Some(1..=6) => Some(8),
        Some(15 | 16) => counted(6),
        Some(22) => Some(10),
        Some(23) => counted(10),
        _ => None,
    };
    let reply = match bytes.get(1) {
        Some(1..=4 | 23) => counted(2),
        Some(5 | 6 | 15 | 16) => Some(8),
        Some(22) => Some(10),
        Some(0x80..) => Some(5),
        _ => None,
    };
    // What a slave carries out is a request.
    let reply = reply.filter(|_| bytes[0] != 0 && bytes[0] != OWN);
    request.into_iter().chain(reply).filter(|len| *len <= bytes.len() && *len <= 256).collect()
}

/// All ways to read `bytes` as frames, and one that ends with an empty frame where one of two lengths may be a coincidence.
fn readings(bytes: &[u8]) -> Vec<Vec<&[u8]>> {
    if bytes.is_empty() {
        return vec![vec![]];
    }
    let mut found: Vec<Vec<&[u8]>> = Vec::new();
    let mut lengths = lengths(bytes);
    lengths.dedup();
    lengths.retain(|&len| bytes[len - 2..len] == crc(&bytes[..len - 2]));
    if lengths.len() > 1 {
        found.push(vec![&[]]);
    }
    for len in lengths {
        let (frame, rest) = bytes.split_at(len);
        found.extend(readings(rest).into_iter().map(|behind| [&[frame], &behind[..]].concat()));
    }
    found
}

/// Whether a burst, or the rest of it behind frames, has a right CRC and a length that its function does not tell.
fn has_any_length(burst: &[u8]) -> bool {
    let is_right =
        |bytes: &[u8]| bytes.len() >= 4 && bytes[bytes.len() - 2..] == crc(&bytes[..bytes.len() - 2]);
    let is_unknown = |bytes: &[u8]| !matches!(bytes.get(1), Some(1..=6 | 15 | 16 | 22 | 23 | 0x80..));
    is_right(burst) || (0..burst.len()).map(|at| &burst[at..]).any(|rest| is_unknown(rest) && is_right(rest))
}

fn deeds(frames: &[&[u8]]) -> Deeds {
    let to_all = frames.iter().filter(|frame| matches!(frame, [] | [0, 5 | 6 | 15 | 16 | 22, ..]));
    let last = frames.last().filter(|frame| frame.first() == Some(&OWN));
    (to_all.map(|frame| frame.to_vec()).collect(), last.map(|frame| frame.to_vec()))
}

/// What all ways to read a burst lead to, with and without the bytes at its ends.
fn all_deeds(burst: &[u8]) -> Vec<Deeds> {
    let is_false = |byte: Option<&u8>| matches!(byte, Some(0 | 0xFF));
    let mut all = Vec::new();
    for before in 0..=usize::from(is_false(burst.first())) {
        for behind in 0..=usize::from(is_false(burst.last())) {
            let inner = burst.get(before..burst.len() - behind).unwrap_or(&[]);
            all.extend(
                readings(inner).iter().filter(|frames| !frames.is_empty()).map(|frames| deeds(frames)),
            );
        }
    }
    all.sort();
    all.dedup();
    all
}

fn frame() -> impl Strategy<Value = Vec<u8>> {
    let address = prop_oneof![3 => Just(OWN), 2 => 15..20_u8, 1 => Just(0_u8), 1 => any::<u8>()];
    let written = (any::<bool>(), 0..200_u8, vec(any::<u8>(), 1..9)).prop_map(|(are_coils, at, mut data)| {
        if !are_coils {
            data.extend(data.clone());
        }
        let (function, count) = if are_coils { (15, data.len() * 8) } else { (16, data.len() / 2) };
        [&[function, 0, at, 0, count as u8, data.len() as u8], &data[..]].concat()
    });
    let short = (1..=6_u8, 0..8_u8, 0..9_u8, 0..3_u8, 0..9_u8)
        .prop_map(|(function, high, low, first, second)| vec![function, high, low, first, second]);
    let request = (address, prop_oneof![4 => short, 1 => written]);
    let read = (1..=4_u8, vec(prop_oneof![Just(0_u8), any::<u8>()], 0..12))
        .prop_map(|(function, data)| [&[function, data.len() as u8], &data[..]].concat());
    let refusal = (0x81..=0x90_u8, 1..9_u8).prop_map(|(function, code)| vec![function, code]);
    let reply = (18..250_u8, prop_oneof![read, refusal]);
    prop_oneof![request.boxed(), reply.boxed()]
        .prop_map(|(address, pdu)| sealed(&[&[address], &pdu[..]].concat()))
}

fn noise() -> impl Strategy<Value = Vec<u8>> {
    let byte = || prop_oneof![4 => Just(0_u8), 4 => Just(0xFF), 1 => any::<u8>()];
    prop_oneof![3 => Just(vec![]), 5 => vec(byte(), 1), 1 => vec(byte(), 2)]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4_000))]

    #[test]
    fn a_slave_does_what_the_only_way_to_read_a_burst_says(
        frames in vec(frame(), 1..4),
        before in noise(),
        behind in noise(),
        damage in option::weighted(0.2, (any::<prop::sample::Index>(), 1..=255_u8)),
    ) {
        let mut burst = [before, frames.concat(), behind].concat();
        if let Some((at, change)) = damage {
            let at = at.index(burst.len());
            burst[at] ^= change;
        }
        let mut bench = Bench::new(Echo::Absent);
        let reply = bench.hear(&burst);
        let counters = bench.slave.counters();
        match &all_deeds(&burst)[..] {
            [(to_all, answered)] if !to_all.contains(&vec![]) => {
                let mut alone = Bench::new(Echo::Absent);
                to_all.iter().for_each(|frame| assert_eq!(alone.hear(frame), None, "{frame:02x?}"));
                let expected = answered.as_ref().and_then(|frame| alone.hear(frame));
                prop_assert_eq!(reply, expected, "{:02x?}", burst);
                prop_assert_eq!(&bench.bank.words, &alone.bank.words, "{:02x?}", burst);
                prop_assert_eq!(&bench.bank.coils, &alone.bank.coils);
                prop_assert!(answered.is_none() || counters.wrong == 0);
            }
            [] if !has_any_length(&burst) => {
                prop_assert_eq!(reply, None, "{:02x?}", burst);
                prop_assert_eq!(counters.answered, 0);
            }
            _ => {}
        }
    }
}
