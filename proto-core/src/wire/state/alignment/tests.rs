use std::prelude::rust_2024::*;
use std::{format, println, vec};

use super::super::places::QUANTITIES;
use super::super::{Content, FIELDS, LEN, MAX_MISALIGNED, StatePacket, StateStream, StateView};
use super::*;
use crate::wire::scalar::ScalarType;

fn judge(bytes: &[u8; LEN]) -> Result<(), Misaligned> {
    StateView::from_array(bytes).check_alignment()
}

/// Remote, enabled, stopped, running.
const STARTED: StatePacket =
    StatePacket { operation_mode: 2, robot_state: 6, safety_state: 5, ..StatePacket::ZERO };

#[test]
fn a_joint_or_two_may_be_unreadable_and_three_may_not() {
    for (position, good) in [(1000.0, true), (-1000.0, true), (1000.1, false), (f32::NAN, false)] {
        for count in 1..=6 {
            let mut packet = STARTED;
            packet.joint_position[6 - count..6].fill(position);
            let expected = good || count <= 2;
            match judge(&packet.to_bytes()) {
                Ok(()) => assert!(expected, "{count} joints at {position}"),
                Err(Misaligned::JointPosition { wrong, allowed, joint, position: named }) => {
                    assert!(!expected, "{count} joints at {position}");
                    assert_eq!((usize::from(wrong), allowed, usize::from(joint)), (count, 2, 7 - count));
                    assert_eq!(named.to_bits(), position.to_bits());
                }
                other => assert_eq!(other, Ok(())),
            }
        }
    }
    let mut packet = STARTED;
    packet.joint_position = [f32::INFINITY, 0.0, 0.0, 0.0, 0.0, f32::NAN, f32::NAN];
    assert_eq!(judge(&packet.to_bytes()), Ok(()), "the 7th is reserved");
}

#[test]
fn eight_bools_may_be_something_else() {
    for packet in [StatePacket::ZERO, STARTED] {
        let mut bytes = packet.to_bytes();
        for field in FIELDS {
            let Content::Bools { real } = field.content else { continue };
            let (first, real) = (usize::from(field.offset), usize::from(real));
            bytes[first + real..first + field.size()].fill(0xFF);
        }
        assert_eq!(judge(&bytes), Ok(()), "reserved bools are not looked at");
        for place in [720, 735, 767, 1088, 1247, 1408, 1417, 1441] {
            bytes[place] = 2;
        }
        assert_eq!(judge(&bytes), Ok(()), "8 are allowed");
        bytes[1184] = 0xFF;
        assert_eq!(judge(&bytes), Err(Misaligned::Bools { wrong: 9, allowed: 8 }));
    }
}

#[test]
fn only_a_started_controllers_codes_spare_the_closer_look() {
    // Three quantities that no robot can have.
    let strange = StatePacket { tcp_velocity: [f32::NAN, 1e9, 1e-40, 0.0, 0.0, 0.0], ..StatePacket::ZERO };
    let wrong = Err(Misaligned::Quantities { wrong: 3, allowed: 2 });
    for (codes, expected) in [
        ([0, 0, 0, 0], wrong),
        ([2, 6, 0, 5], Ok(())),
        ([0, 4, 0, 4], Ok(())),
        ([1, 7, 5, 15], Ok(())),
        ([2, 6, 0, 99], Ok(())),
        ([3, 6, 0, 5], Ok(())),
        ([2, 8, 0, 5], Ok(())),
        ([2, 6, 6, 5], Ok(())),
        ([2, 6, 0, 16], Ok(())),
        ([3, 8, 0, 5], wrong),
        ([2, 6, 6, 16], wrong),
        ([2, 0, 0, 5], wrong),
        ([2, 6, 0, 0], wrong),
        ([1, 1, 1, 1], wrong),
        ([255, 255, 255, 255], wrong),
    ] {
        let mut packet = strange;
        [packet.operation_mode, packet.robot_state, packet.program_state, packet.safety_state] = codes;
        assert_eq!(judge(&packet.to_bytes()), expected, "{codes:?}");
    }
}

#[test]
fn the_closer_look_sees_every_quantity_and_nothing_else() {
    for field in FIELDS {
        let quantity = QUANTITIES.iter().find(|quantity| quantity.0 == field.name);
        let (items, most) = quantity.map_or((0, 1000.0), |&(_, items, most)| (items, most));
        let size = field.ty.size();
        for item in 0..usize::from(field.count) {
            if field.ty != ScalarType::Float {
                continue;
            }
            let least = f32::from_bits(LEAST as u32);
            for (value, possible) in [
                (0.0, true),
                (most, true),
                (least, true),
                (1e-33, true),
                (most.next_up(), false),
                (least.next_down(), false),
                (1e-45, false),
                (f32::INFINITY, false),
                (f32::NAN, false),
            ] {
                for value in [value, -value] {
                    // Two others are already wrong.
                    let mut bytes = StatePacket::ZERO.to_bytes();
                    let place = usize::from(field.offset) + item * size;
                    let others = if field.name == "tcp_pose" { [464, 468] } else { [368, 372] };
                    for place in others {
                        bytes[place..place + 4].copy_from_slice(&f32::NAN.to_le_bytes());
                    }
                    bytes[place..place + 4].copy_from_slice(&value.to_le_bytes());
                    let name = field.name;
                    if possible || item >= items {
                        assert_eq!(judge(&bytes), Ok(()), "{name}[{item}] {value}");
                    } else {
                        let wrong = Misaligned::Quantities { wrong: 3, allowed: 2 };
                        assert_eq!(judge(&bytes), Err(wrong), "{name}[{item}] {value}");
                    }
                }
            }
        }
    }
}

#[test]
fn a_place_that_changes_with_the_codes_is_another_packets() {
    let at = |joint: f32, x: f32, codes: [u8; 4]| {
        let mut packet = StatePacket { joint_position: [joint; 7], ..StatePacket::ZERO };
        packet.tcp_pose[0] = x;
        [packet.operation_mode, packet.robot_state, packet.program_state, packet.safety_state] = codes;
        packet.to_bytes()
    };
    let on = [2, 6, 0, 5];
    for (next, good) in [
        // The position jumps, but the codes stay: packets were lost, for example.
        (at(2.0, 1.0, on), true),
        // The robot was switched off without moving.
        (at(0.3, 0.3, [2, 4, 0, 5]), true),
        (at(0.8, 0.8, [0; 4]), true),
        (at(0.801, 0.3, [0; 4]), false),
        (at(0.3, 0.801, [0; 4]), false),
        (at(-0.201, 0.3, [255; 4]), false),
        (at(-0.201, 0.3, [2, 4, 0, 5]), false),
        // A program started with another tool.
        (at(0.3, -0.201, [2, 6, 2, 5]), true),
        // An unreadable position is not compared.
        (at(f32::NAN, 0.3, [0; 4]), false),
        (at(0.3, f32::NAN, [0; 4]), true),
        (at(0.3, f32::NEG_INFINITY, [0; 4]), true),
    ] {
        let mut stream = StateStream::new();
        assert!(stream.next_packet(&mut &at(0.3, 0.3, on)[..]).unwrap().is_ok());
        assert_eq!(stream.next_packet(&mut &next[..]).unwrap().is_ok(), good);
    }
    // Rejected each time, until the connection is reset.
    let mut stream = StateStream::new();
    assert!(stream.next_packet(&mut &at(0.3, 0.3, on)[..]).unwrap().is_ok());
    for nth in 1..=MAX_MISALIGNED {
        let elsewhere = Misaligned::Elsewhere { distance: 1.5, allowed: 0.5 };
        assert_eq!(stream.next_packet(&mut &at(1.8, 0.3, [0; 4])[..]).unwrap().unwrap_err(), elsewhere);
        assert_eq!(stream.misaligned_in_a_row(), nth);
    }
    stream.reset();
    assert!(stream.next_packet(&mut &at(1.8, 0.3, [0; 4])[..]).unwrap().is_ok());
    // Before a started controller's codes were seen, any change is accepted.
    assert!(stream.next_packet(&mut &at(-1.8, 0.3, [0, 1, 0, 0])[..]).unwrap().is_ok());
    assert!(stream.next_packet(&mut &at(1.8, 0.3, on)[..]).unwrap().is_ok());
    // Codes of a mode that the table does not have: the robot moves far, in small steps.
    for nth in 0..100 {
        let next = at(1.8 - 0.4 * nth as f32, 0.3, [9, 9, 9, 9]);
        assert!(stream.next_packet(&mut &next[..]).unwrap().is_ok(), "{nth}");
    }
    assert_eq!(stream.misaligned(), MAX_MISALIGNED);
}

#[test]
fn the_reasons_are_sentences() {
    for (misaligned, text) in [
        (
            Misaligned::JointPosition { wrong: 3, allowed: 2, joint: 4, position: f32::NAN },
            "3 joint positions are not within ±1000 rad, the first that of joint 4, NaN rad; at most 2 may be so",
        ),
        (Misaligned::Bools { wrong: 9, allowed: 8 }, "9 bool bytes are neither 0 nor 1; at most 8"),
        (
            Misaligned::Quantities { wrong: 7, allowed: 2 },
            "7 quantities are impossible, and the state codes are not a started controller's; at most 2",
        ),
        (
            Misaligned::Elsewhere { distance: 1.5, allowed: 0.5 },
            "the state codes have changed, and the arm is 1.5 rad or m from where it was one packet ago; at most 0.5",
        ),
    ] {
        assert_eq!(format!("{misaligned}"), text);
    }
}

#[test]
fn the_page_has_the_same_limits() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/wire/state.md");
    let page = std::fs::read_to_string(path).unwrap();
    let section = page.split("\n## ").find(|section| section.starts_with("3. Is it a packet?")).unwrap();
    let mut written = vec![];
    let rows = section.lines().skip_while(|line| !line.starts_with("| fields |")).skip(2);
    for row in rows.take_while(|line| line.starts_with('|')) {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let most: f32 = cells[2].split(' ').next().unwrap().parse().unwrap();
        let names = cells[1].split('`').skip(1).step_by(2);
        written.extend(names.map(|name| (String::from(name), most)));
    }
    let mut expected: Vec<(String, f32)> =
        QUANTITIES.iter().map(|&(name, _, most)| (String::from(name), most)).collect();
    let by_name = |a: &(String, f32), b: &(String, f32)| a.0.cmp(&b.0);
    written.sort_by(by_name);
    expected.sort_by(by_name);
    assert_eq!(written, expected);
}

/// Shifts `packet` by each number of bytes. Counts how often the shifted packet passes on its own, and how often it
/// passes for good in a stream that was aligned before.
#[track_caller]
fn unseen(packet: &[u8; LEN]) -> (usize, usize) {
    let (mut by_itself, mut for_good) = (0, 0);
    for lost in 1..LEN {
        let shifted: [u8; LEN] = core::array::from_fn(|at| packet[(at + lost) % LEN]);
        by_itself += usize::from(judge(&shifted).is_ok());
        let mut stream = StateStream::new();
        assert!(stream.next_packet(&mut &packet[..]).unwrap().is_ok());
        for _ in 0..MAX_MISALIGNED {
            let _ = stream.next_packet(&mut &shifted[..]);
        }
        for_good += usize::from(!stream.is_lost());
    }
    println!("{by_itself} of {} pass by themselves, {for_good} in a stream", LEN - 1);
    (by_itself, for_good)
}

#[test]
fn a_resting_robots_stream_is_not_taken_for_another() {
    // Noisy encoders, currents and sensors, and a controller that computes all quantities.
    let mut noisy = STARTED;
    noisy.joint_position = [0.30012, -1.20047, 1.90003, 0.69991, 1.50078, -0.10021, 0.0];
    noisy.target_joint_position = [0.3, -1.2, 1.9, 0.7, 1.5, -0.1, 0.0];
    noisy.joint_velocity = [1.1e-4, -3.2e-4, 2.7e-5, 8.8e-4, -1.9e-4, 4.4e-4, 0.0];
    noisy.joint_torque = [0.31, 41.27, 17.93, 1.12, -0.27, 0.05, 0.0];
    noisy.target_joint_torque = [0.0, 41.13, 18.02, 1.15, 0.0, 0.0, 0.0];
    noisy.joint_temperature = [31.4, 32.6, 32.1, 34.2, 34.5, 35.1, 0.0];
    noisy.joint_current = [2.1, 275.4, 163.2, 40.3, -9.7, 1.8, 0.0];
    noisy.drive_status = [0x0637; 7];
    noisy.tcp_pose = [0.4101, -0.2003, 0.6299, 3.1007, 0.0204, -1.5698];
    noisy.target_tcp_pose = [0.41, -0.2, 0.63, 3.1, 0.02, -1.57];
    noisy.flange_force = [0.7, -1.2, 0.4, 0.03, -0.01, 0.02];
    noisy.tool_frame = [0.0, 0.0, 0.12, 0.0, 0.0, 0.0];
    noisy.analog_inputs = [4.01, 0.003, 0.002, 0.004, 0.011, 0.012, 0.009, 0.01];
    // Without noise, as from another simulator.
    let mut still = noisy;
    still.joint_position = still.target_joint_position;
    still.joint_velocity = [0.0; 7];
    still.joint_torque = still.target_joint_torque;
    still.tcp_pose = still.target_tcp_pose;
    (still.flange_force, still.analog_inputs) = ([0.0; 6], [0.0; 8]);
    let used = |packet: &StatePacket| StatePacket {
        digital_inputs: [1; 16],
        digital_outputs: core::array::from_fn(|nth| u8::from(nth == 2)),
        float_outputs: core::array::from_fn(|nth| if nth < 8 { nth as f32 * 1.7 } else { 0.0 }),
        word_outputs: core::array::from_fn(|nth| nth as u16 * 517),
        ..*packet
    };
    for (packet, most) in [(noisy, 20), (still, 60), (used(&noisy), 20), (used(&still), 60)] {
        let (by_itself, for_good) = unseen(&packet.to_bytes());
        assert!(by_itself <= most, "{by_itself}");
        assert_eq!(for_good, 0);
    }
    // A packet of zeros except for its codes cannot be told from a shifted one.
    assert!(unseen(&STARTED.to_bytes()).1 > 1400);
}
