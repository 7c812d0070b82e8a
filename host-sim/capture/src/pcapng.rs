//! Captures for Wireshark: pcapng, one interface for each port.
//!
//! In: records. Out: the blocks of a file, or of a stream. CAN frames are those of SocketCAN
//! (`LINKTYPE_CAN_SOCKETCAN`). Traffic of serial lines and of links to the controller is `LINKTYPE_USER0`, which the
//! plugin of `host-sim export lua` shows. The comment of a packet says why it was rejected.

use std::sync::Arc;

use proto_core::engine::{Rejection, TapDirection, TapPlace, TapVerdict};
use proto_core::wire::can::CanId;

use crate::frame::{Frame, rejection};
use crate::record::{Cell, Record, What};
use crate::watch::Arrived;

/// The first bytes of every pcapng file.
pub const MAGIC: [u8; 4] = [0x0A, 0x0D, 0x0D, 0x0A];

/// What is captured.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Scope {
    /// Only this port; `None`: all ports.
    pub port: Option<String>,
    /// Whether links to the controller are included.
    pub links: bool,
}

/// Writes the blocks of one capture.
#[derive(Debug)]
pub struct Pcapng {
    scope: Scope,
    /// Bytes not taken yet.
    bytes: Vec<u8>,
    /// Name and link type of each interface so far.
    interfaces: Vec<(String, u16)>,
    cell: Option<Arc<Cell>>,
}

impl Pcapng {
    /// An empty capture.
    pub fn new(scope: Scope) -> Self {
        let mut new = Self { scope, bytes: Vec::new(), interfaces: Vec::new(), cell: None };
        let mut section = Block::new(u32::from_le_bytes(MAGIC));
        // The magic number shows the byte order. It is followed by version 1.0, and by an unknown length.
        section.put(&0x1A2B_3C4D_u32.to_le_bytes());
        section.put(&1_u16.to_le_bytes());
        section.put(&0_u16.to_le_bytes());
        section.put(&u64::MAX.to_le_bytes());
        section.option(SECTION_APPLICATION, b"recipe gateway");
        section.end(&mut new.bytes);
        new
    }

    /// The blocks of a record, including the blocks that it requires before it; often empty.
    pub fn blocks(&mut self, arrived: &Arrived) -> Vec<u8> {
        let Record { at, lost, what } = &*arrived.record;
        match what {
            What::Began(cell) => {
                self.cell = Some(Arc::clone(cell));
                self.describe_all(cell);
            }
            What::Frame(frame) => {
                if let Some(cell) = self.cell.clone() {
                    let lost = u64::from(*lost).saturating_add(arrived.missed);
                    self.packet(&cell, cell.epoch.unix_nanos(*at), frame, lost);
                }
            }
            What::Pass(_) => {}
        }
        std::mem::take(&mut self.bytes)
    }

    /// Describes the interfaces before any packet, so a reader sees all of them at once.
    fn describe_all(&mut self, cell: &Cell) {
        for port in &cell.ports {
            self.interface(cell, TapPlace::Port(port.id));
        }
        for (link, _) in &cell.links {
            self.interface(cell, TapPlace::Link(*link));
        }
    }

    /// The number of the interface of a port or link, if it is captured.
    fn interface(&mut self, cell: &Cell, place: TapPlace) -> Option<u32> {
        let (name, link_type, bit_rate) = match place {
            TapPlace::Port(id) => {
                let port = cell.port(id)?;
                if self.scope.port.as_ref().is_some_and(|only| *only != port.name) {
                    return None;
                }
                let link_type = if port.is_can { LINKTYPE_CAN_SOCKETCAN } else { LINKTYPE_USER0 };
                (port.name.clone(), link_type, port.bit_rate)
            }
            TapPlace::Link(id) if self.scope.links => (format!("link {}", cell.link(id)?), LINKTYPE_USER0, 0),
            TapPlace::Link(_) => return None,
        };
        let known = self.interfaces.iter().position(|known| *known == (name.clone(), link_type));
        let index = known.unwrap_or_else(|| {
            let mut block = Block::new(INTERFACE);
            block.put(&link_type.to_le_bytes());
            block.put(&[0; 2]);
            // No limit on packet length.
            block.put(&0_u32.to_le_bytes());
            block.option(INTERFACE_NAME, name.as_bytes());
            // Times are in nanoseconds.
            block.option(INTERFACE_RESOLUTION, &[9]);
            if bit_rate > 0 {
                block.option(INTERFACE_SPEED, &u64::from(bit_rate).to_le_bytes());
            }
            block.end(&mut self.bytes);
            self.interfaces.push((name, link_type));
            self.interfaces.len() - 1
        });
        u32::try_from(index).ok()
    }

    fn packet(&mut self, cell: &Cell, unix_nanos: u64, frame: &Frame, lost: u64) {
        let Some(interface) = self.interface(cell, frame.place) else { return };
        let (data, header) = match frame.can_id {
            Some(id) => (socketcan(id, frame), SOCKETCAN_HEADER),
            None => (frame.bytes.to_vec(), 0),
        };
        let original_len = u32::try_from(frame.len + header).unwrap_or(u32::MAX);
        let mut block = Block::new(PACKET);
        block.put(&interface.to_le_bytes());
        block.put(&((unix_nanos >> 32) as u32).to_le_bytes());
        block.put(&(unix_nanos as u32).to_le_bytes());
        block.put(&(data.len() as u32).to_le_bytes());
        block.put(&original_len.to_le_bytes());
        block.put(&data);
        block.pad();
        // 1: received, 2: sent.
        let direction: u32 = if frame.direction == TapDirection::In { 1 } else { 2 };
        block.option(PACKET_FLAGS, &direction.to_le_bytes());
        if lost > 0 {
            block.option(PACKET_DROP_COUNT, &lost.to_le_bytes());
        }
        if let Some(why) = rejection(frame) {
            block.option(COMMENT, format!("rejected: {why}").as_bytes());
        }
        block.end(&mut self.bytes);
    }
}

// Numbers of pcapng: blocks, options and link types.
const INTERFACE: u32 = 1;
const PACKET: u32 = 6;
const COMMENT: u16 = 1;
const SECTION_APPLICATION: u16 = 4;
const INTERFACE_NAME: u16 = 2;
const INTERFACE_SPEED: u16 = 8;
const INTERFACE_RESOLUTION: u16 = 9;
const PACKET_FLAGS: u16 = 2;
const PACKET_DROP_COUNT: u16 = 4;
const LINKTYPE_USER0: u16 = 147;
const LINKTYPE_CAN_SOCKETCAN: u16 = 227;

/// A block: its type, and its length before and after its content, little-endian, in units of four bytes.
struct Block {
    bytes: Vec<u8>,
    /// An option was written, so the end of options is needed.
    has_options: bool,
}

impl Block {
    fn new(kind: u32) -> Self {
        let mut bytes = kind.to_le_bytes().to_vec();
        bytes.extend([0; 4]);
        Self { bytes, has_options: false }
    }

    fn put(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    fn pad(&mut self) {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
    }

    /// Adds an option of at most 65535 bytes; a longer option is omitted.
    fn option(&mut self, code: u16, value: &[u8]) {
        let Ok(len) = u16::try_from(value.len()) else { return };
        self.put(&code.to_le_bytes());
        self.put(&len.to_le_bytes());
        self.put(value);
        self.pad();
        self.has_options = true;
    }

    fn end(mut self, out: &mut Vec<u8>) {
        if self.has_options {
            self.put(&[0; 4]);
        }
        let len = (self.bytes.len() + 4) as u32;
        self.put(&len.to_le_bytes());
        self.bytes[4..8].copy_from_slice(&len.to_le_bytes());
        out.extend(self.bytes);
    }
}

/// Id, length and three zeros before the data.
const SOCKETCAN_HEADER: usize = 8;

/// A CAN frame in the format of SocketCAN; id and flags are in network byte order.
fn socketcan(id: CanId, frame: &Frame) -> Vec<u8> {
    let mut word = match id {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id | 1 << 31,
    };
    if frame.verdict == TapVerdict::Rejected(Rejection::Remote) {
        word |= 1 << 30;
    }
    let mut data = word.to_be_bytes().to_vec();
    data.extend([u8::try_from(frame.bytes.len()).unwrap_or(u8::MAX), 0, 0, 0]);
    data.extend_from_slice(&frame.bytes);
    data
}

#[cfg(test)]
mod tests;
