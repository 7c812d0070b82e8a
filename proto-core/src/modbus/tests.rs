use std::vec;
use std::vec::Vec;

use super::adu::{Adu, AduError, AduReader, MAX_ADU};
use super::client::{Client, ClientEvent, StartError, Violation};
use super::pdu::{MAX_PDU, PduEncodeError, Request, RequestHead, Response, ResponseError};
use super::server::{RegisterBank, Server, answer};
use super::{Coils, Exception, Registers};

/// 100 coils of which the first 20 are writable, 130 registers of which the first 10 are.
#[derive(Debug, Clone, PartialEq)]
struct Bank {
    coils: Vec<bool>,
    words: Vec<u16>,
}

const WRITABLE_COILS: usize = 20;
const WRITABLE_WORDS: usize = 10;

impl Default for Bank {
    fn default() -> Self {
        Self { coils: (0..100).map(|n| n % 3 == 0).collect(), words: (0..130).map(|n| 0x0100 + n).collect() }
    }
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        assert!(packed.iter().all(|&byte| byte == 0), "the server clears the answer first");
        let first = usize::from(address);
        let coils = self.coils.get(first..first + usize::from(count)).ok_or(Exception::IllegalDataAddress)?;
        for (nth, _) in coils.iter().enumerate().filter(|(_, on)| **on) {
            packed[nth / 8] |= 1 << (nth % 8);
        }
        // The server clears the bits beyond the last coil.
        if !count.is_multiple_of(8) {
            *packed.last_mut().unwrap() |= 0x80;
        }
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let first = usize::from(address);
        let target = self.coils[..WRITABLE_COILS]
            .get_mut(first..first + usize::from(coils.count()))
            .ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let first = usize::from(address);
        let values = self.words.get(first..first + words.len()).ok_or(Exception::IllegalDataAddress)?;
        words.iter_mut().zip(values).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        let first = usize::from(address);
        let target = self.words[..WRITABLE_WORDS]
            .get_mut(first..first + usize::from(registers.count()))
            .ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(registers.iter()).for_each(|(word, value)| *word = value);
        Ok(())
    }
}

/// The PDU of the answer to a request.
fn ask(bank: &mut Bank, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0xA5; MAX_PDU];
    let len = answer(pdu, bank, &mut out);
    let refused = out[0] & 0x80 != 0;
    assert!(refused || out[len..].iter().all(|&byte| byte == 0xA5), "wrote past the answer's {len} bytes");
    out[..len].to_vec()
}

#[track_caller]
fn refused(pdu: &[u8], exception: Exception) {
    let mut bank = Bank::default();
    let function = pdu.first().copied().unwrap_or(0);
    assert_eq!(ask(&mut bank, pdu), [function | 0x80, exception.code()], "{pdu:02x?}");
    assert_eq!(bank, Bank::default(), "a refused request changed the bank");
}

/// All answers of a server to `stream`, passed in pieces of at most `chunk` bytes.
fn serve(bank: &mut Bank, stream: &[u8], chunk: usize) -> Result<Vec<u8>, AduError> {
    let (mut server, mut sent) = (Server::new(), Vec::new());
    for mut bytes in stream.chunks(chunk) {
        let mut out = [0xA5; MAX_ADU];
        while let Some(answered) = server.receive(&mut bytes, bank, &mut out) {
            sent.extend_from_slice(&out[..answered?]);
        }
        assert!(bytes.is_empty(), "None means that everything was taken");
    }
    Ok(sent)
}

fn frame(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let ([t1, t0], [l1, l0]) = (transaction.to_be_bytes(), (pdu.len() as u16 + 1).to_be_bytes());
    let mut frame = vec![t1, t0, 0, 0, l1, l0, unit];
    frame.extend_from_slice(pdu);
    frame
}

fn started(client: &mut Client, request: Request<'_>) -> Vec<u8> {
    let mut out = [0xA5; MAX_ADU];
    let len = client.start(request, &mut out).unwrap();
    assert!(out[len..].iter().all(|&byte| byte == 0xA5), "wrote past the request's {len} bytes");
    out[..len].to_vec()
}

const READ_TWO: Request<'static> = Request::ReadHolding { address: 3, count: 2 };

#[test]
fn every_function_is_answered_and_done() {
    let mut bank = Bank::default();
    assert_eq!(ask(&mut bank, &[1, 0, 0, 0, 10]), [1, 2, 0b0100_1001, 0b10]);
    assert_eq!(ask(&mut bank, &[3, 0, 129, 0, 1]), [3, 2, 0x01, 0x81]);
    assert_eq!(ask(&mut bank, &[5, 0, 1, 0xFF, 0]), [5, 0, 1, 0xFF, 0]);
    assert_eq!(ask(&mut bank, &[5, 0, 0, 0, 0]), [5, 0, 0, 0, 0]);
    assert_eq!(ask(&mut bank, &[6, 0, 9, 0x12, 0x34]), [6, 0, 9, 0x12, 0x34]);
    assert_eq!(ask(&mut bank, &[15, 0, 10, 0, 10, 2, 0xFF, 0xFD]), [15, 0, 10, 0, 10]);
    assert_eq!(ask(&mut bank, &[16, 0, 0, 0, 2, 4, 1, 2, 3, 4]), [16, 0, 0, 0, 2]);

    let mut expected = Bank::default();
    expected.coils[..2].copy_from_slice(&[false, true]);
    expected.coils[10..20].copy_from_slice(&[true; 10]);
    expected.coils[19] = false;
    expected.words[9] = 0x1234;
    expected.words[..2].copy_from_slice(&[0x0102, 0x0304]);
    assert_eq!(bank, expected);
}

#[test]
fn the_limits_of_each_count_are_the_standards() {
    let mut bank = Bank { coils: vec![true; 4000], words: vec![7; 4000] };
    assert_eq!(ask(&mut bank, &[1, 0, 0, 0x07, 0xD0]).len(), 252);
    assert_eq!(ask(&mut bank, &[3, 0, 0, 0, 125]).len(), 252);
    refused(&[1, 0, 0, 0x07, 0xD1], Exception::IllegalDataValue);
    refused(&[3, 0, 0, 0, 126], Exception::IllegalDataValue);
    for (function, count, data) in [(15_u8, 1969_u16, 247), (16, 124, 248)] {
        let [c1, c0] = count.to_be_bytes();
        let mut pdu = vec![function, 0, 0, c1, c0, data];
        pdu.resize(6 + usize::from(data), 0);
        refused(&pdu, Exception::IllegalDataValue);
    }
    for pdu in [&[1, 0, 0, 0, 0][..], &[3, 0, 0, 0, 0], &[15, 0, 0, 0, 0, 0], &[16, 0, 0, 0, 0, 0]] {
        refused(pdu, Exception::IllegalDataValue);
    }
}

#[test]
fn other_functions_are_illegal() {
    for function in (0..=0xFF).filter(|function| ![1, 3, 5, 6, 15, 16].contains(function)) {
        refused(&[function, 0, 0, 0, 1], Exception::IllegalFunction);
        refused(&[function], Exception::IllegalFunction);
    }
}

#[test]
fn values_and_byte_counts_that_disagree_are_refused() {
    refused(&[5, 0, 0, 0xFF, 0x01], Exception::IllegalDataValue);
    refused(&[5, 0, 0, 0, 1], Exception::IllegalDataValue);
    refused(&[15, 0, 0, 0, 8, 2, 0xFF, 0xFF], Exception::IllegalDataValue);
    refused(&[15, 0, 0, 0, 16, 1, 0xFF, 0xFF], Exception::IllegalDataValue);
    refused(&[16, 0, 0, 0, 2, 2, 1, 2, 3, 4], Exception::IllegalDataValue);
    refused(&[16, 0, 0, 0, 2, 3, 1, 2, 3], Exception::IllegalDataValue);
    refused(&[16, 0, 0, 0, 1, 4, 1, 2, 3, 4], Exception::IllegalDataValue);
    for whole in [
        &[1, 0, 0, 0, 1][..],
        &[3, 0, 0, 0, 1],
        &[5, 0, 0, 0, 0],
        &[6, 0, 0, 0, 1],
        &[15, 0, 0, 0, 9, 2, 0xFF, 1],
        &[16, 0, 0, 0, 1, 2, 0, 1],
    ] {
        for len in 1..whole.len() {
            refused(&whole[..len], Exception::IllegalDataValue);
        }
        let mut longer = whole.to_vec();
        longer.push(0);
        refused(&longer, Exception::IllegalDataValue);
    }
}

#[test]
fn addresses_past_the_map_or_read_only_change_nothing() {
    for pdu in [
        &[1, 0, 99, 0, 2][..],
        &[1, 0xFF, 0xFF, 0, 2],
        &[3, 0, 130, 0, 1],
        &[3, 0xFF, 0xFF, 0, 2],
        &[5, 0, 20, 0xFF, 0],
        &[6, 0, 10, 0, 1],
        &[15, 0, 15, 0, 8, 1, 0xFF],
        &[15, 0xFF, 0xFC, 0, 8, 1, 0xFF],
        &[16, 0, 9, 0, 2, 4, 0, 0, 0, 0],
        &[16, 0xFF, 0xFF, 0, 2, 4, 0, 0, 0, 0],
    ] {
        refused(pdu, Exception::IllegalDataAddress);
    }
}

#[test]
fn no_bank_is_asked_for_a_run_that_passes_the_last_address() {
    struct Everything;
    impl RegisterBank for Everything {
        fn read_coils(&self, _: u16, _: u16, _: &mut [u8]) -> Result<(), Exception> {
            Ok(())
        }
        fn write_coils(&mut self, _: u16, _: Coils<'_>) -> Result<(), Exception> {
            Ok(())
        }
        fn read_holding(&self, _: u16, _: &mut [[u8; 2]]) -> Result<(), Exception> {
            Ok(())
        }
        fn write_holding(&mut self, _: u16, _: Registers<'_>) -> Result<(), Exception> {
            Ok(())
        }
    }
    let mut out = [0; MAX_PDU];
    for (function, data) in [(1, &[][..]), (3, &[]), (15, &[1, 3]), (16, &[4, 1, 2, 3, 4])] {
        for (first, fits) in [(0xFE, true), (0xFF, false)] {
            let pdu = [&[function, 0xFF, first, 0, 2], data].concat();
            let len = answer(&pdu, &mut Everything, &mut out);
            assert_eq!(out[..len] != [function | 0x80, 2], fits, "{pdu:02x?}");
        }
    }
}

#[test]
fn bits_of_a_register_are_written_by_a_bank_that_can() {
    struct Masked(u16);
    impl RegisterBank for Masked {
        fn read_coils(&self, _: u16, _: u16, _: &mut [u8]) -> Result<(), Exception> {
            Err(Exception::IllegalDataAddress)
        }
        fn write_coils(&mut self, _: u16, _: Coils<'_>) -> Result<(), Exception> {
            Err(Exception::IllegalDataAddress)
        }
        fn read_holding(&self, _: u16, _: &mut [[u8; 2]]) -> Result<(), Exception> {
            Err(Exception::IllegalDataAddress)
        }
        fn write_holding(&mut self, _: u16, _: Registers<'_>) -> Result<(), Exception> {
            Err(Exception::IllegalDataAddress)
        }
        fn mask_holding(&mut self, address: u16, keep: u16, value: u16) -> Result<(), Exception> {
            if address != 4 {
                return Err(Exception::IllegalDataAddress);
            }
            self.0 = self.0 & keep | value;
            Ok(())
        }
    }
    // The example of the standard: 0x12 becomes 0x17.
    let (mut bank, mut out) = (Masked(0x12), [0; MAX_PDU]);
    let pdu = [0x16, 0x00, 0x04, 0x00, 0xF2, 0x00, 0x25];
    let len = answer(&pdu, &mut bank, &mut out);
    assert_eq!((&out[..len], bank.0), (&pdu[..], 0x17));
    let mut answered = |bank: &mut dyn RegisterBank, pdu: &[u8]| {
        let len = answer(pdu, bank, &mut out);
        out[..len].to_vec()
    };
    assert_eq!(answered(&mut bank, &[0x16, 0, 5, 0, 0, 0, 1]), [0x96, 2]);
    assert_eq!(answered(&mut bank, &pdu[..6]), [0x96, 1]);
    assert_eq!(answered(&mut Bank::default(), &pdu), [0x96, 1], "a bank that cannot");
    assert_eq!(bank.0, 0x17);
}

#[test]
fn a_server_answers_alike_however_the_stream_is_cut() {
    let mut stream = frame(1, 9, &[3, 0, 0, 0, 125]);
    stream.extend(frame(0xFFFF, 0, &[16, 0, 0, 0, 1, 2, 0xAB, 0xCD]));
    stream.extend(frame(7, 255, &[8, 0]));
    stream.extend(frame(8, 1, &[1, 0, 0, 0, 100]));
    let mut bank = Bank::default();
    let whole = serve(&mut bank, &stream, stream.len()).unwrap();
    assert_eq!(whole.len(), 259 + 12 + 9 + 22);
    for cut in 1..stream.len() {
        let mut bank = Bank::default();
        assert_eq!(serve(&mut bank, &stream, cut).unwrap(), whole, "pieces of {cut}");
        let (mut server, mut bank, mut sent) = (Server::new(), Bank::default(), Vec::new());
        for mut bytes in [&stream[..cut], &stream[cut..]] {
            let mut out = [0xA5; MAX_ADU];
            while let Some(answered) = server.receive(&mut bytes, &mut bank, &mut out) {
                sent.extend_from_slice(&out[..answered.unwrap()]);
            }
        }
        assert_eq!(sent, whole, "cut at {cut}");
    }
}

#[test]
fn a_header_that_cannot_be_followed_closes_the_connection() {
    let mut bank = Bank::default();
    let good = frame(1, 1, &[6, 0, 0, 0, 1]);
    for (header, error) in [
        ([0, 1, 0, 1, 0, 6], AduError::Protocol { received: 1 }),
        ([0, 1, 0, 0, 0, 0], AduError::Length { received: 0 }),
        ([0, 1, 0, 0, 0, 1], AduError::Length { received: 1 }),
        ([0, 1, 0, 0, 0, 255], AduError::Length { received: 255 }),
        ([0, 1, 0, 0, 1, 2], AduError::Length { received: 258 }),
    ] {
        let mut stream = header.to_vec();
        stream.extend(&good);
        for chunk in [1, 5, stream.len()] {
            assert_eq!(serve(&mut bank, &stream, chunk), Err(error), "chunks of {chunk}");
        }
        assert_eq!(bank, Bank::default(), "what follows a broken header is not a request");
    }
    let longest = frame(1, 1, &[0x2B; MAX_PDU]);
    assert_eq!(serve(&mut bank, &longest, 100).unwrap(), frame(1, 1, &[0xAB, 1]));
    assert_eq!(serve(&mut bank, &frame(1, 1, &[0x2B]), 100).unwrap(), frame(1, 1, &[0xAB, 1]));
}

#[test]
fn a_reader_starts_afresh_after_reset_and_after_an_error() {
    let mut reader = AduReader::new();
    let good = frame(2, 3, &[4, 5]);
    assert_eq!(reader.next_adu(&mut &good[..5]), None);
    assert_eq!(reader.pending(), 5);
    reader.reset();
    let expected = Adu { transaction: 2, unit: 3, pdu: &[4, 5] };
    assert_eq!(reader.next_adu(&mut &good[..]), Some(Ok(expected)));
    assert!(reader.next_adu(&mut &[0xFF; 9][..]).unwrap().is_err());
    assert_eq!(reader.next_adu(&mut &good[..]), Some(Ok(expected)));
}

#[test]
fn a_client_gets_its_answer_however_it_is_cut() {
    let mut client = Client::new(1);
    for cut in 0..=13 {
        let request = started(&mut client, READ_TWO);
        assert!(client.busy());
        let sent = serve(&mut Bank::default(), &request, 260).unwrap();
        let (mut first, mut second) = sent.split_at(cut);
        let (mut early, mut late) = (None, None);
        if let Some(ClientEvent::Response(Response::Registers(registers))) = client.receive(&mut first) {
            early = Some(registers.iter().collect::<Vec<_>>());
        }
        if let Some(ClientEvent::Response(Response::Registers(registers))) = client.receive(&mut second) {
            late = Some(registers.iter().collect::<Vec<_>>());
        }
        assert_eq!(early.or(late), Some(vec![0x0103, 0x0104]), "cut at {cut}");
        assert!(!client.busy());
    }
}

#[test]
fn one_request_is_in_flight_at_a_time() {
    let mut client = Client::new(1);
    let mut out = [0xA5; MAX_ADU];
    assert_eq!(client.start(READ_TWO, &mut out), Ok(12));
    assert_eq!(client.start(READ_TWO, &mut out), Err(StartError::Busy));
    assert_eq!(client.in_flight(), Some(RequestHead { function: 3, address: 3, count_or_value: 2 }));
}

#[test]
fn a_request_that_cannot_be_sent_changes_nothing() {
    let mut client = Client::new(1);
    for available in 0..12 {
        let mut out = vec![0xA5; available];
        let no_space = PduEncodeError::NoSpace { needed: 12, available };
        assert_eq!(client.start(READ_TWO, &mut out), Err(StartError::Encode(no_space)));
        assert!(out.iter().all(|&byte| byte == 0xA5) && !client.busy());
    }
    let too_many = Request::ReadCoils { address: 0, count: 2001 };
    let refused = StartError::Encode(PduEncodeError::Count { count: 2001, max: 2000 });
    assert_eq!(client.start(too_many, &mut [0; 260]), Err(refused));
    assert_eq!(started(&mut client, READ_TWO)[..2], [0, 1], "no transaction id was used up");
}

#[test]
fn late_answers_are_counted_and_skipped() {
    let mut client = Client::new(1);
    let first = started(&mut client, READ_TWO);
    client.abort();
    let second = started(&mut client, Request::WriteRegister { address: 0, value: 5 });
    let mut bank = Bank::default();
    let mut stream = serve(&mut bank, &first, 260).unwrap();
    stream.extend(serve(&mut bank, &second, 260).unwrap());
    stream.extend(frame(2, 1, &[6, 0, 0, 0, 5]));
    for chunk in [1, 7, stream.len()] {
        let (mut client, mut events) = (client.clone(), 0);
        for mut bytes in stream.chunks(chunk) {
            while let Some(event) = client.receive(&mut bytes) {
                let wrote = Response::WroteRegister { address: 0, value: 5 };
                assert_eq!(event, ClientEvent::Response(wrote));
                events += 1;
            }
        }
        assert_eq!((events, client.stale_answers()), (1, 2), "chunks of {chunk}");
    }
}

#[test]
fn transaction_ids_wrap() {
    let mut client = Client::new(1);
    for id in (1..=0xFFFF_u16).chain([0, 1]) {
        let request = started(&mut client, READ_TWO);
        assert_eq!(request[..2], id.to_be_bytes());
        client.abort();
    }
    started(&mut client, READ_TWO);
    let mut late = &frame(0xFFFF, 1, &[3, 2, 0, 0])[..];
    assert_eq!(client.receive(&mut late), None);
    assert_eq!(client.stale_answers(), 1);
}

#[test]
fn half_the_circle_of_transaction_ids_is_the_past() {
    let answer = |id| frame(id, 1, &[3, 4, 0, 0, 0, 0]);
    let mut client = Client::new(1);
    started(&mut client, READ_TWO);
    assert_eq!(client.receive(&mut &answer(0x8002)[..]), None);
    assert!(client.busy() && client.stale_answers() == 1);
    let violation = Violation::Transaction { newest: 1, received: 0x8001 };
    assert_eq!(client.receive(&mut &answer(0x8001)[..]), Some(ClientEvent::Violation(violation)));
}

#[test]
fn exceptions_reach_the_caller_with_their_code() {
    for code in 0..=0xFF {
        let mut client = Client::new(1);
        started(&mut client, READ_TWO);
        let refused = frame(1, 1, &[0x83, code]);
        let exception = Exception::from_code(code);
        assert_eq!(exception.code(), code);
        assert_eq!(client.receive(&mut &refused[..]), Some(ClientEvent::Exception(exception)));
    }
    assert_eq!(Exception::from_code(2), Exception::IllegalDataAddress);
    assert_eq!(Exception::from_code(7), Exception::Unknown(7));
    assert_eq!(std::format!("{}", Exception::from_code(0x63)), "exception 0x63, unknown exception");
}

#[test]
fn what_does_not_answer_the_request_is_a_violation() {
    let function = |received| Violation::Response(ResponseError::Function { expected: 3, received });
    let length = |expected, received| Violation::Response(ResponseError::Length { expected, received });
    for (answer, violation) in [
        (frame(1, 2, &[3, 4, 0, 0, 0, 0]), Violation::Unit { expected: 1, received: 2 }),
        (frame(2, 1, &[3, 4, 0, 0, 0, 0]), Violation::Transaction { newest: 1, received: 2 }),
        (frame(1, 1, &[4, 4, 0, 0, 0, 0]), function(4)),
        (frame(1, 1, &[0x84, 2]), function(0x84)),
        (frame(1, 1, &[0x83]), length(2, 1)),
        (frame(1, 1, &[0x83, 2, 0]), length(2, 3)),
        (frame(1, 1, &[3]), length(6, 1)),
        (frame(1, 1, &[3, 4, 0, 0, 0]), length(6, 5)),
        (frame(1, 1, &[3, 4, 0, 0, 0, 0, 0]), length(6, 7)),
        (
            frame(1, 1, &[3, 2, 0, 0]),
            Violation::Response(ResponseError::ByteCount { expected: 4, received: 2 }),
        ),
        (vec![0, 1, 0, 9, 0, 3, 1], Violation::Header(AduError::Protocol { received: 9 })),
    ] {
        let mut client = Client::new(1);
        started(&mut client, READ_TWO);
        let mut bytes = &answer[..];
        assert_eq!(client.receive(&mut bytes), Some(ClientEvent::Violation(violation)), "{answer:02x?}");
        assert!(!client.busy() && bytes.is_empty());
    }
    let mut client = Client::new(1);
    started(&mut client, Request::WriteCoil { address: 7, value: true });
    let expected = RequestHead { function: 5, address: 7, count_or_value: 0xFF00 };
    let received = RequestHead { count_or_value: 0, ..expected };
    let violation = Violation::Response(ResponseError::Echo { expected, received });
    let echo = frame(1, 1, &[5, 0, 7, 0, 0]);
    assert_eq!(client.receive(&mut &echo[..]), Some(ClientEvent::Violation(violation)));
}

#[test]
fn a_reset_client_forgets_half_an_answer() {
    let mut client = Client::new(1);
    started(&mut client, READ_TWO);
    assert_eq!(client.receive(&mut &frame(1, 1, &[3, 4, 0, 0, 0, 0])[..9]), None);
    client.reset();
    started(&mut client, READ_TWO);
    let answer = frame(2, 1, &[3, 4, 0, 1, 0, 2]);
    let expected = Response::Registers(Registers::new(&[0, 1, 0, 2]).unwrap());
    assert_eq!(client.receive(&mut &answer[..]), Some(ClientEvent::Response(expected)));
}

#[test]
fn coils_are_packed_from_the_least_significant_bit() {
    let mut buffer = [0xA5; 3];
    let coils = Coils::pack([true, false, false, false, false, false, false, true, false, true], &mut buffer);
    let coils = coils.unwrap();
    assert_eq!((coils.packed(), coils.count(), coils.last_mask()), (&[0x81, 0x02][..], 10, 0x03));
    assert_eq!((coils.coil(0), coils.coil(9), coils.coil(10)), (Some(true), Some(true), None));
    assert_eq!(Some(coils), Coils::new(&[0x81, 0xFE], 10), "bits beyond the last coil do not count");
    assert_ne!(Some(coils), Coils::new(&[0x81, 0xFC], 10));
    assert_eq!(Coils::new(&[0xFF], 9), None);
    assert_eq!(Coils::new(&[], 0), None);
    assert_eq!(Coils::pack([], &mut buffer), None);
    assert_eq!(Coils::pack([true; 25], &mut buffer), None);
    assert_eq!(Coils::pack([true; 2001], &mut [0; 300]), None);
}

#[test]
fn a_byte_variable_is_read_from_any_coil_on() {
    let coils = Coils::new(&[0b1010_0101, 0b1111_0011, 0xFF], 18).unwrap();
    assert_eq!((coils.byte(0), coils.byte(8)), (Some(0b1010_0101), Some(0b1111_0011)));
    assert_eq!((coils.byte(3), coils.byte(16)), (Some(0b0111_0100), Some(0b11)));
    assert_eq!((coils.byte(17), coils.byte(18), coils.byte(0xFFFF)), (Some(1), None, None));
    for first in 0..18 {
        let slow = (first..18).take(8).enumerate();
        let slow = slow.map(|(bit, nth)| u8::from(coils.coil(nth).unwrap()) << bit).sum();
        assert_eq!(coils.byte(first), Some(slow), "from {first}");
    }
}

#[test]
fn registers_are_big_endian() {
    let mut buffer = [0xA5; 5];
    let registers = Registers::pack([0x0102, 0xFFFE], &mut buffer).unwrap();
    assert_eq!((registers.as_be_bytes(), registers.count()), (&[1, 2, 0xFF, 0xFE][..], 2));
    assert_eq!((registers.register(1), registers.register(2)), (Some(0xFFFE), None));
    assert_eq!(Registers::from_little_endian(&[2, 1, 0xFE, 0xFF], &mut [0; 4]), Some(registers));
    assert_eq!(Registers::from_little_endian(&[2, 1, 0xFE], &mut [0; 4]), None);
    assert_eq!(Registers::pack([1, 2, 3], &mut [0; 5]), None);
    assert_eq!((Registers::new(&[]), Registers::new(&[1])), (None, None));
    assert_eq!(Registers::new(&[0; 252]), None);
}

#[test]
fn registers_are_copied_whole_and_no_further() {
    let bytes: Vec<u8> = (0..250).map(|nth: u8| nth.wrapping_mul(7)).collect();
    for count in 1..=125 {
        let registers = Registers::new(&bytes[..2 * count]).unwrap();
        for room in [0, 1, count - 1, count, count + 1, 130] {
            let mut words = [0xA5A5; 131];
            let copied = registers.copy_to(&mut words[..room]);
            assert_eq!(copied, count.min(room));
            assert!(registers.iter().take(copied).eq(words[..copied].iter().copied()), "{count} to {room}");
            assert!(words[copied..].iter().all(|&word| word == 0xA5A5), "{count} to {room}");
        }
    }
}

#[test]
fn coils_are_copied_without_the_bits_beyond_the_last() {
    let packed = [0xFF; 40];
    for count in 1..=320 {
        let coils = Coils::new(&packed, count).unwrap();
        let len = coils.packed().len();
        let mut bytes = [0xA5; 41];
        assert_eq!(coils.copy_to(&mut bytes), Some(len));
        assert_eq!(bytes.iter().take(len).map(|byte| byte.count_ones()).sum::<u32>(), u32::from(count));
        assert_eq!((bytes[len - 1], bytes[len]), (coils.last_mask(), 0xA5));
        bytes.fill(0xA5);
        assert_eq!((coils.copy_to(&mut bytes[..len - 1]), bytes), (None, [0xA5; 41]));
    }
}

/// The fast path accepts only the right answer; anything else gives the same result as in pieces.
#[test]
fn an_answer_in_one_piece_is_what_it_is_in_two() {
    let (on, words) = ([0x5A, 0x03], [0, 1, 0, 2]);
    let requests = [
        Request::ReadCoils { address: 1, count: 19 },
        READ_TWO,
        Request::WriteCoil { address: 3, value: true },
        Request::WriteRegister { address: 3, value: 9 },
        Request::WriteCoils { address: 0, coils: Coils::new(&on, 11).unwrap() },
        Request::WriteRegisters { address: 2, registers: Registers::new(&words).unwrap() },
    ];
    for request in requests {
        let mut client = Client::new(7);
        let asked = started(&mut client, request);
        let answer = serve(&mut Bank::default(), &asked, asked.len()).unwrap();
        assert!(matches!(client.clone().receive(&mut &answer[..]), Some(ClientEvent::Response(_))));
        let changed = (0..8 * answer.len()).map(|bit| {
            let mut answer = answer.clone();
            answer[bit / 8] ^= 1 << (bit % 8);
            answer
        });
        let longer = [[&answer[..], &[1]].concat(), answer[..answer.len() - 1].to_vec()];
        for answer in changed.chain(longer).chain([answer.clone()]) {
            let (mut whole, mut cut) = (client.clone(), client.clone());
            let (mut all, mut first, mut rest) = (&answer[..], &answer[..1], &answer[1..]);
            assert_eq!(cut.receive(&mut first), None);
            let seen = whole.receive(&mut all).map(|event| std::format!("{event:?}"));
            assert_eq!(seen, cut.receive(&mut rest).map(|event| std::format!("{event:?}")), "{answer:02x?}");
            assert_eq!((all.len(), whole.busy()), (rest.len(), cut.busy()), "{answer:02x?}");
        }
    }
}
