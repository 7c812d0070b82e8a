//! What devices with frames of their own say in `any_engine`, and what may be sent to them.
//!
//! Frames that a device sends are made by the layouts under test, so that some are right; what is sent
//! to it is looked at byte by byte.

use proto_core::config::{
    Bus, DeviceFrame, Echo, Exchange, FieldSpec, FrameSpec, GatewayConfig, Parts, Recipe, StreamPart,
    Transaction,
};
use proto_core::device::{Carrier, Escape};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::Direction;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;

use crate::source::Source;

/// What was said on a port.
#[derive(Clone, Default)]
pub(crate) struct Said {
    /// The newest bytes that were sent; over Modbus TCP, those behind the header.
    pub sent: Vec<u8>,
    /// The id of the newest request over Modbus TCP.
    pub transaction: u16,
    /// A slave has been asked and may still answer: at the earliest until when.
    pub awaits: Option<Instant>,
}

pub(crate) fn recipe_of(config: &GatewayConfig, port: usize) -> Option<&Recipe> {
    config.recipes.get(usize::from(config.ports.get(port)?.recipe))
}

/// Whether a port's devices are reached by Modbus TCP.
pub(crate) fn is_tcp(config: &GatewayConfig, port: usize) -> bool {
    config.ports.get(port).is_some_and(|port| matches!(port.bus, Bus::ModbusTcp { .. }))
}

/// A request over Modbus TCP as one on a line: without its header, and with a CRC; and its id. `None` if the header is
/// wrong.
pub(crate) fn request_over_tcp(bytes: &[u8]) -> Option<(u16, Vec<u8>)> {
    let (&[t1, t0, p1, p0, l1, l0], rest) = bytes.split_first_chunk()?;
    let is_right = (p1, p0) == (0, 0) && usize::from(u16::from_be_bytes([l1, l0])) == rest.len();
    is_right.then(|| (u16::from_be_bytes([t1, t0]), with_crc(rest)))
}

/// What a server says in place of a slave that says `frame`: with the header of the newest request, or with another one.
pub(crate) fn over_tcp(frame: &[u8], said: &Said, op: u8) -> Vec<u8> {
    let pdu = &frame[..frame.len().saturating_sub(2)];
    let newest = said.transaction;
    let (id, protocol, len) = match op >> 4 {
        0..11 => (newest, 0, pdu.len()),
        // Late.
        11 | 12 => (newest.wrapping_sub(u16::from(op >> 4) - 10), 0, pdu.len()),
        13 => (newest ^ 0x5500, 0, pdu.len()),
        14 => (newest, 1, pdu.len()),
        _ => (newest, 0, pdu.len() ^ 1),
    };
    let [l1, l0] = (len as u16).to_be_bytes();
    [&id.to_be_bytes()[..], &[0, protocol, l1, l0], pdu].concat()
}

/// The shortest time for which a reply is waited on this port; `None` without a master of Modbus there.
pub(crate) fn shortest_wait(config: &GatewayConfig, port: usize) -> Option<Duration> {
    let exchanges = exchanges(config, port).iter();
    let rtu = exchanges.filter(|exchange| matches!(exchange.transaction, Transaction::Rtu { .. }));
    rtu.map(|exchange| exchange.timeout).min()
}

pub(crate) fn exchanges(config: &GatewayConfig, port: usize) -> &[Exchange] {
    recipe_of(config, port).map_or(&[], |recipe| recipe.exchanges.of(&config.exchanges))
}

/// Bytes that a device may say now; `None` for a recipe without frames of its own.
pub(crate) fn bytes(
    config: &GatewayConfig,
    port: usize,
    said: &Said,
    input: &mut Source<'_>,
) -> Option<Vec<u8>> {
    let recipe = recipe_of(config, port)?;
    let which = input.u8();
    let exchanges = exchanges(config, port);
    if let Parts::Stream { input: Some(part), .. } = &recipe.parts
        && (exchanges.is_empty() || which & 1 == 0)
    {
        return part_frame(config, part, input);
    }
    let exchange = exchanges.get(usize::from(which >> 1) % exchanges.len().max(1))?;
    let frame = match exchange.transaction {
        Transaction::Frames { reply, refusal, .. } => {
            let nth = answer(which, [reply, exchange.pending, refusal]);
            let spec = config.frames.get(usize::from(nth?))?;
            own_frame(config, spec, Carrier::Stream, input)?
        }
        Transaction::Rtu { .. } => slaves_reply(&said.sent, which, input)?,
        Transaction::Served { operation, .. } => {
            with_crc(&masters_request(exchange.peer, operation, which, input))
        }
    };
    let has_echo = matches!(&config.ports.get(port)?.bus, Bus::Rs485(line) if line.echo == Echo::Yes);
    Some(if has_echo && which & 0x40 == 0 { [&said.sent[..], &frame].concat() } else { frame })
}

/// A frame that a device may send on a bus now.
pub(crate) fn can(config: &GatewayConfig, port: usize, input: &mut Source<'_>) -> Option<CanFrame> {
    let which = input.u8();
    let exchanges = exchanges(config, port);
    let exchange = exchanges.get(usize::from(which >> 1) % exchanges.len().max(1))?;
    let Transaction::Frames { reply, refusal, .. } = exchange.transaction else { return None };
    let nth = answer(which, [reply, exchange.pending, refusal]);
    let spec = config.frames.get(usize::from(nth?))?;
    CanFrame::new(spec.id?, &own_frame(config, spec, Carrier::Can, input)?)
}

/// One of the answers: the reply, or the pending answer or the refusal if there is one.
fn answer(which: u8, [reply, pending, refusal]: [Option<u8>; 3]) -> Option<u8> {
    match which >> 6 {
        0 | 1 => reply,
        2 => pending.or(refusal).or(reply),
        _ => refusal.or(reply),
    }
}

fn part_frame(config: &GatewayConfig, part: &StreamPart, input: &mut Source<'_>) -> Option<Vec<u8>> {
    let fields = part.fields.of(&config.fields);
    let frame = encoded(Carrier::Stream, (&part.head, &part.tail), fields, input)?;
    let Some(escape) = part.escape else { return Some(frame) };
    let mut out = vec![0; escape.longest(frame.len())];
    out[..frame.len()].copy_from_slice(&frame);
    let len = escape.stuff(frame.len(), &mut out)?;
    out.truncate(len);
    Some(out)
}

fn own_frame(
    config: &GatewayConfig,
    spec: &FrameSpec,
    carrier: Carrier,
    input: &mut Source<'_>,
) -> Option<Vec<u8>> {
    encoded(carrier, (&spec.head, &spec.tail), spec.fields.of(&config.fields), input)
}

fn encoded(
    carrier: Carrier,
    delimiters: (&[u8], &[u8]),
    fields: &[FieldSpec],
    input: &mut Source<'_>,
) -> Option<Vec<u8>> {
    let frame = DeviceFrame::new(carrier, Direction::Input, delimiters, fields).ok()?;
    let seed = input.u8();
    let text = |_: usize, out: &mut [u8]| {
        let len = usize::from(seed & 1);
        out.get_mut(..len)?.fill(b'x');
        Some(len)
    };
    let mut out = [0; 512];
    let number = |nth: usize| f64::from(seed >> (nth % 8) & 7);
    let len = frame.layout.encode_with(&frame.elements, number, text, &mut out)?;
    Some(out[..len].to_vec())
}

/// What a slave replies to this request: as asked, a refusal, or of another slave or length.
fn slaves_reply(request: &[u8], which: u8, input: &mut Source<'_>) -> Option<Vec<u8>> {
    let [slave, function, _, _, high, low] = *request.first_chunk()?;
    let count = usize::from(u16::from_be_bytes([high, low]));
    let value = input.u8();
    let data = |len: usize| [&[slave, function, len as u8][..], &vec![value; len]].concat();
    Some(with_crc(&match (which >> 4 & 7, function) {
        (6, _) => vec![slave, function | 0x80, value],
        (7, _) => vec![slave ^ 1, function, 2, value, value],
        (5, _) => data(usize::from(value)),
        (_, 1 | 2) => data(count.div_ceil(8)),
        (_, 3 | 4 | 23) => data(2 * count),
        (_, 22) => request.get(..8)?.to_vec(),
        _ => request[..6].to_vec(),
    }))
}

/// What a master asks of this block: right, a part of it, or of another slave.
fn masters_request(own: u8, operation: Operation, which: u8, input: &mut Source<'_>) -> Vec<u8> {
    let (_, address, count) = operation.place();
    let (address, count) = match which >> 5 & 3 {
        0 | 1 => (address, count),
        2 => (address, count - 1),
        _ => (address + 1, count),
    };
    let function = operation.function();
    let slave = if which & 16 == 0 { own } else { [0, own ^ 1][usize::from(which >> 3 & 1)] };
    let [a1, a0] = address.to_be_bytes();
    let [c1, c0] = count.to_be_bytes();
    let mut request = vec![slave, function, a1, a0, c1, c0];
    let len = match operation {
        Operation::WriteCoils { .. } => usize::from(count).div_ceil(8),
        Operation::WriteRegisters { .. } => 2 * usize::from(count),
        _ => return request,
    };
    request.push(len as u8);
    request.extend(vec![input.u8(); len]);
    request
}

/// Whether these bytes are a frame of the port: of its output part, a request, or a slave's reply.
pub(crate) fn may_be_sent(config: &GatewayConfig, port: usize, bytes: &[u8]) -> bool {
    let Some(recipe) = recipe_of(config, port) else { return false };
    if let Parts::Stream { output: Some(part), .. } = &recipe.parts
        && unescaped(part.escape, bytes)
            .is_some_and(|frame| frame.starts_with(&part.head) && frame.ends_with(&part.tail))
    {
        return true;
    }
    exchanges(config, port).iter().any(|exchange| match exchange.transaction {
        Transaction::Frames { request, .. } => {
            let spec = request.and_then(|nth| config.frames.get(usize::from(nth)));
            spec.is_some_and(|spec| bytes.starts_with(&spec.head) && bytes.ends_with(&spec.tail))
        }
        Transaction::Rtu { operation, .. } => {
            has_right_crc(bytes) && is_request(exchange.peer, operation, bytes)
        }
        // A reply is of the own address.
        Transaction::Served { .. } => has_right_crc(bytes) && bytes[0] == exchange.peer,
    })
}

/// Whether this frame is an output or a request of a CAN recipe.
pub(crate) fn may_be_sent_can(config: &GatewayConfig, port: usize, frame: &CanFrame) -> bool {
    let Some(Parts::Can { output, .. }) = recipe_of(config, port).map(|recipe| &recipe.parts) else {
        return false;
    };
    if output.iter().any(|part| part.id == frame.id()) && !frame.is_remote() {
        return true;
    }
    exchanges(config, port).iter().any(|exchange| {
        let Transaction::Frames { request: Some(request), .. } = exchange.transaction else { return false };
        let spec = config.frames.get(usize::from(request));
        spec.is_some_and(|spec| spec.id == Some(frame.id()) && spec.remote == frame.is_remote())
    })
}

/// Function codes and the order of bytes are those of the Modbus specification, section 6.
fn is_request(slave: u8, operation: Operation, bytes: &[u8]) -> bool {
    let (function, words, data) = match operation {
        Operation::ReadCoils { address, count } => (1, vec![address, count], None),
        Operation::ReadDiscreteInputs { address, count } => (2, vec![address, count], None),
        Operation::ReadHoldingRegisters { address, count } => (3, vec![address, count], None),
        Operation::ReadInputRegisters { address, count } => (4, vec![address, count], None),
        Operation::WriteCoil { address } => {
            let is_coil = matches!(bytes, [_, _, _, _, 0xFF | 0, 0, _, _]);
            return is_coil && bytes[..2] == [slave, 5] && bytes[2..4] == address.to_be_bytes();
        }
        Operation::WriteRegister { address } => {
            return bytes.len() == 8 && bytes[..2] == [slave, 6] && bytes[2..4] == address.to_be_bytes();
        }
        Operation::MaskWriteRegister { address, mask } => {
            let head = [[slave, 22], address.to_be_bytes(), (!mask).to_be_bytes()].concat();
            let Some(&[or1, or0, _, _]) = bytes.strip_prefix(&head[..]) else { return false };
            return u16::from_be_bytes([or1, or0]) & !mask == 0;
        }
        Operation::WriteCoils { address, count } => {
            (15, vec![address, count], Some(usize::from(count).div_ceil(8)))
        }
        Operation::WriteRegisters { address, count } => {
            (16, vec![address, count], Some(2 * usize::from(count)))
        }
        Operation::ReadWriteRegisters { read_address, read_count, write_address, write_count } => {
            let words = vec![read_address, read_count, write_address, write_count];
            (23, words, Some(2 * usize::from(write_count)))
        }
    };
    let mut head = vec![slave, function];
    head.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    head.extend(data.map(|len| len as u8));
    bytes.starts_with(&head) && bytes.len() == head.len() + data.unwrap_or(0) + 2
}

fn has_right_crc(frame: &[u8]) -> bool {
    frame.len() >= 4 && with_crc(&frame[..frame.len() - 2]) == frame
}

/// The CRC of Modbus over serial line, bit by bit.
fn with_crc(bytes: &[u8]) -> Vec<u8> {
    let mut crc = 0xFFFF_u16;
    for &byte in bytes {
        crc ^= u16::from(byte);
        for _ in 0..8 {
            crc = crc >> 1 ^ if crc & 1 == 1 { 0xA001 } else { 0 };
        }
    }
    [bytes, &crc.to_le_bytes()].concat()
}

/// The frame in what is on the line; `None` if it is not one that was escaped.
fn unescaped(escape: Option<Escape>, bytes: &[u8]) -> Option<Vec<u8>> {
    let Some(escape) = escape else { return Some(bytes.to_vec()) };
    let mut frame = Vec::new();
    match escape {
        Escape::Dle => {
            let inner = bytes.strip_prefix(&[0x10, 2])?.strip_suffix(&[0x10, 3])?;
            let mut inner = inner.iter();
            while let Some(&byte) = inner.next() {
                if byte == 0x10 && inner.next() != Some(&0x10) {
                    return None;
                }
                frame.push(byte);
            }
        }
        Escape::Slip => {
            let mut inner = bytes.strip_prefix(&[0xC0])?.strip_suffix(&[0xC0])?.iter();
            while let Some(&byte) = inner.next() {
                frame.push(match byte {
                    0xC0 => return None,
                    0xDB => match inner.next()? {
                        0xDC => 0xC0,
                        0xDD => 0xDB,
                        _ => return None,
                    },
                    byte => byte,
                });
            }
        }
        Escape::Cobs => {
            let mut rest = bytes.strip_suffix(&[0])?;
            // A leading zero ends what came before.
            rest = rest.strip_prefix(&[0]).unwrap_or(rest);
            while let Some((&code, behind)) = rest.split_first() {
                let len = usize::from(code).checked_sub(1)?;
                let (run, next) = behind.split_at_checked(len)?;
                if run.contains(&0) {
                    return None;
                }
                frame.extend(run);
                rest = next;
                if code < 255 && !rest.is_empty() {
                    frame.push(0);
                }
            }
        }
    }
    Some(frame)
}
