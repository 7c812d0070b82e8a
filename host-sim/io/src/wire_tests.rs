//! The bus on a virtual clock.

use proptest::prelude::*;
use proto_core::config::can_frame_time;

use super::*;

fn standard(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), data).unwrap()
}

fn extended(id: u32, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Extended(id), data).unwrap()
}

fn at(micros: u64) -> Instant {
    Instant::from_micros(micros)
}

/// All further transmissions, polled at each deadline, with the time of their end.
fn run(wire: &mut Wire) -> Vec<(NodeId, CanFrame, u64)> {
    std::iter::from_fn(|| {
        let Transmitted { from, frame, at } = wire.poll(wire.deadline())?;
        Some((from, frame, at.as_micros()))
    })
    .collect()
}

fn frames(transmitted: &[(NodeId, CanFrame, u64)]) -> Vec<CanFrame> {
    transmitted.iter().map(|&(_, frame, _)| frame).collect()
}

/// A bus that is busy from 0 on, and when it becomes idle.
fn busy() -> (Wire, u64) {
    let mut wire = Wire::new(Pacing::Bitrate(500_000));
    let node = wire.join();
    wire.send(at(0), node, standard(0, &[])).unwrap();
    let end = wire.deadline().as_micros();
    (wire, end)
}

#[test]
fn waiting_frames_are_sent_in_the_order_of_arbitration() {
    let (mut wire, _) = busy();
    let order = [
        standard(0x100, &[9]),
        CanFrame::remote(CanId::Standard(0x100), 1).unwrap(),
        extended(0x100 << 18, &[]),
        CanFrame::remote(CanId::Extended(0x100 << 18), 0).unwrap(),
        extended(0x100 << 18 | 1, &[]),
        standard(0x101, &[]),
        extended(0x1FFF_FFFF, &[]),
    ];
    for &frame in order.iter().rev() {
        let node = wire.join();
        wire.send(at(10), node, frame).unwrap();
    }
    assert_eq!(frames(&run(&mut wire))[1..], order);
}

#[test]
fn a_node_keeps_its_order_and_arbitrates_with_its_first_frame_only() {
    let (mut wire, _) = busy();
    let (one, two) = (wire.join(), wire.join());
    for id in [7, 1, 2] {
        wire.send(at(1), one, standard(id, &[])).unwrap();
    }
    for id in [5, 6, 8] {
        wire.send(at(1), two, standard(id, &[])).unwrap();
    }
    let ids: Vec<_> = frames(&run(&mut wire)).iter().map(CanFrame::id).collect();
    assert_eq!(ids, [0, 5, 6, 7, 1, 2, 8].map(CanId::Standard));
}

#[test]
fn of_equal_ids_the_longest_waiting_is_first_then_the_node_that_joined_first() {
    let (mut wire, _) = busy();
    let nodes = [wire.join(), wire.join(), wire.join()];
    wire.send(at(9), nodes[0], standard(5, &[0])).unwrap();
    wire.send(at(8), nodes[2], standard(5, &[2])).unwrap();
    wire.send(at(8), nodes[1], standard(5, &[1])).unwrap();
    let from: Vec<_> = run(&mut wire)[1..].iter().map(|transmitted| transmitted.0).collect();
    assert_eq!(from, [nodes[1], nodes[2], nodes[0]]);
}

#[test]
fn within_the_first_bit_a_better_frame_still_wins_and_later_it_waits() {
    for (delay, order) in [(2, [1, 9]), (3, [9, 1])] {
        let mut wire = Wire::new(Pacing::Bitrate(500_000));
        let (one, two) = (wire.join(), wire.join());
        wire.send(at(100), one, standard(9, &[])).unwrap();
        wire.send(at(100 + delay), two, standard(1, &[])).unwrap();
        let transmitted = run(&mut wire);
        assert_eq!(frames(&transmitted), order.map(|id| standard(id, &[])), "after {delay} us");
        let times = order.map(|id| 2 * u64::from(frame_bits(&standard(id, &[]))));
        assert_eq!((transmitted[0].2, transmitted[1].2), (100 + times[0], 100 + times[0] + times[1]));
    }
}

#[test]
fn a_burst_takes_the_time_of_its_bits_even_if_polled_late() {
    let burst: Vec<_> = (0..MAX_QUEUED as u16).map(|id| standard(id, &[0xFF; 8])).collect();
    let bits: u32 = burst.iter().map(frame_bits).sum();
    for lateness in [0, 40, 1_000_000] {
        let mut wire = Wire::new(Pacing::Bitrate(250_000));
        let node = wire.join();
        for &frame in &burst[1..] {
            wire.send(at(1_000), node, frame).unwrap();
        }
        wire.send(at(1_000), node, burst[0]).unwrap();
        let mut last = at(0);
        let mut count = 0;
        while wire.deadline() != Instant::NEVER {
            let now = wire.deadline() + Duration::from_micros(lateness);
            while let Some(transmitted) = wire.poll(now) {
                (last, count) = (transmitted.at, count + 1);
            }
        }
        assert_eq!((last.as_micros(), count), (1_000 + 4 * u64::from(bits), burst.len()));
    }
}

#[test]
fn a_frame_queued_after_the_end_of_another_was_not_in_that_arbitration() {
    let (mut wire, end) = busy();
    let (early, late) = (wire.join(), wire.join());
    wire.send(at(5), early, standard(0x700, &[])).unwrap();
    // Not polled at the end.
    wire.send(at(end + 50), late, standard(1, &[])).unwrap();
    assert_eq!(frames(&run(&mut wire))[1..], [standard(0x700, &[]), standard(1, &[])]);
}

#[test]
fn an_idle_wire_begins_at_once_and_not_in_the_past() {
    let (mut wire, end) = busy();
    assert_eq!(wire.poll(at(end - 1)), None);
    assert!(wire.poll(at(end)).is_some());
    assert_eq!(wire.deadline(), Instant::NEVER);
    let node = wire.join();
    wire.send(at(end + 777), node, standard(0, &[])).unwrap();
    assert_eq!(wire.deadline(), at(end + 777 + end));
}

#[test]
fn a_full_queue_refuses_and_a_node_that_leaves_loses_its_frames() {
    let (mut wire, end) = busy();
    let (node, other) = (wire.join(), wire.join());
    for _ in 0..MAX_QUEUED {
        wire.send(at(3), node, standard(6, &[])).unwrap();
    }
    assert_eq!((wire.send(at(3), node, standard(6, &[])), wire.is_full(node)), (Err(Full), true));
    assert_eq!((wire.waiting(node), wire.is_full(other)), (MAX_QUEUED, false));
    wire.send(at(4), other, standard(7, &[])).unwrap();
    assert!(wire.poll(at(end)).is_some());
    assert_eq!((wire.waiting(node), wire.is_full(node)), (MAX_QUEUED, false));
    wire.leave(node);
    assert_eq!(frames(&run(&mut wire)), [standard(6, &[]), standard(7, &[])]);
    assert_eq!(wire.send(at(9_999), node, standard(1, &[])), Err(Full));
}

#[test]
fn without_pacing_nothing_waits() {
    let mut wire = Wire::new(Pacing::AtOnce);
    let nodes = [wire.join(), wire.join()];
    for (node, id) in [(nodes[0], 9), (nodes[1], 1), (nodes[0], 5)] {
        wire.send(at(50), node, standard(id, &[8; 8])).unwrap();
        let transmitted = wire.poll(at(50));
        assert_eq!(transmitted, Some(Transmitted { from: node, frame: standard(id, &[8; 8]), at: at(50) }));
    }
}

#[test]
fn bits_of_known_frames() {
    // 34 zeros with their CRC: a stuff bit after every fifth.
    assert_eq!(frame_bits(&standard(0, &[])), 47 + 6);
    let mut bits = BitCounter::default();
    for byte in *b"123456789" {
        bits.push(u32::from(byte), 8);
    }
    // The check value of CRC-15/CAN.
    assert_eq!(bits.crc, 0x059E);
}

/// The stuffed part of a frame from its bits as text.
fn stuffed_length(bits: &str) -> usize {
    let mut sent = String::new();
    for bit in bits.chars() {
        sent.push(bit);
        if sent.ends_with("00000") {
            sent.push('1');
        } else if sent.ends_with("11111") {
            sent.push('0');
        }
    }
    sent.len()
}

/// The remainder of a long division by the polynomial, as text.
fn crc_text(bits: &str) -> String {
    let mut rest: Vec<bool> =
        bits.chars().map(|bit| bit == '1').chain(std::iter::repeat_n(false, 15)).collect();
    let divisor = [
        true, true, false, false, false, true, false, true, true, false, false, true, true, false, false,
        true,
    ];
    for at in 0..bits.len() {
        if rest[at] {
            for (bit, divisor) in rest[at..].iter_mut().zip(divisor) {
                *bit ^= divisor;
            }
        }
    }
    rest[bits.len()..].iter().map(|&bit| if bit { '1' } else { '0' }).collect()
}

proptest! {
    #[test]
    fn bits_are_those_of_the_frame_written_out(
        id in prop_oneof![
            (0..=0x7FF_u16).prop_map(CanId::Standard),
            (0..=0x1FFF_FFFF_u32).prop_map(CanId::Extended),
        ],
        remote: bool,
        data in proptest::collection::vec(prop_oneof![any::<u8>(), Just(0), Just(0xFF)], 0..=8),
    ) {
        let frame = if remote { CanFrame::remote(id, data.len()) } else { CanFrame::new(id, &data) }.unwrap();
        let rtr = u8::from(remote);
        let mut text = match id {
            CanId::Standard(id) => format!("0{id:011b}{rtr}00"),
            CanId::Extended(id) => format!("0{:011b}11{:018b}{rtr}00", id >> 18, id & 0x3_FFFF),
        };
        text += &format!("{:04b}", data.len());
        for byte in data.iter().filter(|_| !remote) {
            text += &format!("{byte:08b}");
        }
        text += &crc_text(&text);
        let bits = frame_bits(&frame);
        prop_assert_eq!(bits as usize, stuffed_length(&text) + 13);
        let len = if remote { 0 } else { data.len() };
        prop_assert!(u64::from(bits) <= can_frame_time(id, len, 1_000_000).as_micros());
    }

    #[test]
    fn no_frame_is_lost_doubled_or_out_of_order(
        sends in proptest::collection::vec((0..200_u64, 0..4_usize, 0..6_u16), 0..60),
    ) {
        let mut wire = Wire::new(Pacing::Bitrate(1_000_000));
        let nodes: Vec<_> = (0..4).map(|_| wire.join()).collect();
        let (mut now, mut given, mut transmitted) = (at(0), vec![Vec::new(); 4], vec![Vec::new(); 4]);
        let mut ends = Vec::new();
        for (nth, (pause, node, id)) in (0_u8..).zip(sends) {
            now += Duration::from_micros(pause);
            let frame = standard(id, &[nth]);
            wire.send(now, nodes[node], frame).unwrap();
            given[node].push(frame);
        }
        while let Some(Transmitted { from, frame, at }) = wire.poll(wire.deadline()) {
            transmitted[nodes.iter().position(|&node| node == from).unwrap()].push(frame);
            ends.push((at, frame_bits(&frame)));
        }
        prop_assert_eq!(given, transmitted);
        for pair in ends.windows(2) {
            prop_assert!(pair[1].0.saturating_since(pair[0].0) >= Duration::from_micros(pair[1].1.into()));
        }
    }
}
