//! Frozen Modbus TCP frames. They are what controllers and clients out there send: a change that
//! makes one of them fail is a change of the protocol, and wrong.

use proto_core::modbus::adu::{Adu, AduReader, MAX_ADU};
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::pdu::{Request, Response, exception_pdu};
use proto_core::modbus::{Coils, Exception, Registers};

/// The bytes written as hex, blanks ignored.
fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
    let value = |digit: u8| (digit as char).to_digit(16).unwrap() as u8;
    digits.chunks(2).map(|pair| value(pair[0]) << 4 | value(pair[1])).collect()
}

/// A request's frame as the client sends it first, and what its answer is read as.
#[track_caller]
fn exchange(request: Request<'_>, request_frame: &str, answer_frame: &str, expected: ClientEvent<'_>) {
    let (request_frame, answer_frame) = (hex(request_frame), hex(answer_frame));
    let mut client = Client::new(1);
    let mut out = [0xA5; MAX_ADU];
    let len = client.start(request, &mut out).unwrap();
    assert_eq!(out[..len], request_frame, "request as sent");
    assert!(out[len..].iter().all(|&byte| byte == 0xA5), "wrote past the frame");

    let mut reader = AduReader::new();
    let adu = reader.next_adu(&mut &request_frame[..]).unwrap().unwrap();
    assert_eq!((adu.transaction, adu.unit), (1, 1));
    assert_eq!(Request::parse(adu.pdu), Ok(request), "request as a server reads it");

    assert_eq!(client.receive(&mut &answer_frame[..]), Some(expected), "answer as the client reads it");
    let mut reader = AduReader::new();
    let Adu { pdu, .. } = reader.next_adu(&mut &answer_frame[..]).unwrap().unwrap();
    let mut out = [0xA5; MAX_ADU];
    match expected {
        ClientEvent::Response(response) => {
            let len = response.encode(&mut out).unwrap();
            assert_eq!(out[..len], *pdu, "answer as a server encodes it");
        }
        ClientEvent::Exception(exception) => {
            assert_eq!(exception_pdu(request_frame[7], exception), *pdu);
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn fc_1_reads_coils() {
    exchange(
        Request::ReadCoils { address: 192, count: 16 },
        "0001 0000 0006 01 01 00C0 0010",
        "0001 0000 0005 01 01 02 01 80",
        ClientEvent::Response(Response::Coils(Coils::new(&[0x01, 0x80], 16).unwrap())),
    );
    exchange(
        Request::ReadCoils { address: 216, count: 2 },
        "0001 0000 0006 01 01 00D8 0002",
        "0001 0000 0004 01 01 01 02",
        ClientEvent::Response(Response::Coils(Coils::new(&[0x02], 2).unwrap())),
    );
}

#[test]
fn fc_3_reads_holding_registers() {
    exchange(
        Request::ReadHolding { address: 106, count: 3 },
        "0001 0000 0006 01 03 006A 0003",
        "0001 0000 0009 01 03 06 EAC3 1683 3024",
        ClientEvent::Response(Response::Registers(
            Registers::new(&[0xEA, 0xC3, 0x16, 0x83, 0x30, 0x24]).unwrap(),
        )),
    );
}

#[test]
fn fc_5_writes_a_coil() {
    exchange(
        Request::WriteCoil { address: 192, value: true },
        "0001 0000 0006 01 05 00C0 FF00",
        "0001 0000 0006 01 05 00C0 FF00",
        ClientEvent::Response(Response::WroteCoil { address: 192, value: true }),
    );
    exchange(
        Request::WriteCoil { address: 193, value: false },
        "0001 0000 0006 01 05 00C1 0000",
        "0001 0000 0006 01 05 00C1 0000",
        ClientEvent::Response(Response::WroteCoil { address: 193, value: false }),
    );
}

#[test]
fn fc_6_writes_a_register() {
    exchange(
        Request::WriteRegister { address: 8, value: 0xBEEF },
        "0001 0000 0006 01 06 0008 BEEF",
        "0001 0000 0006 01 06 0008 BEEF",
        ClientEvent::Response(Response::WroteRegister { address: 8, value: 0xBEEF }),
    );
}

#[test]
fn fc_15_writes_coils() {
    exchange(
        Request::WriteCoils { address: 192, coils: Coils::new(&[0x5A, 0xC3], 16).unwrap() },
        "0001 0000 0009 01 0F 00C0 0010 02 5A C3",
        "0001 0000 0006 01 0F 00C0 0010",
        ClientEvent::Response(Response::WroteCoils { address: 192, count: 16 }),
    );
    exchange(
        Request::WriteCoils { address: 32, coils: Coils::new(&[0xFF, 0xFF], 10).unwrap() },
        "0001 0000 0009 01 0F 0020 000A 02 FF 03",
        "0001 0000 0006 01 0F 0020 000A",
        ClientEvent::Response(Response::WroteCoils { address: 32, count: 10 }),
    );
}

#[test]
fn fc_16_writes_registers() {
    exchange(
        Request::WriteRegisters { address: 8, registers: Registers::new(&[0, 1, 0xFF, 0xFE]).unwrap() },
        "0001 0000 000B 01 10 0008 0002 04 0001 FFFE",
        "0001 0000 0006 01 10 0008 0002",
        ClientEvent::Response(Response::WroteRegisters { address: 8, count: 2 }),
    );
}

#[test]
fn exceptions_carry_the_function_and_a_code() {
    for (code, exception) in [
        ("01", Exception::IllegalFunction),
        ("02", Exception::IllegalDataAddress),
        ("03", Exception::IllegalDataValue),
        ("04", Exception::DeviceFailure),
        ("05", Exception::Acknowledge),
        ("06", Exception::DeviceBusy),
        ("08", Exception::MemoryParity),
        ("0A", Exception::GatewayPathUnavailable),
        ("0B", Exception::GatewayTargetSilent),
        ("63", Exception::Unknown(0x63)),
    ] {
        exchange(
            Request::WriteRegister { address: 40, value: 1 },
            "0001 0000 0006 01 06 0028 0001",
            &format!("0001 0000 0003 01 86 {code}"),
            ClientEvent::Exception(exception),
        );
    }
}
