//! Modbus, port 2000 and slcan, both sides of each.

use core::hint::black_box;

use proto_core::command::{
    Action, CommandClient, CommandServer, Keyword, Percent, Reply, Request as Command, StateCodes,
};
use proto_core::modbus::adu::{AduReader, MAX_ADU, MAX_PDU};
use proto_core::modbus::client::Client;
use proto_core::modbus::map::{self, Space};
use proto_core::modbus::pdu::{Request, RequestHead, Response, exception_pdu};
use proto_core::modbus::server::{RegisterBank, Server, answer};
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::time::Instant;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::{slcan, state};

use crate::{any, bytes, out_buf};

pub(crate) fn all() {
    modbus_client();
    modbus_server();
    modbus_pdus();
    modbus_values();
    command_client();
    command_server();
    command_texts();
    slcan_channel();
}

#[inline(never)]
fn modbus_client() {
    let mut client = Client::new(any(1));
    let client = black_box(&mut client);
    let mut out = [0; MAX_ADU];
    let request = any(Request::ReadCoils { address: 0, count: 1 });
    let _ = black_box(client.start(request, out_buf(&mut out)));
    let mut chunk = bytes();
    while let Some(event) = client.receive(&mut chunk) {
        let _ = black_box(event);
    }
    black_box((client.busy(), client.in_flight(), client.stale_answers()));
    client.abort();
    client.reset();
}

pub(crate) struct AnyBank;

impl RegisterBank for AnyBank {
    fn read_coils(&self, _: u16, _: u16, packed: &mut [u8]) -> Result<(), Exception> {
        black_box(packed);
        any(Ok(()))
    }

    fn write_coils(&mut self, _: u16, coils: Coils<'_>) -> Result<(), Exception> {
        coils.iter().for_each(|coil| _ = black_box(coil));
        any(Ok(()))
    }

    fn read_holding(&self, _: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        black_box(words);
        any(Ok(()))
    }

    fn read_discrete(&self, _: u16, _: u16, packed: &mut [u8]) -> Result<(), Exception> {
        black_box(packed);
        any(Ok(()))
    }

    fn read_input(&self, _: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        black_box(words);
        any(Ok(()))
    }

    fn write_holding(&mut self, _: u16, registers: Registers<'_>) -> Result<(), Exception> {
        registers.iter().for_each(|register| _ = black_box(register));
        any(Ok(()))
    }
}

#[inline(never)]
fn modbus_server() {
    let (mut server, mut out, mut pdu) = (Server::new(), [0; MAX_ADU], [0; MAX_PDU]);
    let server = black_box(&mut server);
    let mut chunk = bytes();
    while let Some(answered) = server.receive(&mut chunk, &mut AnyBank, &mut out) {
        let _ = black_box(answered);
    }
    server.reset();
    black_box(answer(bytes(), &mut AnyBank, &mut pdu));
}

#[inline(never)]
fn modbus_pdus() {
    let mut out = [0; MAX_ADU];
    let mut reader = AduReader::new();
    let reader = black_box(&mut reader);
    let mut chunk = bytes();
    while let Some(adu) = reader.next_adu(&mut chunk) {
        let _ = black_box(adu);
    }
    if let Ok(request) = any(Request::parse(bytes())) {
        black_box((request.head(), request.encoded_len()));
        let _ = black_box(request.encode(out_buf(&mut out)));
    }
    let head = any(RequestHead::from_request());
    if let Ok(Ok(response)) = any(Response::parse(head, bytes())) {
        black_box(response.encoded_len());
        let _ = black_box(response.encode(out_buf(&mut out)));
    }
    black_box(exception_pdu(any(3), Exception::from_code(any(1))));
}

/// A head of any kind.
trait AnyHead {
    fn from_request() -> Self;
}

impl AnyHead for RequestHead {
    fn from_request() -> Self {
        any(Request::ReadCoils { address: 0, count: 1 }).head()
    }
}

#[inline(never)]
fn modbus_values() {
    let mut out = [0; MAX_ADU];
    if let Some(coils) = any(Coils::new(bytes(), any(9))) {
        black_box((coils.coil(any(3)), coils.byte(any(3)), coils.last_mask(), coils == any(coils)));
        coils.iter().for_each(|coil| _ = black_box(coil));
        black_box(coils.copy_to(out_buf(&mut out)));
    }
    black_box(Coils::pack(bytes().iter().map(|byte| byte & 1 != 0), out_buf(&mut out)));
    if let Some(registers) = any(Registers::new(bytes())) {
        black_box((registers.register(any(3)), registers.count()));
        registers.iter().rev().for_each(|register| _ = black_box(register));
        black_box(registers.copy_to(black_box(&mut [0; 128][..])));
    }
    black_box(Registers::pack(bytes().iter().map(|&byte| u16::from(byte)), out_buf(&mut out)));
    black_box(Registers::from_little_endian(bytes(), out_buf(&mut out)));
    for space in [Space::Coils, Space::Holding] {
        let _ = black_box(map::check_read(space, any(0), any(1)));
        let _ = black_box(map::check_write(space, any(0), any(1)));
    }
    black_box((map::scaled(any(1.5), any(100)), map::unscaled(any(7), any(0))));
}

fn dialect() -> Dialect {
    any(Dialect::V2_3)
}

#[inline(never)]
fn command_client() {
    let mut client = CommandClient::new();
    let (client, now) = (black_box(&mut client), any(Instant::ZERO));
    let mut out = [0; 320];
    let _ = black_box(client.start(now, bytes(), &dialect(), out_buf(&mut out)));
    let _ = black_box(client.start_beside(now, bytes(), &dialect(), out_buf(&mut out)));
    let mut chunk = bytes();
    while let Some(event) = client.receive(now, &mut chunk) {
        black_box(event);
    }
    black_box(client.poll(now));
    black_box((client.deadline(), client.busy(), client.busy_beside(), client.dropped_bytes()));
    client.abort();
}

#[inline(never)]
fn command_server() {
    let mut server = CommandServer::new();
    let (server, now) = (black_box(&mut server), any(Instant::ZERO));
    let mut chunk = bytes();
    while let Some(event) = server.receive(now, &mut chunk) {
        black_box(event);
    }
    black_box(server.poll(now));
    black_box(server.deadline());
    server.reset();
}

#[inline(never)]
fn command_texts() {
    let mut out = [0; 320];
    let _ = black_box(Command::parse_strict(bytes()));
    if let Ok(command) = any(Command::parse(bytes())) {
        black_box(command.keyword());
        let _ = black_box(command.encode(&dialect(), out_buf(&mut out)));
    }
    if let Some(reply) = any(Reply::parse(any(Keyword::Do(Action::Stop)), bytes())) {
        black_box(reply.kind());
        let _ = black_box(reply.encode(&dialect(), out_buf(&mut out)));
    }
    if let Some(percent) = any(Percent::new(any(12.5))) {
        black_box((percent.value(), Percent::parse(any("12.5"))));
    }
    black_box(Keyword::from_word(any("stop")));
    let (robot, program) = (any(state::RobotState::Enable), any(state::ProgramState::Stopped));
    let (safety, mode) = (any(state::SafetyState::Run), any(state::OperationMode::Auto));
    black_box(StateCodes::new(&dialect(), robot, program, safety, mode));
}

#[inline(never)]
fn slcan_channel() {
    let mut channel = slcan::Channel::new(any(500_000));
    let channel = black_box(&mut channel);
    let mut chunk = bytes();
    while let Some(reaction) = channel.receive(&mut chunk) {
        black_box(reaction);
    }
    channel.note_overrun();
    black_box((channel.state(), channel.refused()));
    let _ = black_box(slcan::decode(bytes()));
    if let Some(frame) = any(CanFrame::new(any(CanId::Standard(1)), bytes())) {
        black_box(channel.deliver(&frame, any(0)));
        black_box(slcan::encode(&frame, any(None)));
    }
}
