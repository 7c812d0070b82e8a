//! Bits with owners in random runs, against what each device has sent.

use proptest::prelude::*;
use proto_core::engine::{LinkId, PortId};
use proto_core::link::LinkState;
use proto_core::time::Instant;

use super::rig::{Cell, MS, Rig, Written};
use super::{BYTE, COILS, SILENT, device, frame, packet, robot, safe_bit, sent, set_robot};

/// What happens in a random run.
#[derive(Debug, Clone, Copy)]
enum Step {
    /// A device sends a frame.
    Frame {
        device: usize,
        value: u8,
    },
    /// The robot's program changes bits that nobody owns.
    Program {
        value: u8,
    },
    /// The state packet, which shows the byte as it was one packet ago.
    Packet,
    Run {
        ms: u64,
    },
    /// The link is lost.
    Lost,
    /// The controller's Modbus server is slow: so many frames come before it answers.
    Slow {
        frames: [(usize, u8); 5],
    },
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        6 => (0..3_usize, any::<u8>()).prop_map(|(device, value)| Step::Frame { device, value }),
        1 => any::<u8>().prop_map(|value| Step::Program { value }),
        3 => Just(Step::Packet),
        4 => (0..40_u64).prop_map(|ms| Step::Run { ms }),
        1 => (90..250_u64).prop_map(|ms| Step::Run { ms }),
        1 => Just(Step::Lost),
        2 => prop::array::uniform5((0..3_usize, any::<u8>())).prop_map(|frames| Step::Slow { frames }),
    ];
    prop::collection::vec(step, 1..60)
}

/// The bits of the three devices; bit 7 is nobody's. Those of the second are no neighbours.
const MASKS: [u8; 3] = [0b0000_0111, 0b0010_1000, 0b0101_0000];
/// Their safe values; the third device holds.
const SAFE: [Option<u8>; 3] = [Some(0b0000_0010), Some(0b0010_0000), None];

fn bits_of(mask: u8) -> Vec<u8> {
    (0..8).filter(|bit| mask >> bit & 1 == 1).collect()
}

fn three(udp: bool) -> (Rig, Vec<PortId>) {
    let mut cell = Cell::new();
    let mut ports = Vec::new();
    for (mask, safe) in MASKS.into_iter().zip(SAFE) {
        ports.push(device(&mut cell, &bits_of(mask)));
        for bit in safe.into_iter().flat_map(|_| bits_of(mask)) {
            safe_bit(&mut cell, bit, safe.unwrap_or(0) >> bit & 1 == 1);
        }
    }
    if udp {
        let up = cell.stream(&[BYTE], &[]);
        cell.recipe_link(up);
    }
    (cell.rig(), ports)
}

/// The reference: each device's bits of the robot are the last ones that it sent while the link was
/// up, or its safe ones; each value that is written was sent, in that order; and nobody's bits are
/// never changed.
fn play(udp: bool, steps: &[Step]) -> Result<(), TestCaseError> {
    let (mut rig, ports) = three(udp);
    let link = if udp { LinkId::RECIPE_UDP } else { LinkId::MODBUS };
    set_robot(&mut rig, 0b1000_0000);
    rig.run(MS(10));
    let mut shown = [0b1000_0000; 2];
    let mut last: [Option<(u8, Instant, bool)>; 3] = [None; 3];
    // What the devices may have written: all values that they ever sent, and their safe ones.
    let mut allowed: [Vec<u8>; 3] = [vec![], vec![], vec![]];
    for (allowed, safe) in allowed.iter_mut().zip(SAFE) {
        allowed.extend(safe);
    }
    let mut nobodys = 0x80;
    let end = [Step::Run { ms: 20 }, Step::Packet, Step::Packet, Step::Run { ms: 20 }];
    for step in steps.iter().chain(&end) {
        let before = robot(&rig);
        match *step {
            Step::Frame { device, value } => {
                let values: Vec<u8> = bits_of(MASKS[device]).iter().map(|bit| value >> bit & 1).collect();
                let is_up = matches!(rig.link(link).state, LinkState::Up { .. });
                last[device] = Some((value & MASKS[device], rig.now, is_up));
                allowed[device].push(value & MASKS[device]);
                rig.bytes(ports[device], &frame(&values));
            }
            Step::Program { value } => {
                nobodys = value & 0x80;
                let byte = robot(&rig) & 0x7F | nobodys;
                set_robot(&mut rig, byte);
                continue;
            }
            Step::Slow { frames } => {
                let is_up = matches!(rig.link(link).state, LinkState::Up { .. });
                rig.modbus_answers = false;
                rig.sent_on(LinkId::MODBUS);
                let mut edges: [Vec<u8>; 3] = MASKS.map(|mask| vec![before & mask]);
                for (device, value) in frames {
                    let values: Vec<u8> = bits_of(MASKS[device]).iter().map(|bit| value >> bit & 1).collect();
                    last[device] = Some((value & MASKS[device], rig.now, is_up));
                    allowed[device].push(value & MASKS[device]);
                    edges[device].push(value & MASKS[device]);
                    rig.bytes(ports[device], &frame(&values));
                }
                // One answer after the other: each bit goes through every value that was sent.
                let mut seen: [Vec<u8>; 8] = Default::default();
                let mut note = |rig: &Rig| {
                    (0..8).for_each(|bit: usize| seen[bit].push(robot(rig) >> bit & 1));
                };
                note(&rig);
                while let Some(request) = rig.sent_on(LinkId::MODBUS).pop() {
                    let answer = rig.answer(&request);
                    note(&rig);
                    rig.link_bytes(LinkId::MODBUS, &answer);
                }
                rig.modbus_answers = true;
                for (mask, edges) in MASKS.iter().zip(&edges).filter(|_| !udp && is_up) {
                    for bit in bits_of(*mask) {
                        let mut sent: Vec<u8> = edges.iter().map(|value| value >> bit & 1).collect();
                        let mut seen = seen[usize::from(bit)].clone();
                        sent.dedup();
                        seen.dedup();
                        prop_assert_eq!(seen, sent, "bit {}", bit);
                    }
                }
            }
            Step::Packet => {
                shown = [shown[1], robot(&rig)];
                rig.link_bytes(LinkId::STATE, &packet(shown[0]));
            }
            Step::Run { ms } => rig.run(MS(ms)),
            Step::Lost => {
                rig.input(proto_core::engine::Input::LinkDown { link });
                last.iter_mut().flatten().for_each(|(_, _, is_passed_on)| *is_passed_on = false);
            }
        }
        if udp {
            for byte in sent(&mut rig) {
                // Nobody's bits are as a packet of the last half second showed them.
                set_robot(&mut rig, byte);
                prop_assert!(byte & 0x80 == nobodys || shown.iter().any(|s| s & 0x80 == byte & 0x80));
                for (mask, allowed) in MASKS.iter().zip(&allowed) {
                    let own = byte & mask;
                    let is_shown = shown.iter().any(|s| s & mask == own) || own == before & mask;
                    prop_assert!(is_shown || allowed.contains(&own), "{own:08b} was never sent");
                }
            }
            nobodys = robot(&rig) & 0x80;
        } else {
            for write in rig.take_written() {
                let Written::Coils(at, values) = write else { panic!("{write:?}") };
                let run = (0..values.len()).fold(0_u8, |run, nth| run | 1 << (usize::from(at - COILS) + nth));
                prop_assert_eq!(run & 0x80, 0, "nobody's bit was written");
            }
            prop_assert_eq!(robot(&rig) & 0x80, nobodys);
        }
    }
    for (device, last) in last.iter().enumerate() {
        if let Some((value, at, true)) = *last
            && rig.now.saturating_since(at) < MS(SILENT)
        {
            prop_assert_eq!(robot(&rig) & MASKS[device], value, "device {}", device);
        }
    }
    // All devices are silent, and the link comes up again: the safe values arrive.
    for _ in 0..80 {
        rig.run(MS(100));
        for byte in sent(&mut rig) {
            set_robot(&mut rig, byte);
        }
        shown = [shown[1], robot(&rig)];
        rig.link_bytes(LinkId::STATE, &packet(shown[0]));
    }
    for ((last, safe), mask) in last.iter().zip(SAFE).zip(MASKS) {
        if let (Some(_), Some(safe)) = (last, safe) {
            prop_assert_eq!(robot(&rig) & mask, safe);
        }
    }
    // By a recipe link nobody's bits go round with the packets that show them.
    prop_assert!(udp || robot(&rig) & 0x80 == nobodys);
    prop_assert!(sent(&mut rig).is_empty(), "every safe value is shown");
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn by_modbus_the_robots_bits_are_the_last_that_each_owner_sent(steps in steps()) {
        play(false, &steps)?;
    }

    #[test]
    fn by_a_recipe_link_too(steps in steps()) {
        play(true, &steps)?;
    }
}
