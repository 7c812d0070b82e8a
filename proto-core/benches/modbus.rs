//! Whole Modbus exchanges, client and server together, beside the bare limit: copying the same
//! bytes. `-- instructions` counts instructions instead of measuring time.

mod instructions;

use std::hint::black_box;
use std::process::ExitCode;

use divan::Bencher;
use instructions::Work;
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::client::{Client, ClientEvent};
use proto_core::modbus::map::{COILS, HOLDING, Space, check_read, check_write};
use proto_core::modbus::pdu::{Request, Response};
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};

const WORDS: usize = HOLDING as usize;
const DIGITAL_OUTPUTS: u16 = 192;
/// All coils but the first, so that no byte of the answer is one of the bank.
const COILS_READ: usize = COILS as usize - 1;

fn main() -> ExitCode {
    let works = [
        Work { name: "read 118 registers", limit: Some(380), run: |n| repeat(n, &mut Exchange::read) },
        Work { name: "read 118 registers, bare copy", limit: None, run: |n| repeat(n, &mut Bare::read) },
        Work { name: "write 16 coils", limit: Some(280), run: |n| repeat(n, &mut Exchange::write) },
        Work { name: "write 16 coils, bare copy", limit: None, run: |n| repeat(n, &mut Bare::write) },
        Work { name: "read 231 coils", limit: Some(1160), run: |n| repeat(n, &mut Exchange::read_coils) },
        Work {
            name: "read 231 coils, one by one",
            limit: None,
            run: |n| repeat(n, &mut Exchange::read_each_coil),
        },
    ];
    instructions::main(&works).unwrap_or_else(|| {
        divan::main();
        ExitCode::SUCCESS
    })
}

#[divan::bench]
fn read_118_registers(bencher: Bencher<'_, '_>) {
    let mut exchange = Exchange::default();
    bencher.bench_local(|| exchange.read());
}

#[divan::bench]
fn read_118_registers_bare_copy(bencher: Bencher<'_, '_>) {
    let mut bare = Bare::default();
    bencher.bench_local(|| bare.read());
}

#[divan::bench]
fn write_16_coils(bencher: Bencher<'_, '_>) {
    let mut exchange = Exchange::default();
    bencher.bench_local(|| exchange.write());
}

#[divan::bench]
fn write_16_coils_bare_copy(bencher: Bencher<'_, '_>) {
    let mut bare = Bare::default();
    bencher.bench_local(|| bare.write());
}

#[divan::bench]
fn read_231_coils(bencher: Bencher<'_, '_>) {
    let mut exchange = Exchange::default();
    bencher.bench_local(|| exchange.read_coils());
}

fn repeat<T: Default>(iterations: u64, work: &mut impl FnMut(&mut T)) {
    let mut state = T::default();
    for _ in 0..iterations {
        work(black_box(&mut state));
    }
}

/// Both ends of a connection and the server's data.
struct Exchange {
    client: Client,
    server: Server,
    bank: Bank,
    request: [u8; MAX_ADU],
    answer: [u8; MAX_ADU],
    words: [u16; WORDS],
    /// Eight coils each, as byte variables have them.
    coils: [u8; COILS_READ.div_ceil(8)],
    each_coil: [bool; COILS_READ],
    each: bool,
}

impl Default for Exchange {
    fn default() -> Self {
        let words: [u16; WORDS] = std::array::from_fn(|nth| nth as u16 * 0x0101);
        Self {
            client: Client::new(1),
            server: Server::new(),
            bank: Bank {
                coils: std::array::from_fn(|nth| (nth as u8).wrapping_mul(0x1B)),
                words: words.map(u16::to_be_bytes),
            },
            request: [0; MAX_ADU],
            answer: [0; MAX_ADU],
            words: [0; WORDS],
            coils: [0; COILS_READ.div_ceil(8)],
            each_coil: [false; COILS_READ],
            each: false,
        }
    }
}

impl Exchange {
    fn read(&mut self) {
        let request = Request::ReadHolding { address: 0, count: black_box(HOLDING) };
        self.exchange(request);
        assert_eq!(self.words[WORDS - 1].to_be_bytes(), self.bank.words[WORDS - 1]);
    }

    fn write(&mut self) {
        let packed = black_box([0x5A, 0xC3]);
        let coils = Coils::new(&packed, 16).expect("two bytes are sixteen coils");
        self.exchange(Request::WriteCoils { address: black_box(DIGITAL_OUTPUTS), coils });
        assert_eq!(self.bank.coils[24..26], packed);
    }

    fn read_coils(&mut self) {
        let request = Request::ReadCoils { address: 1, count: black_box(COILS_READ as u16) };
        self.exchange(request);
        assert_eq!(self.coils[0], self.bank.coils[0] >> 1 | self.bank.coils[1] << 7);
    }

    fn read_each_coil(&mut self) {
        self.each = true;
        self.exchange(Request::ReadCoils { address: 1, count: black_box(COILS_READ as u16) });
        assert_eq!(self.each_coil[7], self.bank.coils[1] & 1 == 1);
    }

    fn exchange(&mut self, request: Request<'_>) {
        let sent = self.client.start(request, &mut self.request).expect("idle");
        let mut received = black_box(&self.request[..sent]);
        let answered = self.server.receive(&mut received, &mut self.bank, &mut self.answer);
        let answered = answered.expect("a whole request").expect("a good header");
        let mut received = black_box(&self.answer[..answered]);
        match self.client.receive(&mut received) {
            Some(ClientEvent::Response(Response::Registers(registers))) => {
                registers.copy_to(&mut self.words);
            }
            Some(ClientEvent::Response(Response::Coils(coils))) => {
                if self.each {
                    self.each_coil.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
                } else {
                    let firsts = (0..).step_by(8);
                    self.coils.iter_mut().zip(firsts).for_each(|(eight, first)| {
                        *eight = coils.byte(first).unwrap_or_default();
                    });
                }
            }
            Some(ClientEvent::Response(_)) => {}
            other => panic!("{other:?}"),
        }
        black_box((&mut self.words, &mut self.coils, &mut self.each_coil));
    }
}

/// The controller's map with its access rules, all of it kept as the wire has it. A byte more, so that each coil is in
/// two neighbours.
struct Bank {
    coils: [u8; 30],
    words: [[u8; 2]; WORDS],
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        check_read(Space::Coils, address, count)?;
        let (first, shift) = (usize::from(address / 8), address % 8);
        for (target, pair) in packed.iter_mut().zip(self.coils[first..].windows(2)) {
            *target = (u16::from_le_bytes([pair[0], pair[1]]) >> shift) as u8;
        }
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        check_write(Space::Coils, address, coils.count())?;
        if address.is_multiple_of(8) && coils.count().is_multiple_of(8) {
            let target = self.coils.get_mut(usize::from(address / 8)..).unwrap_or_default();
            return coils.copy_to(target).map(|_| ()).ok_or(Exception::IllegalDataAddress);
        }
        Err(Exception::DeviceFailure)
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        check_read(Space::Holding, address, words.len() as u16)?;
        words.copy_from_slice(&self.words[usize::from(address)..][..words.len()]);
        Ok(())
    }

    fn write_holding(&mut self, _: u16, _: Registers<'_>) -> Result<(), Exception> {
        Err(Exception::DeviceFailure)
    }
}

/// The bytes of the same exchanges, only copied: to the wire, and from it to whoever wants them.
struct Bare {
    request: [u8; MAX_ADU],
    answer: [u8; MAX_ADU],
    bank: [u8; 2 * WORDS],
    words: [u8; 2 * WORDS],
}

impl Default for Bare {
    fn default() -> Self {
        Self { request: [0; MAX_ADU], answer: [0; MAX_ADU], bank: [0x5A; 2 * WORDS], words: [0; 2 * WORDS] }
    }
}

impl Bare {
    fn read(&mut self) {
        self.request[..12].copy_from_slice(black_box(&[3; 12]));
        black_box(&self.request[..12]);
        self.answer[..9].copy_from_slice(black_box(&[3; 9]));
        self.answer[9..245].copy_from_slice(black_box(&self.bank));
        self.words.copy_from_slice(&black_box(&self.answer)[9..245]);
        black_box(&mut self.words);
    }

    fn write(&mut self) {
        self.request[..15].copy_from_slice(black_box(&[15; 15]));
        self.bank[..2].copy_from_slice(&black_box(&self.request)[13..15]);
        self.answer[..12].copy_from_slice(&black_box(&self.request)[..12]);
        black_box((&self.answer, &mut self.bank));
    }
}
