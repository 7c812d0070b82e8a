//! A whole exchange, client and server together: reading 118 words, writing 16 coils.

use std::hint::black_box;

use modbus_core::tcp::{self as core_tcp};
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::pdu::{Request, Response};
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};
use rmodbus::ModbusProto;
use rmodbus::client::ModbusRequest;
use rmodbus::server::ModbusFrame;
use rmodbus::server::storage::ModbusStorageFull;

const WORDS: u16 = 118;
const FIRST_COIL: u16 = 192;
const COILS: u16 = 16;

/// What is done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum What {
    Words,
    Coils,
}

/// The value of a word in the server.
fn word(nth: u16) -> u16 {
    nth.wrapping_mul(0x0101)
}

fn pattern() -> [u8; 2] {
    black_box([0x5A, 0xC3])
}

/// The same, for libraries that take no packed coils.
fn bits() -> [bool; COILS as usize] {
    let pattern = pattern();
    std::array::from_fn(|nth| pattern[nth / 8] >> (nth % 8) & 1 == 1)
}

/// This project's client and server.
pub(crate) struct ProtoCore {
    client: Client,
    server: Server,
    bank: Bank,
    request: [u8; MAX_ADU],
    answer: [u8; MAX_ADU],
    words: [u16; WORDS as usize],
}

struct Bank {
    words: [[u8; 2]; WORDS as usize],
    coils: [u8; 32],
}

impl Default for ProtoCore {
    fn default() -> Self {
        Self {
            client: Client::new(1),
            server: Server::new(),
            bank: Bank { words: std::array::from_fn(|nth| word(nth as u16).to_be_bytes()), coils: [0; 32] },
            request: [0; MAX_ADU],
            answer: [0; MAX_ADU],
            words: [0; WORDS as usize],
        }
    }
}

impl RegisterBank for Bank {
    fn read_coils(&self, _: u16, _: u16, _: &mut [u8]) -> Result<(), Exception> {
        Err(Exception::DeviceFailure)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        if !address.is_multiple_of(8) || !coils.count().is_multiple_of(8) {
            return Err(Exception::DeviceFailure);
        }
        let target = self.coils.get_mut(usize::from(address / 8)..).unwrap_or_default();
        let target = target.get_mut(..coils.packed().len()).ok_or(Exception::IllegalDataAddress)?;
        target.copy_from_slice(coils.packed());
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let source = self.words.get(usize::from(address)..).unwrap_or_default();
        words.copy_from_slice(source.get(..words.len()).ok_or(Exception::IllegalDataAddress)?);
        Ok(())
    }

    fn write_holding(&mut self, _: u16, _: Registers<'_>) -> Result<(), Exception> {
        Err(Exception::DeviceFailure)
    }
}

impl ProtoCore {
    pub(crate) fn repeat(&mut self, iterations: u64, what: What) {
        for _ in 0..iterations {
            let packed = pattern();
            let request = match what {
                What::Words => Request::ReadHolding { address: 0, count: black_box(WORDS) },
                What::Coils => Request::WriteCoils {
                    address: black_box(FIRST_COIL),
                    coils: Coils::new(&packed, COILS).expect("two bytes are sixteen coils"),
                },
            };
            let sent = self.client.start(request, &mut self.request).expect("idle");
            let mut received = black_box(&self.request[..sent]);
            let answered = self.server.receive(&mut received, &mut self.bank, &mut self.answer);
            let answered = answered.expect("a whole request").expect("a good header");
            let mut received = black_box(&self.answer[..answered]);
            if let Some(ClientEvent::Response(Response::Registers(words))) =
                self.client.receive(&mut received)
            {
                words.copy_to(&mut self.words);
            }
            black_box(&mut self.words);
        }
        check(what, self.words.last().copied(), &self.bank.coils[24..26]);
    }
}

fn check(what: What, last: Option<u16>, coils: &[u8]) {
    match what {
        What::Words => assert_eq!(last, Some(word(WORDS - 1))),
        What::Coils => assert_eq!(coils, pattern()),
    }
}

/// The codec of modbus-core, with the tables and the checks of a transaction that its user has to write.
pub(crate) struct ModbusCore {
    transaction: u16,
    bank_words: [u16; WORDS as usize],
    coils: [u8; 32],
    request: [u8; MAX_ADU],
    answer: [u8; MAX_ADU],
    words: [u16; WORDS as usize],
}

impl Default for ModbusCore {
    fn default() -> Self {
        Self {
            transaction: 0,
            bank_words: std::array::from_fn(|nth| word(nth as u16)),
            coils: [0; 32],
            request: [0; MAX_ADU],
            answer: [0; MAX_ADU],
            words: [0; WORDS as usize],
        }
    }
}

impl ModbusCore {
    pub(crate) fn repeat(&mut self, iterations: u64, what: What) {
        for _ in 0..iterations {
            self.exchange(what);
            black_box(&mut self.words);
        }
        check(what, self.words.last().copied(), &self.coils[24..26]);
    }

    fn exchange(&mut self, what: What) {
        use modbus_core::{Request, RequestPdu, Response, ResponsePdu};
        self.transaction = self.transaction.wrapping_add(1);
        let hdr = core_tcp::Header { transaction_id: self.transaction, unit_id: 1 };
        let mut packed = [0; 2];
        let request = match what {
            What::Words => Request::ReadHoldingRegisters(0, black_box(WORDS)),
            What::Coils => {
                let coils = modbus_core::Coils::from_bools(&bits(), &mut packed).expect("room");
                Request::WriteMultipleCoils(black_box(FIRST_COIL), coils)
            }
        };
        let adu = core_tcp::RequestAdu { hdr, pdu: RequestPdu(request) };
        let sent = core_tcp::client::encode_request(adu, &mut self.request).expect("room");

        let received = black_box(&self.request[..sent]);
        let adu = core_tcp::server::decode_request(received).expect("a request").expect("a whole one");
        let mut bytes = [0; 2 * WORDS as usize];
        let response = match adu.pdu.0 {
            Request::ReadHoldingRegisters(address, count) => {
                let words = &self.bank_words[usize::from(address)..][..usize::from(count)];
                Response::ReadHoldingRegisters(
                    modbus_core::Data::from_words(words, &mut bytes).expect("room"),
                )
            }
            Request::WriteMultipleCoils(address, coils) => {
                for (nth, coil) in coils.into_iter().enumerate() {
                    let at = usize::from(address) + nth;
                    let byte = self.coils.get_mut(at / 8).expect("in the table");
                    *byte = *byte & !(1 << (at % 8)) | u8::from(coil) << (at % 8);
                }
                Response::WriteMultipleCoils(address, COILS)
            }
            other => panic!("{other:?}"),
        };
        let adu = core_tcp::ResponseAdu { hdr: adu.hdr, pdu: ResponsePdu(Ok(response)) };
        let answered = core_tcp::server::encode_response(adu, &mut self.answer).expect("room");

        let received = black_box(&self.answer[..answered]);
        let adu = core_tcp::client::decode_response(received).expect("an answer").expect("a whole one");
        assert_eq!(adu.hdr, hdr);
        if let Ok(Response::ReadHoldingRegisters(words)) = adu.pdu.0 {
            self.words.iter_mut().zip(words).for_each(|(word, value)| *word = value);
        }
    }
}

/// rmodbus, which has a client, a server and their tables.
pub(crate) struct Rmodbus {
    transaction: u16,
    bank: Box<ModbusStorageFull>,
    request: Vec<u8>,
    answer: Vec<u8>,
    words: Vec<u16>,
}

impl Default for Rmodbus {
    fn default() -> Self {
        let mut bank = Box::new(ModbusStorageFull::new());
        for nth in 0..WORDS {
            bank.holdings[usize::from(nth)] = word(nth);
        }
        Self { transaction: 0, bank, request: Vec::new(), answer: Vec::new(), words: Vec::new() }
    }
}

impl Rmodbus {
    pub(crate) fn repeat(&mut self, iterations: u64, what: What) {
        for _ in 0..iterations {
            self.exchange(what);
            black_box(&mut self.words);
        }
        let coils = &self.bank.coils[usize::from(FIRST_COIL)..][..usize::from(COILS)];
        let packed: Vec<u8> = coils
            .chunks(8)
            .map(|bits| bits.iter().rev().fold(0, |byte, &bit| byte << 1 | u8::from(bit)))
            .collect();
        check(what, self.words.last().copied(), &packed);
    }

    fn exchange(&mut self, what: What) {
        self.transaction = self.transaction.wrapping_add(1);
        self.request.clear();
        self.answer.clear();
        self.words.clear();
        let mut client = ModbusRequest::new_tcp_udp(1, self.transaction);
        match what {
            What::Words => client.generate_get_holdings(0, black_box(WORDS), &mut self.request),
            What::Coils => client.generate_set_coils_bulk(black_box(FIRST_COIL), &bits(), &mut self.request),
        }
        .expect("room");

        let received = black_box(&self.request[..]);
        let mut frame = ModbusFrame::new(1, received, ModbusProto::TcpUdp, &mut self.answer);
        frame.parse().expect("a request");
        assert!(frame.processing_required && frame.response_required);
        match frame.readonly {
            true => frame.process_read(&*self.bank),
            false => frame.process_write(&mut *self.bank),
        }
        .expect("in the tables");
        frame.finalize_response().expect("room");

        let received = black_box(&self.answer[..]);
        match what {
            What::Words => client.parse_u16(received, &mut self.words),
            What::Coils => client.parse_ok(received),
        }
        .expect("an answer");
    }
}
