//! Whatever happens in whatever order, the engine keeps its promises (docs/engine.md
//! sections 5 to 7): random operations, checked against a model.

#[path = "../rig/mod.rs"]
mod rig;

mod model;
mod play;

use model::*;
use play::{Op, Test};
use proptest::prelude::*;
use proto_core::engine::{BusState, LinkId};
use proto_core::time::Duration;
use rig::*;

fn ops() -> impl Strategy<Value = Vec<Op>> {
    let link = prop::sample::select(vec![LinkId::MODBUS, LinkId::STATE, UDP]);
    let port = prop::sample::select(vec![PLC, BUS, SENSOR, KNOB]);
    let stream = prop::sample::select(vec![PLC, SENSOR, KNOB]);
    let bus = prop::sample::select(vec![BusState::Active, BusState::Passive, BusState::BusOff]);
    let short = (0..6_000_u64).prop_map(Duration::from_micros);
    let long = (0..700_u64).prop_map(MS);
    let frame = (0..FRAMES.len(), prop::array::uniform2(0..4_u16), prop::bool::weighted(0.95), 1..20_usize);
    let frame = frame.prop_map(|(nth, values, finite, piece)| Op::Frame { nth, values, finite, piece });
    // Bytes that look like heads and tails are the interesting ones.
    let byte = prop::sample::select(vec![255_u8, 255, 238, 238, 0, 1]);
    let noise =
        (stream, prop::collection::vec(byte, 1..12)).prop_map(|(port, bytes)| Op::Noise { port, bytes });
    let wrong = (0..12_u16, 0..9_usize, any::<bool>());
    let state =
        (any::<u8>(), 0..4_u16, 0..4_u16, prop::bool::weighted(0.8), prop_oneof![3 => Just(0), 1 => 1..4_u8]);
    let op = prop_oneof![
        12 => frame,
        3 => prop::array::uniform3(0..3_u8).prop_map(|values| Op::Burst { values }),
        3 => (0..FRAMES.len(), 1..60_u64, 1..20_u16)
            .prop_map(|(nth, every, count)| Op::Stream { nth, every: MS(every), count }),
        2 => (0..FRAMES.len(), 0..12_usize).prop_map(|(nth, len)| Op::Cut { nth, len }),
        2 => noise,
        1 => wrong.prop_map(|(id, len, remote)| Op::WrongCan { id, len, remote }),
        8 => short.clone().prop_map(Op::Wait),
        3 => long.clone().prop_map(Op::Wait),
        3 => prop_oneof![short, long].prop_map(Op::Late),
        1 => (port, any::<bool>()).prop_map(|(port, up)| Op::Port { port, up }),
        1 => bus.prop_map(Op::Bus),
        2 => (link, prop::bool::weighted(0.7)).prop_map(|(link, yes)| Op::Reachable { link, yes }),
        2 => prop::bool::weighted(0.4).prop_map(Op::Answers),
        4 => prop::bool::weighted(0.8).prop_map(|newest| Op::Answer { newest }),
        1 => any::<bool>().prop_map(Op::Refuse),
        1 => any::<bool>().prop_map(Op::Reports),
        2 => Just(Op::Sent),
        1 => any::<bool>().prop_map(Op::Acks),
        2 => Just(Op::Acked),
        5 => state.prop_map(|(outputs, word, float, good, unreadable)| {
            Op::State { outputs, word, float, good, unreadable }
        }),
        2 => prop::option::weighted(0.8, 0..4_u16).prop_map(|value| Op::Down { value }),
    ];
    prop::collection::vec(op, 1..120)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn nothing_goes_up_that_nobody_sent_and_everything_is_counted(ops in ops()) {
        let mut test = Test::new();
        test.look()?;
        for op in &ops {
            test.apply(op)?;
            test.counters_add_up()?;
        }
        test.settles()?;
        test.counters_add_up()?;
        test.becomes_safe()?;
        test.counters_add_up()?;
    }
}
