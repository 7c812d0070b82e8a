//! The gateway as a Modbus RTU slave of a PLC.

use proto_core::config::*;
use proto_core::device::{Bits, ByteOrder, Encoding, Kind, Overflow};
use proto_core::engine::{PortId, PortState};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::ModbusPlace;

use crate::line::*;
use crate::rig::*;

fn serves(operation: Operation, written: Span, read: Span) -> Exchange {
    Exchange::new(5, Talk::Served { operation, written, read }, AskWhen::NEVER)
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
