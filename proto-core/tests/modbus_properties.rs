//! The Modbus server and client against a slow, obvious reference, on generated streams that are
//! cut anywhere, damaged, or pure garbage.

use proptest::collection::vec;
use proptest::prelude::*;
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::pdu::{PduEncodeError, Request, RequestHead, Response};
use proto_core::modbus::server::Server;
use proto_core::modbus::{Coils, Registers};

#[path = "reference/modbus.rs"]
mod reference;

use reference::Bank;

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
                let refused = PduEncodeError::NoSpace { needed: len, available };
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
        let expected_sent = reference::server(&mut expected, &stream);
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
        let expected_sent = reference::server(&mut expected, &stream);
        prop_assert_eq!(serve(&mut bank, &stream, &[]), expected_sent);
        prop_assert_eq!(bank, expected);
    }

    #[test]
    fn garbage_never_panics(stream in vec(any::<u8>(), 0..600), cuts in vec(any::<usize>(), 0..8)) {
        let (mut bank, mut expected) = (Bank::new(), Bank::new());
        let expected_sent = reference::server(&mut expected, &stream);
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
            let answer = reference::answer(&mut expected, &out[7..len]);
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
