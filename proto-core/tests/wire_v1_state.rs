//! The state packet's bytes, version 1.
//!
//! Don't change me: controllers in the field send these bytes. A change that needs another
//! expectation here is a new format and gets its own file.
//!
//! `vectors/state_v1.hex` was written from the specification's table by a program that shares
//! nothing with this crate: a float is its own offset + 0.25, a dword 0xA0000000 | offset, a word
//! 0x8000 | offset, a bool 1 where the offset divides by 3, a reserved byte its offset's low byte.

use proto_core::sysvar::{IMAGE_BYTES, SysVar};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::scalar::Scalar;
use proto_core::wire::state::{
    LEN, OperationMode, ProgramState, RobotState, SafetyState, StatePacket, StateView, States,
};

fn frozen() -> Vec<u8> {
    let digits: Vec<u8> =
        include_bytes!("vectors/state_v1.hex").iter().filter(|b| **b != b'\n').copied().collect();
    digits.chunks(2).map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}

fn floats<const N: usize>(offset: usize) -> [f32; N] {
    std::array::from_fn(|nth| (offset + 4 * nth) as f32 + 0.25)
}

fn dwords<const N: usize>(offset: usize) -> [u32; N] {
    std::array::from_fn(|nth| 0xA000_0000 | (offset + 4 * nth) as u32)
}

fn words<const N: usize>(offset: usize) -> [u16; N] {
    std::array::from_fn(|nth| 0x8000 | (offset + 2 * nth) as u16)
}

fn bools<const N: usize>(offset: usize) -> [u8; N] {
    std::array::from_fn(|nth| u8::from((offset + nth).is_multiple_of(3)))
}

fn reserved<const N: usize>(offset: usize) -> [u8; N] {
    std::array::from_fn(|nth| (offset + nth) as u8)
}

fn value() -> StatePacket {
    StatePacket {
        joint_position: floats(0),
        joint_velocity: floats(28),
        joint_acceleration: floats(56),
        joint_torque: floats(84),
        target_joint_position: floats(112),
        target_joint_velocity: floats(140),
        target_joint_acceleration: floats(168),
        target_joint_torque: floats(196),
        joint_temperature: floats(224),
        joint_current: floats(252),
        drive_error: dwords(280),
        drive_status: dwords(308),
        reserved_336: reserved(336),
        tcp_pose: floats(368),
        tcp_velocity: floats(392),
        tcp_acceleration: floats(416),
        flange_force: floats(440),
        target_tcp_pose: floats(464),
        target_tcp_velocity: floats(488),
        target_tcp_acceleration: floats(512),
        theoretical_flange_force: floats(536),
        base_force: floats(560),
        theoretical_base_force: floats(584),
        tool_frame: floats(608),
        work_object_frame: floats(632),
        reserved_656: reserved(656),
        functional_inputs: bools(720),
        functional_outputs: bools(728),
        digital_inputs: bools(736),
        digital_outputs: bools(752),
        analog_inputs: floats(768),
        analog_outputs: floats(800),
        float_inputs: floats(832),
        float_outputs: floats(960),
        functional_bool_inputs: bools(1088),
        functional_bool_outputs: bools(1104),
        bool_inputs: bools(1120),
        bool_outputs: bools(1184),
        word_inputs: words(1248),
        word_outputs: words(1312),
        reserved_1376: reserved(1376),
        tool_inputs: bools(1408),
        tool_outputs: bools(1416),
        tool_analog_inputs: floats(1424),
        tool_analog_outputs: floats(1432),
        tool_buttons: bools(1440),
        reserved_1442: reserved(1442),
        operation_mode: 2,
        robot_state: 6,
        program_state: 2,
        safety_state: 5,
        collision: 1,
        collision_axis: 13,
        reserved_1454: reserved(1454),
        error_code: 0xA000_0000 | 1456,
        reserved_1460: reserved(1460),
    }
}

#[test]
fn the_packet_is_these_1468_bytes() {
    let frozen = frozen();
    assert_eq!(frozen.len(), 1468);
    assert_eq!(LEN, 1468);
    let mut out = [0xA5; 1500];
    assert_eq!(value().encode(&mut out), Ok(1468));
    for (offset, (ours, theirs)) in out.iter().zip(&frozen).enumerate() {
        assert_eq!(ours, theirs, "byte {offset}");
    }
    assert!(out[1468..].iter().all(|&byte| byte == 0xA5));
    assert_eq!(StatePacket::parse(&frozen), Ok(value()));
}

#[test]
fn the_states_are_these_codes() {
    let frozen = frozen();
    let states = StateView::new(&frozen).unwrap().states(&Dialect::V2_3);
    let expected = States {
        mode: OperationMode::Remote,
        robot: RobotState::Enable,
        program: ProgramState::Running,
        safety: SafetyState::Run,
    };
    assert_eq!(states, expected);
}

#[test]
fn variables_stand_at_these_places() {
    let frozen = frozen();
    let view = StateView::new(&frozen).unwrap();
    let mut image = [0xA5; IMAGE_BYTES];
    view.copy_to_image(&mut image);
    for (name, expected) in [
        ("RobotState[1]", Scalar::Float(0.25)),
        ("RobotState[7]", Scalar::Float(24.25)),
        ("RobotState[8]", Scalar::Float(368.25)),
        ("RobotState[13]", Scalar::Float(388.25)),
        ("RobotState[14]", Scalar::Float(440.25)),
        ("RobotState[20]", Scalar::Float(608.25)),
        ("RobotState[25]", Scalar::Float(628.25)),
        ("FloatOutputReg[1]", Scalar::Float(960.25)),
        ("FloatOutputReg[32]", Scalar::Float(1084.25)),
        ("WordOutputReg[1]", Scalar::Word(0x8000 | 1312)),
        ("WordOutputReg[32]", Scalar::Word(0x8000 | 1374)),
        // 738, 741, 744 ... divide by 3, and so on.
        ("DigitalSignalStatus[1]", Scalar::Byte(0b0010_0100)),
        ("DigitalSignalStatus[2]", Scalar::Byte(0b0100_1001)),
        ("DigitalSignalStatus[3]", Scalar::Byte(0b0000_0000)),
        ("DigitalSignalStatus[4]", Scalar::Byte(0b1001_0010)),
        ("DigitalSignalStatus[5]", Scalar::Byte(0b0010_0100)),
        ("DigitalSignalStatus[6]", Scalar::Byte(0b0000_0001)),
        ("DigitalSignalStatus[7]", Scalar::Byte(0b0100_1001)),
        ("DigitalSignalStatus[8]", Scalar::Byte(0b1001_0010)),
        ("BitOutputReg[1]", Scalar::Byte(0b0100_1001)),
        ("BitOutputReg[10]", Scalar::Byte(0b0010_0100)),
    ] {
        let var = SysVar::parse(name).unwrap();
        assert_eq!(view.read_var(var), Some(expected), "{name}");
        let place = &image[var.image_offset()..];
        assert_eq!(Scalar::decode(var.ty(), place), Some(expected), "{name} in the image");
    }
    for (name, expected) in [
        ("DigitalOutputCommand[1]", Scalar::Byte(0b1001_0010)),
        ("BitInputReg[3]", Scalar::Byte(0b0010_0100)),
        ("WordInputReg[32]", Scalar::Word(0x8000 | 1310)),
        ("FloatInputReg[2]", Scalar::Float(836.25)),
    ] {
        assert_eq!(view.read_var(SysVar::parse(name).unwrap()), Some(expected), "{name}");
    }
}
