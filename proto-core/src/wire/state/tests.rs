use std::prelude::rust_2024::*;
use std::{format, vec};

use proptest::prelude::*;

use super::{Content, FIELDS, LEN, MAX_MISALIGNED, StateError, StatePacket, StateStream, StateView};
use crate::wire::dialect::Dialect;

/// A packet identified by its error code.
fn numbered(number: u32) -> [u8; LEN] {
    StatePacket { error_code: number, joint_position: [0.5; 7], ..StatePacket::ZERO }.to_bytes()
}

#[test]
fn the_table_covers_the_packet() {
    assert_eq!(FIELDS.iter().map(|field| field.size()).sum::<usize>(), LEN);
    let bools: usize = FIELDS
        .iter()
        .map(|f| if let Content::Bools { real } = f.content { real } else { 0 })
        .map(usize::from)
        .sum();
    assert_eq!(bools, 214);
}

#[test]
fn only_packets_of_the_right_length_are_looked_at() {
    for len in [0, 1, LEN - 1, LEN + 1, 2 * LEN] {
        let bytes = vec![0; len];
        let wrong = StateError::WrongLength { expected: LEN, actual: len };
        assert_eq!(StateView::new(&bytes).map(|_| ()), Err(wrong));
        assert_eq!(StatePacket::parse(&bytes), Err(wrong));
    }
    let mut short = [0xA5; LEN - 1];
    let wrong = StateError::WrongLength { expected: LEN, actual: LEN - 1 };
    assert_eq!(StatePacket::ZERO.encode(&mut short), Err(wrong));
    assert!(short.iter().all(|&byte| byte == 0xA5));
}

#[test]
fn states_and_global_speed_follow_the_dialect() {
    let mut packet = StatePacket { safety_state: 99, robot_state: 7, ..StatePacket::ZERO };
    packet.reserved_656[4] = 55;
    let bytes = packet.to_bytes();
    let view = StateView::from_array(&bytes);
    assert_eq!(format!("{:?}", view.states(&Dialect::V2_3).safety), "Unknown(99)");
    assert_eq!(format!("{:?}", view.states(&Dialect::V2_6).safety), "Update");
    assert_eq!(format!("{:?}", view.states(&Dialect::V2_6).robot), "Update");
    assert_eq!(view.global_speed(&Dialect::V2_3), None);
    assert_eq!(view.global_speed(&Dialect::V2_6), Some(55));
}

#[test]
fn the_stream_is_cut_at_every_byte() {
    let stream = [numbered(1), numbered(2)].concat();
    for cut in 0..=stream.len() {
        let mut packets = StateStream::new();
        let mut seen = vec![];
        for mut piece in [&stream[..cut], &stream[cut..]] {
            while let Some(packet) = packets.next_packet(&mut piece) {
                seen.push(packet.unwrap().error_code());
            }
            assert!(piece.is_empty());
            assert_eq!(packets.pending(), if seen.len() == 2 { 0 } else { cut % LEN });
        }
        assert_eq!(seen, [1, 2], "cut at {cut}");
    }
}

#[test]
fn whole_packets_are_not_copied() {
    let stream = [numbered(1), numbered(2)].concat();
    let mut chunk = &stream[..];
    let mut packets = StateStream::new();
    for nth in 0..2 {
        let view = packets.next_packet(&mut chunk).unwrap().unwrap();
        assert!(core::ptr::eq(view.as_bytes().as_slice(), &stream[nth * LEN..(nth + 1) * LEN]));
    }
}

#[test]
fn three_misaligned_packets_in_a_row_lose_the_connection() {
    let mut packets = StateStream::new();
    let bad = [0xFF; LEN];
    let feed = |packets: &mut StateStream, bytes: &[u8; LEN]| {
        let mut chunk = &bytes[..];
        let good = packets.next_packet(&mut chunk).unwrap().is_ok();
        assert!(packets.next_packet(&mut chunk).is_none());
        good
    };
    for _ in 0..MAX_MISALIGNED - 1 {
        assert!(!feed(&mut packets, &bad));
        assert!(!packets.is_lost());
    }
    assert!(feed(&mut packets, &numbered(7)));
    assert_eq!(packets.misaligned_in_a_row(), 0);
    for nth in 1..=MAX_MISALIGNED {
        assert!(!feed(&mut packets, &bad));
        assert_eq!(packets.misaligned_in_a_row(), nth);
    }
    assert!(packets.is_lost());
    assert!(packets.next_packet(&mut &bad[..100]).is_none());
    packets.reset();
    assert_eq!((packets.is_lost(), packets.pending()), (false, 0));
    assert!(feed(&mut packets, &numbered(8)));
    assert_eq!((packets.packets(), packets.misaligned()), (2, 5));
}

proptest! {
    #[test]
    fn every_packet_survives(bytes in prop::collection::vec(any::<u8>(), LEN)) {
        let packet = StatePacket::parse(&bytes).unwrap();
        prop_assert_eq!(&packet.to_bytes()[..], &bytes[..]);
        let _ = StateView::new(&bytes).unwrap().check_alignment();
    }

    #[test]
    fn pieces_of_any_size_give_the_same_packets(sizes in prop::collection::vec(1usize..3000, 1..40), garbage: u8) {
        let stream = [numbered(1), [garbage; LEN], numbered(3), numbered(4), numbered(5)].concat();
        let mut one = StateStream::new();
        let mut expected = vec![];
        let mut chunk = &stream[..];
        while let Some(packet) = one.next_packet(&mut chunk) {
            expected.push(packet.ok().map(|view| view.error_code()));
        }
        let mut packets = StateStream::new();
        let mut seen = vec![];
        let mut rest = &stream[..];
        for size in sizes.into_iter().cycle() {
            let (mut piece, behind) = rest.split_at(size.min(rest.len()));
            rest = behind;
            while let Some(packet) = packets.next_packet(&mut piece) {
                seen.push(packet.ok().map(|view| view.error_code()));
            }
            if rest.is_empty() {
                break;
            }
        }
        prop_assert_eq!(seen, expected);
        prop_assert_eq!(packets.misaligned(), one.misaligned());
    }
}
