//! Operations on a cell of four ports, with the model of `tests/engine_props`: nothing goes up that
//! nobody sent, everything is counted, and what works again delivers again (docs/engine.md
//! sections 5 to 7).

use proptest::test_runner::TestCaseError;
use proto_core::engine::{BusState, LinkId};
use proto_core::time::Duration;

use crate::model::{BUS, FRAMES, KNOB, PLC, SENSOR, UDP};
use crate::play::{Op, Test};
use crate::rig::MS;
use crate::source::Source;

/// Operations of one input.
const MOST: usize = 150;

pub(crate) fn run(input: &[u8]) {
    if let Err(wrong) = play(&mut Source::new(input)) {
        panic!("{wrong}");
    }
}

fn play(input: &mut Source<'_>) -> Result<(), TestCaseError> {
    let mut test = Test::new();
    test.look()?;
    // Seconds of virtual time: only for some inputs.
    let settles = input.u8() & 15 == 1;
    for _ in 0..MOST {
        if input.is_empty() {
            break;
        }
        test.apply(&op(input))?;
        test.counters_add_up()?;
    }
    if settles {
        test.settles()?;
        test.counters_add_up()?;
        test.becomes_safe()?;
        test.counters_add_up()?;
    }
    Ok(())
}

fn op(input: &mut Source<'_>) -> Op {
    let links = [LinkId::MODBUS, LinkId::STATE, UDP];
    let op = input.u8();
    match op % 16 {
        0..=2 => Op::Frame {
            nth: input.below(FRAMES.len()),
            values: [u16::from(op >> 6), input.below(4) as u16],
            finite: op & 32 == 0 || op & 16 == 0,
            piece: 1 + input.below(20),
        },
        3 => Op::Burst { values: [op >> 4 & 1, op >> 5 & 1, op >> 6] },
        4 => Op::Stream {
            nth: input.below(FRAMES.len()),
            every: MS(1 + input.below(60) as u64),
            count: 1 + u16::from(op >> 4),
        },
        5 => Op::Cut { nth: input.below(FRAMES.len()), len: usize::from(op >> 4) },
        6 => {
            let bytes = input.take(1 + usize::from(op >> 4)).iter().map(|byte| match byte % 8 {
                0 | 1 => 255,
                2 | 3 => 238,
                4 => 0,
                5 => 1,
                _ => *byte,
            });
            Op::Noise { port: input.clone().one_of(&[PLC, SENSOR, KNOB]), bytes: bytes.collect() }
        }
        7 => Op::WrongCan { id: input.below(12) as u16, len: input.below(9), remote: op & 16 == 0 },
        8 => Op::Wait(Duration::from_micros(u64::from(input.u16()) % 6_000)),
        9 => Op::Wait(MS(u64::from(input.u16()) % 700)),
        10 => Op::Late(Duration::from_micros(u64::from(input.u16()) << (op >> 6 << 1))),
        11 if op & 16 == 0 => Op::Port { port: input.one_of(&[PLC, BUS, SENSOR, KNOB]), up: op & 32 == 0 },
        11 => Op::Bus(
            [BusState::Active, BusState::Passive, BusState::Warning, BusState::BusOff][usize::from(op >> 6)],
        ),
        12 => Op::Reachable { link: input.one_of(&links), yes: op & 16 == 0 },
        13 => match op >> 4 {
            0..4 => Op::Answers(op & 16 == 0),
            4..8 => Op::Refuse(op & 16 == 0),
            _ => Op::Reports(op & 16 == 0),
        },
        14 => match op >> 4 {
            0..10 => Op::Answer { newest: op & 16 == 0 },
            10..12 => Op::Acks(op & 16 == 0),
            12..14 => Op::Acked,
            _ => Op::Sent,
        },
        _ if op & 16 == 0 => Op::State {
            outputs: input.u8(),
            word: u16::from(op >> 6),
            float: input.below(4) as u16,
            good: op & 32 == 0,
            unreadable: input.u8() & 3,
        },
        _ => Op::Down { value: (op & 32 == 0).then_some(u16::from(op >> 6)) },
    }
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let frame = |nth: u8, value: u8| [value << 6, nth, value, 7];
    let wait = |millis: u16| [&[9][..], &millis.to_le_bytes()].concat();
    let state = [15, 7, 0];
    let all: Vec<u8> = (0..5).flat_map(|nth| frame(nth, nth % 4)).collect();
    vec![
        [&[0], &state[..], &all, &wait(20), &all, &wait(200), &state, &all].concat(),
        // The transaction is not answered, edges wait, then the link breaks and comes back.
        [
            &[0, 0x1D],
            &all[..],
            &[0x73, 0x33],
            &all,
            &wait(450),
            &[0x0E, 0x1C, 0],
            &wait(600),
            &[0x0C, 0],
            &all,
        ]
        .concat(),
        // Owners fall silent; late answers; refusals.
        [&[8, 0x1D], &all[..], &wait(699), &wait(699), &wait(699), &[0x0E, 0x1E, 0x4D], &all, &wait(300)]
            .concat(),
        // Devices that come and go, bus-off, an engine that is called late.
        [
            &[16],
            &all[..],
            &[0x2B, 0, 0xDB],
            &wait(10),
            &all,
            &[0x0B, 0, 0x1B, 0xCA, 0xFF, 0xFF],
            &all,
            &[0x2A, 1, 1],
        ]
        .concat(),
        // Streams of values, noise, cuts, bad packets and numbers.
        [
            &[24, 0xF4, 0, 3, 0xF4, 3, 9, 0x85, 3, 0x86, 0, 0, 2, 4, 5, 3, 1, 1],
            &state[..],
            &[0x2F, 1, 1, 0x30, 3, 1, 2, 0x1F, 0x5F],
            &all,
        ]
        .concat(),
        [&[1, 0x8D, 0xAE], &all[..], &wait(4), &[0xAE], &all, &wait(4), &[0x9D], &all, &wait(600)].concat(),
    ]
}
