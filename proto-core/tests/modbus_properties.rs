//! The Modbus server and client against a slow, obvious reference, on generated streams that are
//! cut anywhere, damaged, or pure garbage.

use proptest::collection::vec;
use proptest::prelude::*;
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::pdu::{EncodeError, Request, RequestHead, Response};
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};

/// 300 coils and 200 registers, all writable: what the reference and the server work on.
#[derive(Debug, Clone, PartialEq)]
struct Bank {
    coils: Vec<bool>,
    words: Vec<u16>,
}

impl Bank {
    fn new() -> Self {
        Self { coils: (0..300).map(|n| n % 7 < 3).collect(), words: (0..200).map(|n| n * 0x0123).collect() }
    }
}

fn run<T>(items: &[T], first: u16, count: usize) -> Result<&[T], Exception> {
    items.get(usize::from(first)..usize::from(first) + count).ok_or(Exception::IllegalDataAddress)
}

fn run_mut<T>(items: &mut [T], first: u16, count: usize) -> Result<&mut [T], Exception> {
    items.get_mut(usize::from(first)..usize::from(first) + count).ok_or(Exception::IllegalDataAddress)
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let coils = run(&self.coils, address, usize::from(count))?;
        Coils::pack(coils.iter().copied(), packed).map(|_| ()).ok_or(Exception::DeviceFailure)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let target = run_mut(&mut self.coils, address, usize::from(coils.count()))?;
        target.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let source = run(&self.words, address, words.len())?;
        words.iter_mut().zip(source).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        let target = run_mut(&mut self.words, address, usize::from(registers.count()))?;
        target.iter_mut().zip(registers.iter()).for_each(|(word, value)| *word = value);
        Ok(())
    }
}

/// What a server answers to a whole connection's bytes, written down rule by rule: the answers, and
/// whether the connection is closed at the end.
fn reference_server(bank: &mut Bank, stream: &[u8]) -> (Vec<u8>, bool) {
    let (mut sent, mut at) = (Vec::new(), 0);
    loop {
        let rest = &stream[at..];
        if rest.len() < 6 {
            return (sent, false);
        }
        let length = usize::from(rest[4]) * 256 + usize::from(rest[5]);
        if rest[2] != 0 || rest[3] != 0 || !(2..=254).contains(&length) {
            return (sent, true);
        }
        if rest.len() < 6 + length {
            return (sent, false);
        }
        let pdu = &rest[7..6 + length];
        let answer = match reference_answer(bank, pdu) {
            Ok(answer) => answer,
            Err(code) => vec![pdu[0] | 0x80, code],
        };
        sent.extend([rest[0], rest[1], 0, 0, 0, answer.len() as u8 + 1, rest[6]]);
        sent.extend(answer);
        at += 6 + length;
    }
}

fn reference_answer(bank: &mut Bank, pdu: &[u8]) -> Result<Vec<u8>, u8> {
    let function = pdu[0];
    if ![1, 3, 5, 6, 15, 16].contains(&function) {
        return Err(1);
    }
    if pdu.len() < 5 {
        return Err(3);
    }
    let word = |at: usize| usize::from(pdu[at]) * 256 + usize::from(pdu[at + 1]);
    let (first, count) = (word(1), word(3));
    let limit = match function {
        1 => 2000,
        3 => 125,
        15 => 1968,
        16 => 123,
        _ => usize::MAX,
    };
    let data = if function == 15 { count.div_ceil(8) } else { 2 * count };
    if function == 5 && ![0, 0xFF00].contains(&count) {
        return Err(3);
    }
    if ![5, 6].contains(&function) && (count == 0 || count > limit) {
        return Err(3);
    }
    let expected_len = if function > 6 { 6 + data } else { 5 };
    if pdu.len() != expected_len || function > 6 && usize::from(pdu[5]) != data {
        return Err(3);
    }
    let touched = if [5, 6].contains(&function) { 1 } else { count };
    let space = if [1, 5, 15].contains(&function) { bank.coils.len() } else { bank.words.len() };
    if first + touched > space {
        return Err(2);
    }
    match function {
        1 => {
            let mut bytes = vec![0; count.div_ceil(8)];
            for nth in 0..count {
                if bank.coils[first + nth] {
                    bytes[nth / 8] |= 1 << (nth % 8);
                }
            }
            return Ok([vec![1, bytes.len() as u8], bytes].concat());
        }
        3 => {
            let words = bank.words[first..first + count].iter();
            let bytes: Vec<u8> = words.flat_map(|word| [(word >> 8) as u8, *word as u8]).collect();
            return Ok([vec![3, bytes.len() as u8], bytes].concat());
        }
        5 => bank.coils[first] = count != 0,
        6 => bank.words[first] = count as u16,
        15 => {
            for nth in 0..count {
                bank.coils[first + nth] = pdu[6 + nth / 8] >> (nth % 8) & 1 == 1;
            }
        }
        _ => {
            for nth in 0..count {
                bank.words[first + nth] = word(6 + 2 * nth) as u16;
            }
        }
    }
    Ok(pdu[..5].to_vec())
}

/// Hands `stream` to a server in pieces that end where `cuts` say.
fn serve(bank: &mut Bank, stream: &[u8], cuts: &[usize]) -> (Vec<u8>, bool) {
    let mut ends: Vec<usize> = cuts.iter().map(|cut| cut % (stream.len() + 1)).collect();
    ends.push(stream.len());
    ends.sort_unstable();
    let (mut server, mut sent, mut start) = (Server::new(), Vec::new(), 0);
    for end in ends {
        let mut piece = &stream[start..end];
        start = end;
        let mut out = [0xA5; MAX_ADU];
        while let Some(answered) = server.receive(&mut piece, bank, &mut out) {
            match answered {
                Ok(len) => sent.extend_from_slice(&out[..len]),
                Err(_) => return (sent, true),
            }
        }
        assert!(piece.is_empty());
    }
    (sent, false)
}

/// A request with its data, as a generator makes it.
#[derive(Debug, Clone)]
enum Asked {
    ReadCoils(u16, u16),
    ReadHolding(u16, u16),
    WriteCoil(u16, bool),
    WriteRegister(u16, u16),
    WriteCoils(u16, Vec<bool>),
    WriteRegisters(u16, Vec<u16>),
}

impl Asked {
    fn with<T>(&self, then: impl FnOnce(Request<'_>) -> T) -> T {
        let mut buffer = [0xA5; 300];
        then(match self {
            Self::ReadCoils(address, count) => Request::ReadCoils { address: *address, count: *count },
            Self::ReadHolding(address, count) => Request::ReadHolding { address: *address, count: *count },
            Self::WriteCoil(address, value) => Request::WriteCoil { address: *address, value: *value },
            Self::WriteRegister(address, value) => {
                Request::WriteRegister { address: *address, value: *value }
            }
            Self::WriteCoils(address, coils) => Request::WriteCoils {
                address: *address,
                coils: Coils::pack(coils.iter().copied(), &mut buffer).unwrap(),
            },
            Self::WriteRegisters(address, values) => Request::WriteRegisters {
                address: *address,
                registers: Registers::pack(values.iter().copied(), &mut buffer).unwrap(),
            },
        })
    }
}

fn address() -> impl Strategy<Value = u16> {
    prop_oneof![8 => 0..310_u16, 1 => any::<u16>()]
}

fn asked() -> impl Strategy<Value = Asked> {
    prop_oneof![
        (address(), 1..=2000_u16).prop_map(|(a, n)| Asked::ReadCoils(a, n)),
        (address(), 1..=40_u16).prop_map(|(a, n)| Asked::ReadCoils(a, n)),
        (address(), 1..=125_u16).prop_map(|(a, n)| Asked::ReadHolding(a, n)),
        (address(), any::<bool>()).prop_map(|(a, on)| Asked::WriteCoil(a, on)),
        (address(), any::<u16>()).prop_map(|(a, value)| Asked::WriteRegister(a, value)),
        (address(), vec(any::<bool>(), 1..=80)).prop_map(|(a, coils)| Asked::WriteCoils(a, coils)),
        (address(), vec(any::<bool>(), 1960..=1968)).prop_map(|(a, coils)| Asked::WriteCoils(a, coils)),
        (address(), vec(any::<u16>(), 1..=123)).prop_map(|(a, words)| Asked::WriteRegisters(a, words)),
    ]
}

fn framed(transaction: u16, asked: &Asked) -> Vec<u8> {
    let mut pdu = [0xA5; 253];
    let len = asked.with(|request| request.encode(&mut pdu)).unwrap();
    let [t1, t0] = transaction.to_be_bytes();
    [vec![t1, t0, 0, 0, 0, len as u8 + 1, 0x11], pdu[..len].to_vec()].concat()
}

proptest! {
    #[test]
    fn requests_survive_the_wire(asked in asked()) {
        asked.with(|request| {
            let mut out = [0xA5; 260];
            let len = request.encode(&mut out).unwrap();
            prop_assert_eq!(len, request.encoded_len());
            prop_assert_eq!(Request::parse(&out[..len]), Ok(request));
            prop_assert!(out[len..].iter().all(|&byte| byte == 0xA5));
            for available in [0, 4, len - 1] {
                let mut short = vec![0xA5; available];
                let refused = EncodeError::NoSpace { needed: len, available };
                prop_assert_eq!(request.encode(&mut short), Err(refused));
                prop_assert!(short.iter().all(|&byte| byte == 0xA5));
            }
            Ok(())
        })?;
    }

    #[test]
    fn a_server_does_what_the_reference_does(
        requests in vec(asked(), 1..6),
        damage in vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
        cuts in vec(any::<usize>(), 0..12),
    ) {
        let mut stream: Vec<u8> =
            requests.iter().enumerate().flat_map(|(nth, asked)| framed(nth as u16, asked)).collect();
        for (at, byte) in damage {
            let at = at.index(stream.len());
            stream[at] = byte;
        }
        let (mut bank, mut expected) = (Bank::new(), Bank::new());
        let expected_sent = reference_server(&mut expected, &stream);
        prop_assert_eq!(serve(&mut bank, &stream, &cuts), expected_sent);
        prop_assert_eq!(bank, expected);
    }

    #[test]
    fn garbage_in_a_good_frame_is_answered_as_the_reference_does(
        pdu in prop_oneof![
            vec(any::<u8>(), 1..=253),
            (0..20_u8, vec(prop_oneof![Just(0), Just(1), any::<u8>()], 0..12))
                .prop_map(|(function, data)| [vec![function], data].concat()),
        ],
    ) {
        let stream = [vec![1, 2, 0, 0, 0, pdu.len() as u8 + 1, 3], pdu].concat();
        let (mut bank, mut expected) = (Bank::new(), Bank::new());
        let expected_sent = reference_server(&mut expected, &stream);
        prop_assert_eq!(serve(&mut bank, &stream, &[]), expected_sent);
        prop_assert_eq!(bank, expected);
    }

    #[test]
    fn garbage_never_panics(stream in vec(any::<u8>(), 0..600), cuts in vec(any::<usize>(), 0..8)) {
        let (mut bank, mut expected) = (Bank::new(), Bank::new());
        let expected_sent = reference_server(&mut expected, &stream);
        prop_assert_eq!(serve(&mut bank, &stream, &cuts), expected_sent);
        let mut client = Client::new(1);
        client.start(Request::ReadCoils { address: 0, count: 9 }, &mut [0; 260]).unwrap();
        for mut piece in stream.chunks(1 + cuts.len()) {
            while client.receive(&mut piece).is_some() {}
            prop_assert!(piece.is_empty());
        }
    }

    #[test]
    fn any_answer_is_read_or_refused(
        function in prop::sample::select(vec![1_u8, 3, 5, 6, 15, 16, 0x2B]),
        address in any::<u16>(),
        count_or_value in prop_oneof![0..20_u16, any::<u16>()],
        pdu in vec(any::<u8>(), 0..253),
    ) {
        let request = RequestHead { function, address, count_or_value };
        if let Ok(Ok(response)) = Response::parse(request, &pdu) {
            let mut out = [0xA5; 260];
            let len = response.encode(&mut out).unwrap();
            prop_assert_eq!(Response::parse(request, &out[..len]), Ok(Ok(response)));
            prop_assert_eq!(len, pdu.len());
        }
    }

    #[test]
    fn client_and_server_agree_however_the_bytes_travel(
        requests in vec(asked(), 1..5),
        up in 1..30_usize,
        down in 1..30_usize,
    ) {
        let (mut client, mut server) = (Client::new(9), Server::new());
        let (mut bank, mut expected) = (Bank::new(), Bank::new());
        for asked in &requests {
            let mut out = [0xA5; MAX_ADU];
            let len = asked.with(|request| client.start(request, &mut out)).unwrap();
            let head = client.in_flight().unwrap();
            let mut sent = Vec::new();
            for mut piece in out[..len].chunks(up) {
                let mut answer = [0xA5; MAX_ADU];
                while let Some(answered) = server.receive(&mut piece, &mut bank, &mut answer) {
                    sent.extend_from_slice(&answer[..answered.unwrap()]);
                }
            }
            let answer = reference_answer(&mut expected, &out[7..len]);
            let mut events = 0;
            for mut piece in sent.chunks(down) {
                while let Some(event) = client.receive(&mut piece) {
                    events += 1;
                    match (&answer, event) {
                        (Ok(pdu), ClientEvent::Response(response)) => {
                            prop_assert_eq!(Response::parse(head, pdu), Ok(Ok(response)));
                        }
                        (Err(code), ClientEvent::Exception(exception)) => {
                            prop_assert_eq!(exception.code(), *code);
                        }
                        other => prop_assert!(false, "{:?}", other),
                    }
                }
            }
            prop_assert_eq!(events, 1);
            prop_assert!(!client.busy());
        }
        prop_assert_eq!(bank, expected);
    }
}
