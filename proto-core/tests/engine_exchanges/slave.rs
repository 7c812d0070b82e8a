//! The gateway as a Modbus RTU slave of a PLC.

use proptest::collection::vec;
use proptest::prelude::*;
use proto_core::config::*;
use proto_core::device::{Bits, ByteOrder, Encoding, Kind, Overflow};
use proto_core::engine::{Input, PortId, PortState};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::ModbusPlace;
use proto_core::time::Duration;

use crate::line::*;
use crate::rig::*;

fn serves(operation: Operation, written: Span, read: Span) -> Exchange {
    Exchange::new(5, Transaction::Served { operation, written, read }, Triggers::NEVER)
}

fn coil(nth: u8, to: InputBinding) -> FieldSpec {
    let kind = Kind::Bits(Bits { bytes: 1, first: nth, count: 1, signed: false });
    let encoding = Encoding { kind, order: ByteOrder::Little, shared: nth > 0 };
    FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to }
}

/// Slave 5: a PLC writes registers 0 and 1 and coils 0..=2, and reads registers 16 and 17.
fn plc() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let setpoints = cell.fields([register_to("WordInputReg[1]"), register_to("WordInputReg[2]")]);
    let buttons = cell.fields([
        coil(0, to("WordInputReg[3]")),
        coil(1, to("WordInputReg[4]")),
        coil(2, InputBinding::Unused),
    ]);
    let state = cell.fields([register_from("WordOutputReg[1]"), register_from("WordOutputReg[2]")]);
    let table = [
        serves(Operation::WriteRegisters { address: 0, count: 2 }, setpoints, Span::default()),
        serves(Operation::WriteCoils { address: 0, count: 3 }, buttons, Span::default()),
        serves(Operation::ReadInputRegisters { address: 16, count: 2 }, Span::default(), state),
    ];
    let port = talking(&mut cell, &table);
    let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!() };
    line.idle_gap = proto_core::time::Duration::from_micros(1_750);
    cell.safe("WordInputReg[1]", 9.0);
    (cell.rig(), port)
}

fn asks(rig: &mut Rig, port: PortId, request: &[u8]) -> Vec<Vec<u8>> {
    rig.bytes(port, &with_crc(request));
    assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new(), "before the line is silent");
    rig.run(MS(3));
    rig.sent_to(port)
}

#[test]
fn a_master_writes_a_block_and_the_robot_has_it() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    let write = [5, 16, 0, 0, 0, 2, 4, 0, 44, 1, 0];
    assert_eq!(asks(&mut rig, port, &write), [with_crc(&write[..6])]);
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![44, 256])]);
    assert_eq!(asks(&mut rig, port, &[5, 15, 0, 0, 0, 3, 1, 0b101]), [with_crc(&[5, 15, 0, 0, 0, 3])]);
    assert_eq!(rig.take_written(), [Written::Registers(10, vec![1, 0])]);
    assert_eq!(rig.engine.port_state(port), Some(PortState::Working));
    // The PLC is gone.
    rig.run(MS(300));
    assert_eq!(rig.map.registers[8], 9);
    assert_eq!(rig.engine.port_state(port), Some(PortState::Silent));
}

#[test]
fn a_port_that_is_gone_serves_nothing() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    rig.input(Input::PortDown { port });
    rig.run(MS(10));
    let write = with_crc(&[5, 16, 0, 0, 0, 2, 4, 0, 44, 1, 0]);
    rig.bytes(port, &write);
    // Something else has a deadline meanwhile.
    rig.run(MS(500));
    assert_eq!(rig.take_written(), []);
    assert_eq!(rig.counters(port).discarded_bytes, write.len() as u32);
    rig.input(Input::PortUp { port });
    rig.run(MS(10));
    assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new());
    assert_eq!(asks(&mut rig, port, &write[..11]), [with_crc(&write[..6])]);
}

#[test]
fn a_part_of_a_block_a_wrong_crc_and_another_slave_write_nothing() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    assert_eq!(asks(&mut rig, port, &[5, 6, 0, 0, 0, 1]), [with_crc(&[5, 0x86, 2])]);
    assert_eq!(asks(&mut rig, port, &[5, 16, 0, 1, 0, 2, 4, 0, 1, 0, 2]), [with_crc(&[5, 0x90, 2])]);
    assert_eq!(asks(&mut rig, port, &[6, 16, 0, 0, 0, 2, 4, 0, 1, 0, 2]), Vec::<Vec<u8>>::new());
    let mut wrong = with_crc(&[5, 16, 0, 0, 0, 2, 4, 0, 1, 0, 2]);
    wrong[8] ^= 4;
    rig.bytes(port, &wrong);
    rig.run(MS(3));
    assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new());
    assert_eq!(rig.take_written(), []);
    let counters = rig.counters(port);
    assert_eq!((counters.refused, counters.rejected_checksum, counters.frames_in), (2, 1, 0));
    assert_eq!(counters.rejected_other_device, 1);
}

#[test]
fn what_is_not_known_is_not_read() {
    let (mut rig, port) = plc();
    rig.modbus_answers = false;
    rig.run(MS(10));
    let read = [5, 4, 0, 16, 0, 2];
    assert_eq!(asks(&mut rig, port, &read), [with_crc(&[5, 0x84, 4])], "nobody knows the value");
    rig.modbus_answers = true;
    for (nth, value) in [(1, 7), (2, 0x1234)] {
        let place = var(&format!("WordOutputReg[{nth}]")).modbus().unwrap();
        let ModbusPlace::Register { address } = place else { panic!() };
        rig.map.registers[usize::from(address)] = value;
    }
    rig.run(MS(5_000));
    assert_eq!(asks(&mut rig, port, &read), [with_crc(&[5, 4, 4, 0, 7, 0x12, 0x34])]);
    assert_eq!(asks(&mut rig, port, &[5, 4, 0, 17, 0, 1]), [with_crc(&[5, 4, 2, 0x12, 0x34])], "a part");
    assert_eq!(asks(&mut rig, port, &[5, 4, 0, 17, 0, 2]), [with_crc(&[5, 0x84, 2])], "beyond the block");
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 16, 0, 2]), [with_crc(&[5, 0x83, 2])], "another table");
}

#[test]
fn a_master_reads_back_what_it_wrote() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 0, 0, 2]), [with_crc(&[5, 0x83, 4])], "nothing was written");
    asks(&mut rig, port, &[5, 16, 0, 0, 0, 2, 4, 0, 44, 1, 0]);
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 0, 0, 2]), [with_crc(&[5, 3, 4, 0, 44, 1, 0])]);
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 1, 0, 1]), [with_crc(&[5, 3, 2, 1, 0])], "a part");
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 1, 0, 2]), [with_crc(&[5, 0x83, 2])], "beyond it");
    assert_eq!(asks(&mut rig, port, &[5, 1, 0, 0, 0, 3]), [with_crc(&[5, 0x81, 4])], "no coils were written");
    asks(&mut rig, port, &[5, 15, 0, 0, 0, 3, 1, 0b101]);
    assert_eq!(asks(&mut rig, port, &[5, 1, 0, 1, 0, 2]), [with_crc(&[5, 1, 1, 0b10])], "the last two coils");
    // A write that is refused changes nothing, and each block has its own place.
    asks(&mut rig, port, &[5, 6, 0, 0, 0, 1]);
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 0, 0, 2]), [with_crc(&[5, 3, 4, 0, 44, 1, 0])]);
    // The safe values change what the robot has, not what the master wrote.
    rig.run(MS(300));
    assert_eq!(asks(&mut rig, port, &[5, 3, 0, 0, 0, 1]), [with_crc(&[5, 3, 2, 0, 44])]);
}

#[test]
fn a_broadcast_is_written_and_not_answered() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    assert_eq!(asks(&mut rig, port, &[0, 16, 0, 0, 0, 2, 4, 0, 3, 0, 4]), Vec::<Vec<u8>>::new());
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![3, 4])]);
}

#[test]
fn a_reply_is_too_late_when_the_line_goes_on() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    rig.reports_sent = false;
    let write = [5, 16, 0, 0, 0, 2, 4, 0, 1, 0, 2];
    // The first reply never leaves, so the second waits.
    assert_eq!(asks(&mut rig, port, &write).len(), 1);
    assert_eq!(asks(&mut rig, port, &write).len(), 0);
    rig.bytes(port, &with_crc(&[7, 4, 0, 0, 0, 1]));
    rig.input(proto_core::engine::Input::PortSent { port });
    rig.run(MS(5));
    assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new());
}

#[test]
fn what_came_while_the_line_was_not_there_is_not_answered() {
    let (mut rig, port) = plc();
    rig.run(MS(10));
    rig.input(proto_core::engine::Input::PortDown { port });
    rig.take_written();
    rig.bytes(port, &with_crc(&[5, 16, 0, 0, 0, 2, 4, 0, 1, 0, 2]));
    rig.now += MS(40);
    rig.input(proto_core::engine::Input::PortUp { port });
    rig.run(MS(10));
    assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new());
    assert!(!rig.take_written().contains(&Written::Registers(8, vec![1, 2])));
    assert_eq!(rig.counters(port).discarded_bytes, 13);
}

/// The words of right requests in these bytes that write registers 0 and 1 of slave 5 or of all of them,
/// wherever they stand.
fn whole_blocks(bytes: &[u8]) -> Vec<[u16; 2]> {
    let word = |pair: &[u8]| u16::from_be_bytes([pair[0], pair[1]]);
    let frames = bytes.windows(13).filter(|frame| {
        matches!(frame[0], 0 | 5) && frame[1..7] == [16, 0, 0, 0, 2, 4] && with_crc(&frame[..11]) == **frame
    });
    frames.map(|frame| [word(&frame[7..9]), word(&frame[9..11])]).collect()
}

/// What a master sends, without its CRC: mostly a write of registers.
fn request() -> impl Strategy<Value = Vec<u8>> {
    let slave = prop_oneof![6 => Just(5_u8), 1 => Just(0), 1 => Just(6)];
    let function = prop_oneof![6 => Just(16_u8), 1 => Just(6), 1 => Just(23), 1 => 0..24_u8];
    let place = prop_oneof![6 => Just((0_u8, 2_u8)), 1 => (0..3_u8, 0..4_u8)];
    (slave, function, place, any::<[u8; 4]>()).prop_map(|(slave, function, (address, count), words)| {
        let mut request = vec![slave, function, 0, address, 0, count];
        if matches!(function, 15 | 16) {
            let len = usize::from(count) * 2;
            request.push(len as u8);
            request.extend(words.iter().cycle().take(len));
        }
        request
    })
}

#[derive(Debug, Clone)]
enum Says {
    Right(Vec<u8>),
    Damaged(Vec<u8>, u8, u8),
    /// Two without a silence between them.
    Both(Vec<u8>, Vec<u8>),
    Noise(Vec<u8>),
}

impl Says {
    fn bytes(&self) -> Vec<u8> {
        match self {
            Self::Right(request) => with_crc(request),
            Self::Damaged(request, at, change) => {
                let mut frame = with_crc(request);
                let at = usize::from(*at) % frame.len();
                frame[at] ^= change;
                frame
            }
            Self::Both(one, other) => [with_crc(one), with_crc(other)].concat(),
            Self::Noise(bytes) => bytes.clone(),
        }
    }
}

fn says() -> impl Strategy<Value = Says> {
    prop_oneof![
        3 => request().prop_map(Says::Right),
        2 => (request(), any::<u8>(), 1..=255_u8).prop_map(|(of, at, change)| Says::Damaged(of, at, change)),
        1 => (request(), request()).prop_map(|(one, other)| Says::Both(one, other)),
        1 => vec(prop_oneof![any::<u8>(), Just(5), Just(16), Just(0)], 0..40).prop_map(Says::Noise),
    ]
}

proptest! {
    #[test]
    fn only_a_right_request_for_a_whole_block_changes_values(
        bursts in vec((says(), 1..20_usize, any::<bool>()), 1..30),
    ) {
        let (mut rig, port) = plc();
        rig.run(MS(10));
        // Safe values are not what this is about.
        rig.take_written();
        let mut allowed = Vec::new();
        let mut all = Vec::new();
        for (says, piece, is_silent) in &bursts {
            let bytes = says.bytes();
            all.extend_from_slice(&bytes);
            allowed.extend(whole_blocks(&all).into_iter().filter(|words| !allowed.contains(words)).collect::<Vec<_>>());
            for piece in bytes.chunks(*piece) {
                rig.bytes(port, piece);
                rig.run(Duration::from_micros(95 * piece.len() as u64));
            }
            rig.run(if *is_silent { MS(4) } else { Duration::from_micros(500) });
            let written = rig.take_written();
            for written in &written {
                match written {
                    Written::Registers(8, words) => {
                        let is_safe = words.first() == Some(&9);
                        let words = words.clone();
                        prop_assert!(is_safe || allowed.iter().any(|block| block[..].starts_with(&words)), "{words:?}");
                    }
                    // The second register by itself, or the coils.
                    Written::Registers(9, words) => {
                        prop_assert!(allowed.iter().any(|block| block[1..] == words[..]), "{words:?}");
                    }
                    Written::Registers(10 | 11, words) => prop_assert!(words.iter().all(|word| *word <= 1)),
                    other => prop_assert!(false, "{other:?}"),
                }
            }
        }
        // Whatever came: a right request is carried out and answered.
        rig.run(MS(4));
        rig.sent_to(port);
        rig.take_written();
        let write = [5, 16, 0, 0, 0, 2, 4, 0x12, 0x34, 0x56, 0x78];
        prop_assert_eq!(asks(&mut rig, port, &write), [with_crc(&write[..6])]);
        prop_assert_eq!(&rig.map.registers[8..10], [0x1234, 0x5678]);
    }
}
