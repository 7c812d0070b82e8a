use std::vec;
use std::vec::Vec;

use super::adu::seal;
use super::operation::{Expected, Probe};
use super::*;
use crate::modbus::Exception;
use crate::modbus::pdu::PduEncodeError;
use crate::sysvar::Direction;
use crate::time::Duration;

/// The example of the standard's appendix on the CRC: slave 2, function 7.
#[test]
fn the_crc_is_the_standards() {
    assert_eq!(checksum(&[0x02, 0x07]), 0x1241);
    let frame = [0x02, 0x07, 0x41, 0x12];
    assert_eq!(Adu::parse(&frame), Ok(Adu { address: 2, pdu: &[7] }));
    let mut out = [0xA5; 6];
    assert_eq!(Adu { address: 2, pdu: &[7] }.encode(&mut out), Ok(4));
    assert_eq!(out, [0x02, 0x07, 0x41, 0x12, 0xA5, 0xA5]);
    assert_eq!(seal(&mut out, 5), None);

    let swapped = [0x02, 0x07, 0x12, 0x41];
    assert_eq!(Adu::parse(&swapped), Err(AduError::Checksum { expected: 0x1241, received: 0x4112 }));
    assert_eq!(Adu::parse(&frame[..3]), Err(AduError::Length { received: 3 }));
    assert_eq!(Adu::parse(&[0; 257]), Err(AduError::Length { received: 257 }));
    let no_space = PduEncodeError::NoSpace { needed: 4, available: 3 };
    assert_eq!(Adu { address: 2, pdu: &[7] }.encode(&mut [0; 3]), Err(no_space));
}

/// Operation, data, request's PDU, reply's PDU.
type Example = (Operation, &'static [u8], &'static [u8], &'static [u8]);

/// The examples of the standard's section 6, byte for byte. Don't change them. That of FC 22 has 0x25 as its bits, of
/// which 0x20 are kept.
const EXAMPLES: [Example; 10] = [
    (
        Operation::ReadCoils { address: 0x13, count: 0x13 },
        &[],
        &[0x01, 0x00, 0x13, 0x00, 0x13],
        &[0x01, 0x03, 0xCD, 0x6B, 0x05],
    ),
    (
        Operation::ReadDiscreteInputs { address: 0xC4, count: 0x16 },
        &[],
        &[0x02, 0x00, 0xC4, 0x00, 0x16],
        &[0x02, 0x03, 0xAC, 0xDB, 0x35],
    ),
    (
        Operation::ReadHoldingRegisters { address: 0x6B, count: 3 },
        &[],
        &[0x03, 0x00, 0x6B, 0x00, 0x03],
        &[0x03, 0x06, 0x02, 0x2B, 0x00, 0x00, 0x00, 0x64],
    ),
    (
        Operation::ReadInputRegisters { address: 8, count: 1 },
        &[],
        &[0x04, 0x00, 0x08, 0x00, 0x01],
        &[0x04, 0x02, 0x00, 0x0A],
    ),
    (
        Operation::WriteCoil { address: 0xAC },
        &[1],
        &[0x05, 0x00, 0xAC, 0xFF, 0x00],
        &[0x05, 0x00, 0xAC, 0xFF, 0x00],
    ),
    (
        Operation::WriteRegister { address: 1 },
        &[0x00, 0x03],
        &[0x06, 0x00, 0x01, 0x00, 0x03],
        &[0x06, 0x00, 0x01, 0x00, 0x03],
    ),
    (
        Operation::WriteCoils { address: 0x13, count: 10 },
        &[0xCD, 0x01],
        &[0x0F, 0x00, 0x13, 0x00, 0x0A, 0x02, 0xCD, 0x01],
        &[0x0F, 0x00, 0x13, 0x00, 0x0A],
    ),
    (
        Operation::WriteRegisters { address: 1, count: 2 },
        &[0x00, 0x0A, 0x01, 0x02],
        &[0x10, 0x00, 0x01, 0x00, 0x02, 0x04, 0x00, 0x0A, 0x01, 0x02],
        &[0x10, 0x00, 0x01, 0x00, 0x02],
    ),
    (
        Operation::ReadWriteRegisters { read_address: 3, read_count: 6, write_address: 0x0E, write_count: 3 },
        &[0x00, 0xFF, 0x00, 0xFF, 0x00, 0xFF],
        &[0x17, 0x00, 0x03, 0x00, 0x06, 0x00, 0x0E, 0x00, 0x03, 0x06, 0x00, 0xFF, 0x00, 0xFF, 0x00, 0xFF],
        &[0x17, 0x0C, 0x00, 0xFE, 0x0A, 0xCD, 0x00, 0x01, 0x00, 0x03, 0x00, 0x0D, 0x00, 0xFF],
    ),
    (
        Operation::MaskWriteRegister { address: 4, mask: !0x00F2 },
        &[0x00, 0x25],
        &[0x16, 0x00, 0x04, 0x00, 0xF2, 0x00, 0x05],
        &[0x16, 0x00, 0x04, 0x00, 0xF2, 0x00, 0x05],
    ),
];

fn framed(address: u8, pdu: &[u8]) -> Vec<u8> {
    let crc = ::crc::Crc::<u16>::new(&::crc::CRC_16_MODBUS);
    let mut frame = [&[address], pdu].concat();
    let crc = crc.checksum(&frame);
    frame.extend(crc.to_le_bytes());
    frame
}

/// The request's frame with this data.
fn request(operation: &Operation, slave: u8, data: &[u8]) -> Vec<u8> {
    let mut out = [0xA5; MAX_ADU];
    let len = operation
        .encode(slave, &mut out, |target| {
            assert!(target.iter().all(|&byte| byte == 0));
            target.copy_from_slice(data);
            true
        })
        .unwrap();
    assert!(out[len..].iter().all(|&byte| byte == 0xA5));
    out[..len].to_vec()
}

#[test]
fn requests_and_replies_are_the_standards_examples() {
    for (operation, data, request_pdu, reply_pdu) in EXAMPLES {
        assert_eq!(operation.written_len(), data.len());
        let sent = request(&operation, 17, data);
        assert_eq!(sent, framed(17, request_pdu), "{operation:?}");
        assert_eq!((operation.request_len(), request_len(&sent)), (sent.len(), FrameLen::Known(sent.len())));

        let reply = framed(17, reply_pdu);
        assert_eq!((operation.reply_len(), reply_len(&reply)), (reply.len(), FrameLen::Known(reply.len())));
        let expected = Expected::of(&operation, &sent).unwrap();
        assert_eq!(expected.probe(&reply), Probe::Reply(reply.len()));
        for cut in 0..reply.len() {
            assert_eq!(expected.probe(&reply[..cut]), Probe::Partial, "{operation:?} cut at {cut}");
        }
        for at in 0..reply.len() {
            let mut changed = reply.clone();
            changed[at] ^= 1;
            assert!(matches!(expected.probe(&changed), Probe::No | Probe::Wrong), "{operation:?} byte {at}");
        }
        let refused = framed(17, &[operation.function() | 0x80, 0x02]);
        assert_eq!(expected.probe(&refused), Probe::Refused(Exception::IllegalDataAddress));
        assert_eq!(reply_len(&refused), FrameLen::Known(5));
        assert!(Expected::of(&operation, &request(&operation, 0, data)).is_none(), "a broadcast");
    }
}

#[test]
fn without_values_there_is_no_request() {
    for (operation, data, ..) in EXAMPLES.into_iter().filter(|(_, data, ..)| !data.is_empty()) {
        assert_eq!(operation.encode(1, &mut [0; MAX_ADU], |_| false), None, "{operation:?} {data:?}");
    }
    let off = request(&Operation::WriteCoil { address: 1 }, 1, &[0xFE]);
    assert_eq!(off[2..6], [0, 1, 0, 0], "the lowest bit counts");
    let masked = request(&Operation::WriteCoils { address: 1, count: 3 }, 1, &[0xFF]);
    assert_eq!(masked[6..8], [1, 0b111]);
}

#[test]
fn a_length_that_is_not_known_says_what_is_missing() {
    assert_eq!(request_len(&[1]), FrameLen::NeedsBytes(2));
    assert_eq!(request_len(&[1, 16, 0, 0, 0, 1]), FrameLen::NeedsBytes(7));
    assert_eq!(request_len(&[1, 23]), FrameLen::NeedsBytes(11));
    assert_eq!(request_len(&[1, 0x2B]), FrameLen::Unknown);
    assert_eq!(request_len(&[1, 16, 0, 0, 0, 1, 255]), FrameLen::Unknown, "264 bytes");
    assert_eq!(reply_len(&[1, 3]), FrameLen::NeedsBytes(3));
    assert_eq!(reply_len(&[1, 3, 252]), FrameLen::Unknown);
    assert_eq!(reply_len(&[1, 3, 251]), FrameLen::Known(256));
    assert_eq!(reply_len(&[1, 0x2B]), FrameLen::Unknown);
    assert_eq!(reply_len(&[1, 0xAB]), FrameLen::Known(5));
}

#[test]
fn silences_are_the_standards() {
    let micros = |timing: Timing| (timing.t1_5().as_micros(), timing.silence().as_micros());
    // 11 bits at 9600 bit/s take 1.1458 ms.
    assert_eq!(micros(Timing::new(9_600, 11)), (1_719, 4_011));
    assert_eq!(micros(Timing::new(19_200, 11)), (860, 2_006));
    assert_eq!(micros(Timing::new(19_201, 11)), (750, 1_750));
    assert_eq!(micros(Timing::new(115_200, 10)), (750, 1_750));
    assert_eq!(Timing::new(9_600, 10).of(8), Duration::from_micros(8_334));
    assert_eq!(Timing::new(0, 0).of(1), Duration::from_secs(1), "nothing divides by zero");
    let timing = Timing::new(9_600, 11).with_silence(Duration::from_millis(20));
    assert_eq!(timing.silence(), Duration::from_millis(20));
    assert_eq!(timing.turnaround(), Duration::from_millis(100));
    assert_eq!(timing.with_turnaround(Duration::ZERO).turnaround(), Duration::ZERO);
}

#[test]
fn a_count_is_within_the_functions_limits() {
    let limits = [
        (Operation::ReadCoils { address: 0, count: 2001 }, 2001, 2000),
        (Operation::ReadDiscreteInputs { address: 0, count: 0 }, 0, 2000),
        (Operation::ReadHoldingRegisters { address: 0, count: 126 }, 126, 125),
        (Operation::WriteCoils { address: 0, count: 1969 }, 1969, 1968),
        (Operation::WriteRegisters { address: 0, count: 124 }, 124, 123),
        (read_write(125, 122), 122, 121),
        (read_write(126, 121), 126, 125),
        (read_write(0, 0), 0, 121),
    ];
    for (operation, count, max) in limits {
        assert_eq!(operation.check(), Err(CountError { count, max }));
    }
    assert_eq!(read_write(125, 121).check(), Ok(()));
}

fn read_write(read_count: u16, write_count: u16) -> Operation {
    Operation::ReadWriteRegisters { read_address: 0, read_count, write_address: 0, write_count }
}

#[test]
fn a_slave_has_an_address_of_its_own() {
    let slave = |address| Slave::new(Timing::new(9_600, 11), Echo::Absent, address).is_some();
    assert!(slave(1) && slave(247));
    assert!(!slave(0) && !slave(248) && !slave(255));
}

#[test]
fn the_largest_frames_fit() {
    for operation in [
        Operation::ReadCoils { address: 0, count: 2000 },
        Operation::ReadHoldingRegisters { address: 0, count: 125 },
        Operation::WriteCoils { address: 0, count: 1968 },
        Operation::WriteRegisters { address: 0, count: 123 },
        read_write(125, 121),
    ] {
        let data = vec![0x55; operation.written_len()];
        assert_eq!(request(&operation, 1, &data).len(), operation.request_len());
        assert!(operation.request_len() <= MAX_ADU && operation.reply_len() <= MAX_ADU);
    }
}

#[test]
fn an_operation_is_made_from_its_function_or_its_block() {
    let made = |code: &u8| Operation::of_function(*code, (1, 2), (3, 4), 5).map(|one| one.function());
    let known: Vec<u8> = (0..=255).filter(|code| made(code) == Some(*code)).collect();
    assert_eq!(known, [1, 2, 3, 4, 5, 6, 15, 16, 22, 23]);
    assert!((0..=255).all(|code| made(&code).is_none_or(|function| function == code)));
    for table in [Table::Coils, Table::DiscreteInputs, Table::HoldingRegisters, Table::InputRegisters] {
        let output = Operation::of_block(table, Direction::Output, 7, 3);
        assert!(output.place() == (table, 7, 3) && output.reads());
        let is_writable = matches!(table, Table::Coils | Table::HoldingRegisters);
        let input = Operation::of_block(table, Direction::Input, 7, 3);
        assert!(input.place() == (table, 7, 3) && input.reads() != is_writable);
    }
}
