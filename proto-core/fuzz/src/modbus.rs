//! Modbus TCP, both sides: any bytes in any pieces (docs/wire/modbus.md sections 2 to 6).

use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{self, Client, ClientEvent};
use proto_core::modbus::pdu::{Request, Response};
use proto_core::modbus::server::Server;
use proto_core::modbus::{Coils, Registers};

use crate::reference_modbus::{self as reference, Bank, Got};
use crate::source::{Source, cut};

/// Bytes of a connection that one input may lead to.
const LONGEST: usize = 8 * 1024;

/// The server.
pub(crate) fn run_server(input: &[u8]) {
    let mut input = Source::new(input);
    let how = input.u8();
    let mut stream = Vec::new();
    while !input.is_empty() && stream.len() < LONGEST {
        let op = input.u8();
        if op % 4 == 3 {
            stream.extend(input.run());
            continue;
        }
        let mut frame = request(&mut input, op);
        match op % 4 {
            1 => {
                let at = input.below(frame.len());
                frame[at] ^= input.u8();
            }
            // Cut or lengthened, with a header that agrees.
            2 => {
                frame.resize(8 + input.below(253), op);
                frame[5] = (frame.len() - 6) as u8;
            }
            _ => {}
        }
        stream.extend(frame);
    }
    let (mut bank, mut expected) = (Bank::new(), Bank::new());
    let (answers, closed) = reference::server(&mut expected, &stream);
    let (mut server, mut sent) = (Server::new(), Vec::new());
    let mut out = [0xA5; MAX_ADU];
    for chunk in cut(&stream, how) {
        let (mut rest, mut before) = (chunk, chunk.len());
        while let Some(answered) = server.receive(&mut rest, &mut bank, &mut out) {
            assert!(rest.len() < before, "a request was found and nothing was taken");
            before = rest.len();
            let Ok(len) = answered else {
                assert!(rest.is_empty(), "what follows a header that cannot be is dropped");
                assert!(closed, "{answered:?}");
                assert_eq!(sent, answers);
                return assert_eq!(bank, expected);
            };
            sent.extend_from_slice(&out[..len]);
        }
        assert!(rest.is_empty(), "None means that all was taken");
    }
    assert!(!closed);
    assert_eq!(sent, answers);
    assert_eq!(bank, expected);
}

/// A request's frame; some are outside the limits or the map.
fn request(input: &mut Source<'_>, op: u8) -> Vec<u8> {
    let function = [1, 3, 5, 6, 15, 16, 2, 0x81][usize::from(op >> 5)];
    let (id, unit, address, count) = (input.u16(), input.u8(), input.u16(), input.u16());
    // Near the map more often than not.
    let address = if op & 16 == 0 { address % 310 } else { address };
    let mut pdu = [&[function], &address.to_be_bytes()[..], &count.to_be_bytes()].concat();
    if function > 6 && function < 0x80 {
        let count = count % 64 + 1;
        pdu[3..5].copy_from_slice(&count.to_be_bytes());
        let len = if function == 15 { count.div_ceil(8) } else { 2 * count } as usize;
        pdu.push(len as u8);
        pdu.extend(input.take(len));
        pdu.resize(6 + len, 0);
    }
    adu(id, unit, &pdu)
}

fn adu(id: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let [high, low] = (pdu.len() as u16 + 1).to_be_bytes();
    [&id.to_be_bytes()[..], &[0, 0, high, low, unit], pdu].concat()
}

/// The client.
pub(crate) fn run_client(input: &[u8]) {
    let mut input = Source::new(input);
    let (how, unit) = (input.u8(), input.u8());
    let (mut client, mut expected) = (Client::new(unit), reference::Client::new(unit));
    let mut bank = Bank::new();
    // The newest request as it was sent.
    let mut sent = Vec::new();
    let mut work = 0;
    while !input.is_empty() && work < LONGEST {
        let op = input.u8();
        let mut stream = Vec::new();
        match op % 8 {
            0 | 1 => start(&mut client, &mut expected, &mut input, op, &mut sent),
            // The right answer, or a changed one.
            2..=4 if !sent.is_empty() => {
                let mut answer = reference::server(&mut bank, &sent).0;
                if op % 8 != 2 {
                    let at = input.below(answer.len());
                    answer[at] ^= input.u8();
                }
                if op % 8 == 4 {
                    answer.resize(8 + input.below(32), op);
                    answer[5] = answer.len() as u8 - 6;
                    if op & 8 != 0 && answer.len() > 8 {
                        answer[8] = answer.len() as u8 - 9;
                    }
                }
                stream = answer;
            }
            5 => {
                client.abort();
                expected.in_flight = None;
            }
            6 => {
                client.reset();
                expected.reset();
            }
            _ => stream = input.run().to_vec(),
        }
        work += stream.len() + 1;
        for chunk in cut(&stream, how) {
            receive(&mut client, &mut expected, chunk);
        }
        assert_eq!(client.busy(), expected.in_flight.is_some());
        let head = client.in_flight().map(|head| (head.function, head.address, head.count_or_value));
        assert_eq!(head, expected.in_flight);
        assert_eq!(client.stale_answers(), expected.stale);
    }
}

fn start(
    client: &mut Client,
    expected: &mut reference::Client,
    input: &mut Source<'_>,
    op: u8,
    sent: &mut Vec<u8>,
) {
    let (kind, address, count) = (input.below(8), input.u16(), input.u16());
    let data = input.take(usize::from(op >> 4) + 1);
    let mut packed = [0; 250];
    let data = if data.is_empty() { &[0] } else { data };
    let words = data.iter().map(|&byte| u16::from(byte) * 0x0101);
    let (request, function, last) = match kind {
        0 | 6 => (Request::ReadCoils { address, count }, 1, count),
        1 | 7 => (Request::ReadHolding { address, count }, 3, count),
        2 => {
            let value = count & 1 == 1;
            (Request::WriteCoil { address, value }, 5, if value { 0xFF00 } else { 0 })
        }
        3 => (Request::WriteRegister { address, value: count }, 6, count),
        4 => {
            let count = (8 * data.len() as u16).saturating_sub(count & 7).max(1);
            let coils = Coils::new(data, count).expect("so many coils are there");
            (Request::WriteCoils { address, coils }, 15, count)
        }
        _ => {
            let registers = Registers::pack(words, &mut packed).expect("at most 16 words");
            (Request::WriteRegisters { address, registers }, 16, registers.count())
        }
    };
    let in_limits = match function {
        1 => (1..=2000).contains(&count),
        3 => (1..=125).contains(&count),
        _ => true,
    };
    let mut out = [0xA5; MAX_ADU];
    let started = client.start(request, &mut out);
    if expected.in_flight.is_some() {
        return assert_eq!(started, Err(client::StartError::Busy));
    }
    assert_eq!(started.is_ok(), in_limits, "{request:?}: {started:?}");
    let Ok(len) = started else { return };
    let id = expected.start(function, address, last);
    assert!(out[len..].iter().all(|&byte| byte == 0xA5), "nothing past the frame is written");
    let head = [&[function][..], &address.to_be_bytes(), &last.to_be_bytes()].concat();
    assert_eq!(out[..2], id.to_be_bytes());
    assert_eq!(out[2..6], [0, 0, 0, (len - 6) as u8]);
    assert_eq!(out[7..12], head);
    assert_eq!(Request::parse(&out[7..len]), Ok(request));
    *sent = out[..len].to_vec();
}

fn receive(client: &mut Client, expected: &mut reference::Client, chunk: &[u8]) {
    let request = client.in_flight();
    let (mut rest, mut before, mut got) = (chunk, chunk.len(), Vec::new());
    while let Some(event) = client.receive(&mut rest) {
        assert!(rest.len() < before, "an answer was found and nothing was taken");
        before = rest.len();
        got.push(match event {
            ClientEvent::Exception(exception) => Got::Exception(exception.code()),
            ClientEvent::Violation(_) => Got::Violation,
            ClientEvent::Response(response) => {
                let mut out = [0xA5; MAX_ADU];
                let len = response.encode(&mut out).expect("what was read can be written");
                let head = request.expect("only a request is answered");
                assert_eq!(Response::parse(head, &out[..len]), Ok(Ok(response)));
                Got::Response(out[..len].to_vec())
            }
        });
    }
    assert!(rest.is_empty(), "None means that all was taken");
    let wanted = expected.receive(chunk);
    // The bits beyond the last coil may come as anything and are sent as 0.
    let masked = |got: &Got| match got {
        Got::Response(pdu) if pdu[0] == 1 => {
            let mut pdu = pdu.clone();
            let unused = request.map_or(0, |head| 8 * (pdu.len() - 2) - usize::from(head.count_or_value));
            if let Some(last) = pdu.last_mut() {
                *last &= 0xFF >> unused;
            }
            Got::Response(pdu)
        }
        other => other.clone(),
    };
    assert_eq!(got, wanted.iter().map(masked).collect::<Vec<_>>());
}

pub(crate) fn server_seeds() -> Vec<Vec<u8>> {
    let bytes = |bytes: &[u8]| [&[3, bytes.len() as u8], bytes].concat();
    let request = |op: u8, id: u16, unit: u8, address: u16, count: u16, data: &[u8]| {
        [&[op], &id.to_le_bytes()[..], &[unit], &address.to_le_bytes(), &count.to_le_bytes(), data].concat()
    };
    let all: Vec<u8> = [
        request(0, 1, 1, 192, 16, &[]),
        request(0x20, 2, 1, 8, 125, &[]),
        request(0x40, 3, 1, 192, 0xFF00, &[]),
        request(0x60, 4, 255, 8, 1234, &[]),
        request(0x80, 5, 0, 192, 15, &[1, 0x80]),
        request(0xA0, 6, 1, 8, 1, &[0, 1, 0, 2]),
        request(0xC0, 7, 1, 0, 0, &[]),
    ]
    .concat();
    vec![
        [&[0], &all[..]].concat(),
        [&[1], &all[..]].concat(),
        [&[200], &all[..]].concat(),
        // The last of each map and one beyond; counts at their limits and beyond.
        [
            &[0][..],
            &request(0, 1, 1, 299, 1, &[]),
            &request(0, 2, 1, 299, 2, &[]),
            &request(0, 3, 1, 0, 300, &[]),
        ]
        .concat(),
        [&[0][..], &request(0x10, 1, 1, 0xFFFF, 1, &[]), &request(0x30, 1, 1, 0xFFFF, 2, &[])].concat(),
        [
            &[0][..],
            &request(0, 1, 1, 0, 2000, &[]),
            &request(0, 1, 1, 0, 2001, &[]),
            &request(0x20, 1, 1, 0, 126, &[]),
        ]
        .concat(),
        [&[0][..], &request(0, 1, 1, 0, 0, &[]), &request(0x40, 1, 1, 0, 0xFF01, &[])].concat(),
        // Headers that cannot be.
        [&[0][..], &all, &bytes(&[0, 1, 0, 1, 0, 6, 1, 1, 0, 0, 0, 1]), &all].concat(),
        [&[9][..], &bytes(&[0, 1, 0, 0, 0, 1, 1]), &all].concat(),
        [&[9][..], &bytes(&[0, 1, 0, 0, 0, 255, 1]), &all].concat(),
        // A request with a byte too few and too many, and one with a wrong byte count.
        [
            &[0][..],
            &request(0xA2, 6, 1, 8, 1, &[0, 1, 0, 2]),
            &[4],
            &request(0xA2, 6, 1, 8, 1, &[0, 1, 0, 2]),
            &[6],
        ]
        .concat(),
        [&[0][..], &request(0xA1, 6, 1, 8, 1, &[0, 1, 0, 2]), &[12, 1]].concat(),
    ]
}

pub(crate) fn client_seeds() -> Vec<Vec<u8>> {
    let start = |kind: u8, address: u16, count: u16, data: &[u8]| {
        let op = (data.len() as u8 - 1) << 4;
        [&[op, kind], &address.to_le_bytes()[..], &count.to_le_bytes(), data].concat()
    };
    let exchanges: Vec<u8> = (0..8).flat_map(|kind| [start(kind, 8, 9, &[3]), vec![2]].concat()).collect();
    vec![
        [&[0, 1], &exchanges[..]].concat(),
        [&[1, 1], &exchanges[..]].concat(),
        // Exceptions.
        [&[0, 1][..], &start(0, 290, 11, &[1]), &[2]].concat(),
        // Given up, answered late, then asked again.
        [&[0, 1][..], &start(0, 8, 9, &[1]), &[5, 2], &start(0, 0, 300, &[1]), &[2]].concat(),
        // Another unit, another function, another id, a length that does not fit.
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[3, 6, 1], &start(0, 8, 9, &[1]), &[2]].concat(),
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[3, 7, 2], &start(0, 8, 9, &[1]), &[2]].concat(),
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[3, 1, 5], &start(0, 8, 9, &[1]), &[2]].concat(),
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[3, 0, 0x80], &start(0, 8, 9, &[1]), &[2]].concat(),
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[12, 0, 0, 4], &start(1, 8, 9, &[1]), &[12, 0, 0, 18]].concat(),
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[4, 0, 0, 1], &start(0, 8, 9, &[1]), &[2]].concat(),
        [&[3, 1][..], &start(0, 8, 9, &[1]), &[7, 5, 0, 1, 0, 0, 0, 6, 2]].concat(),
        [&[0, 1][..], &start(0, 8, 9, &[1]), &[7, 8, 0, 1, 0, 0, 1, 0, 1, 1]].concat(),
    ]
}
