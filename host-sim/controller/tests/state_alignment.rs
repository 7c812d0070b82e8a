//! Counts wrong alignments of the simulated controller's state stream that are not detected: the table of
//! proto-core/docs/wire/state.md section 3.

use std::net::Ipv4Addr;

use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::{LEN, StateStream, StateView};
use recipe_config::{
    AnalogInput, BitGroup, Initial, InitialTarget, Power, Robot, RobotMode, SimConfig, SimProgram,
};
use recipe_controller::motion::HOME;
use recipe_controller::{ConnId, Controller, ControllerInput, ControllerOutput};

/// Poses of different kinds: equal joint positions hide a shift.
const POSES: [(&str, [f64; 6]); 4] = [
    ("home", HOME),
    ("at work", [0.3, -1.2, 1.9, 0.7, 1.5, -0.1]),
    ("far around", [-2.9, -0.4, 2.4, -3.1, -1.2, 5.9]),
    ("zero", [0.0; 6]),
];

#[derive(Debug, Clone, Copy, PartialEq)]
enum Use {
    Nothing,
    Signals,
    Registers,
}

fn var(name: &str, value: f64) -> Initial {
    Initial { target: InitialTarget::Var(SysVar::parse(name).unwrap()), value }
}

fn config(pose: [f64; 6], power: Power, used: Use) -> SimConfig {
    let mode = if power == Power::Enabled { RobotMode::Remote } else { RobotMode::Manual };
    let robot = Robot { power, mode, ..Robot::default() };
    let mut initial: Vec<Initial> =
        (1..).zip(pose).map(|(nth, joint)| var(&format!("RobotState[{nth}]"), joint)).collect();
    let bit = |group, index| Initial { target: InitialTarget::Bit { group, index }, value: 1.0 };
    if used != Use::Nothing {
        let current = InitialTarget::Analog { group: AnalogInput::CabinetCurrent, index: 1 };
        initial.push(Initial { target: current, value: 4.02 });
        initial.push(var("RobotState[22]", 0.12));
        initial.extend([bit(BitGroup::Do, 1), bit(BitGroup::Di, 3), bit(BitGroup::Di, 7)]);
    }
    if used == Use::Registers {
        for nth in 1..=8 {
            initial.push(var(&format!("FloatOutputReg[{nth}]"), f64::from(nth) * 1.7));
            initial.push(var(&format!("WordOutputReg[{nth}]"), f64::from(nth * 517)));
            initial.push(var(&format!("WordInputReg[{nth}]"), f64::from(nth)));
        }
        initial.push(var("BitOutputReg[3]", 85.0));
    }
    SimConfig { robot, initial, ..SimConfig::default() }
}

/// The packets of the first `millis` milliseconds, with commands at given times.
fn packets(config: &SimConfig, commands: &[(u64, &str)], millis: u64) -> Vec<[u8; LEN]> {
    let mut controller = Controller::new(config).unwrap();
    let begin = Instant::from_millis(1_000);
    let mut now = begin;
    controller
        .handle(now, ControllerInput::StateOpened { conn: ConnId(1), from: Ipv4Addr::LOCALHOST.into() });
    controller
        .handle(now, ControllerInput::CommandOpened { conn: ConnId(2), from: Ipv4Addr::LOCALHOST.into() });
    let mut commands =
        commands.iter().map(|&(at, text)| (begin + Duration::from_millis(at), text)).peekable();
    let mut packets = vec![];
    loop {
        match controller.poll_output(now) {
            ControllerOutput::StatePacket { bytes } => packets.push(*bytes),
            ControllerOutput::Sleep { until } => {
                let next = commands.next_if(|command| command.0 <= until);
                now = next.map_or(until, |command| command.0);
                if now > begin + Duration::from_millis(millis) {
                    return packets;
                }
                let bytes = next.map_or("", |command| command.1).as_bytes();
                controller.handle(now, ControllerInput::CommandBytes { conn: ConnId(2), bytes });
            }
            _ => {}
        }
    }
}

/// Numbers of wrong alignments that are not detected.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Unseen {
    /// By a check of six joint positions and the bools only.
    by_joints_and_bools: usize,
    /// By a check of a single packet.
    by_itself: usize,
    /// In a stream that was aligned before.
    in_a_stream: usize,
}

impl Unseen {
    fn of(packet: &[u8; LEN]) -> Self {
        let mut unseen = Self::default();
        for lost in 1..LEN {
            let shifted: [u8; LEN] = std::array::from_fn(|at| packet[(at + lost) % LEN]);
            unseen.by_joints_and_bools += usize::from(has_joints_and_bools(&shifted));
            let alone = StateView::from_array(&shifted).check_alignment().is_ok();
            unseen.by_itself += usize::from(alone);
            // Bytes are lost between two packets: all later packets are shifted.
            let mut stream = StateStream::new();
            let bytes = [&packet[..], &packet[lost..], &packet[..], &packet[..], &packet[..]].concat();
            let mut rest = &bytes[..];
            while !stream.is_lost() && stream.next_packet(&mut rest).is_some() {}
            assert!(alone || stream.is_lost());
            unseen.in_a_stream += usize::from(!stream.is_lost());
        }
        unseen
    }
}

fn has_joints_and_bools(packet: &[u8; LEN]) -> bool {
    let joints = packet[..24].chunks(4).map(|joint| f32::from_le_bytes(joint.try_into().unwrap()));
    let bools = [720..768, 1088..1248, 1408..1410, 1416..1418, 1440..1442];
    joints.into_iter().all(|joint| joint.abs() <= 1000.0)
        && bools.into_iter().flatten().filter(|&at| packet[at] > 1).count() <= 8
}

#[test]
fn every_wrong_alignment_of_a_resting_robots_stream_is_detected() {
    let mut written = String::new();
    for (name, pose) in POSES {
        for (power, used) in [
            (Power::Enabled, Use::Nothing),
            (Power::Enabled, Use::Registers),
            (Power::Enabled, Use::Signals),
            (Power::On, Use::Nothing),
            (Power::Off, Use::Nothing),
        ] {
            let packet = packets(&config(pose, power, used), &[], 1_000).pop().unwrap();
            assert_eq!(StateView::from_array(&packet).check_alignment(), Ok(()));
            let unseen = Unseen::of(&packet);
            assert_eq!(unseen.in_a_stream, 0, "{name}, {power:?}, {used:?}");
            let registers = match (power, used) {
                (Power::Enabled, Use::Nothing) => "0",
                (Power::Enabled, Use::Registers) => "in use",
                _ => continue,
            };
            let Unseen { by_joints_and_bools, by_itself, in_a_stream } = unseen;
            written +=
                &format!("| {name} | {registers} | {by_joints_and_bools} | {by_itself} | {in_a_stream} |\n");
        }
    }
    let page =
        std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../proto-core/docs/wire/state.md"))
            .unwrap();
    assert!(page.contains(&written), "proto-core/docs/wire/state.md has another table than\n{written}");
}

#[test]
fn one_packet_at_most_is_wrong_wherever_bytes_are_lost() {
    let packet = packets(&config(POSES[1].1, Power::Enabled, Use::Signals), &[], 1_000).pop().unwrap();
    let mut mixed = 0;
    for cut in (0..LEN).step_by(29) {
        for lost in (1..LEN).step_by(7) {
            let sent = [&packet[..]; 7].concat();
            let received = [&sent[..LEN + cut], &sent[LEN + cut + lost..]].concat();
            let mut stream = StateStream::new();
            let (mut rest, mut wrong) = (&received[..], 0);
            while !stream.is_lost() {
                let next = stream.next_packet(&mut rest).expect("it is lost before the bytes end");
                wrong += usize::from(next.is_ok_and(|view| *view.as_bytes() != packet));
            }
            assert!(wrong <= 1, "{lost} bytes lost at {cut}: {wrong} wrong packets");
            mixed += wrong;
        }
    }
    // The packet from which bytes were lost, since its first part is correct.
    assert!(mixed > 0);
}

#[test]
fn every_packet_of_the_simulated_controller_is_aligned() {
    let mut config = config(POSES[1].1, Power::Off, Use::Registers);
    config.robot.mode = RobotMode::Remote;
    let script =
        "movej([-2.0, -0.4, 2.4, -3.1, -1.2, 5.9], 3.1); movej([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 3.1);";
    config.programs.push(SimProgram { name: "m".to_owned(), script: script.to_owned() });
    let commands =
        [(500, "poweron()"), (1_500, "enable()"), (2_500, "run(m)"), (4_000, "pause()"), (5_000, "resume()")];
    let packets = packets(&config, &commands, 12_000);
    let (first, last) = (packets.first().unwrap(), packets.last().unwrap());
    assert_eq!((first[1449], last[1449]), (4, 6), "it was switched on");
    assert_eq!(last[..24], [0; 24], "it moved");
    let mut stream = StateStream::new();
    for packet in &packets {
        let mut rest = &packet[..];
        assert_eq!(stream.next_packet(&mut rest).unwrap().map(|_| ()), Ok(()));
    }
}
