//! Captures for Wireshark: pcapng, one interface for each port.
//!
//! In: records. Out: the blocks of a file, or of a stream. CAN frames are those of SocketCAN
//! (`LINKTYPE_CAN_SOCKETCAN`); what goes over a serial line or a link to the controller is `LINKTYPE_USER0`, which
//! the plugin of `host-sim export lua` shows. The comment of a packet says why it was rejected.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Duration;

use pcap_file::pcapng::blocks::enhanced_packet::{EnhancedPacketBlock, EnhancedPacketOption};
use pcap_file::pcapng::blocks::interface_description::{
    InterfaceDescriptionBlock, InterfaceDescriptionOption,
};
use pcap_file::pcapng::blocks::section_header::{SectionHeaderBlock, SectionHeaderOption};
use pcap_file::pcapng::{PcapNgBlock, PcapNgWriter};
use pcap_file::{DataLink, Endianness};
use proto_core::engine::{Rejection, TapDirection, TapPlace, TapVerdict};
use proto_core::wire::can::CanId;

use crate::record::{Cell, Frame, Record, What, rejection};
use crate::watch::Arrived;

/// The first bytes of every pcapng file.
pub const MAGIC: [u8; 4] = [0x0A, 0x0D, 0x0D, 0x0A];

/// What is captured.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Scope {
    /// Only this port; all if `None`.
    pub port: Option<String>,
    /// The links to the controller too.
    pub links: bool,
}

/// Writes the blocks of one capture.
pub struct Pcapng {
    scope: Scope,
    writer: PcapNgWriter<Vec<u8>>,
    /// Name and link type of each interface so far.
    interfaces: Vec<(String, DataLink)>,
    cell: Option<Arc<Cell>>,
}

impl std::fmt::Debug for Pcapng {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { scope, interfaces, .. } = self;
        f.debug_struct("Pcapng").field("scope", scope).field("interfaces", interfaces).finish_non_exhaustive()
    }
}

impl Pcapng {
    /// An empty capture.
    pub fn new(scope: Scope) -> Self {
        let section = SectionHeaderBlock {
            endianness: Endianness::Little,
            options: vec![SectionHeaderOption::UserApplication(Cow::Borrowed("recipe gateway"))],
            ..SectionHeaderBlock::default()
        };
        let writer = PcapNgWriter::with_section_header(Vec::new(), section);
        let writer = writer.unwrap_or_else(|error| unreachable!("written to memory: {error}"));
        Self { scope, writer, interfaces: Vec::new(), cell: None }
    }

    /// The blocks for a record, with those before it that are needed; often empty.
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
        std::mem::take(self.writer.get_mut())
    }

    /// Describes the interfaces before any packet, so that all of them are seen at once.
    fn describe_all(&mut self, cell: &Cell) {
        for port in &cell.ports {
            self.interface(cell, TapPlace::Port(port.id));
        }
        for (link, _) in &cell.links {
            self.interface(cell, TapPlace::Link(*link));
        }
    }

    /// The number of the interface of a port or link, if it is to be captured.
    fn interface(&mut self, cell: &Cell, place: TapPlace) -> Option<u32> {
        let (name, link_type, bit_rate) = match place {
            TapPlace::Port(id) => {
                let port = cell.port(id)?;
                if self.scope.port.as_ref().is_some_and(|only| *only != port.name) {
                    return None;
                }
                let link_type = if port.is_can { DataLink::CAN_SOCKETCAN } else { DataLink::USER0 };
                (port.name.clone(), link_type, port.bit_rate)
            }
            TapPlace::Link(id) if self.scope.links => {
                (format!("link {}", cell.link(id)?), DataLink::USER0, 0)
            }
            TapPlace::Link(_) => return None,
        };
        let known = self.interfaces.iter().position(|known| *known == (name.clone(), link_type));
        let index = known.unwrap_or_else(|| {
            let mut options = vec![InterfaceDescriptionOption::IfName(Cow::Owned(name.clone()))];
            options.push(InterfaceDescriptionOption::IfTsResol(9));
            if bit_rate > 0 {
                options.push(InterfaceDescriptionOption::IfSpeed(bit_rate.into()));
            }
            self.add(InterfaceDescriptionBlock { linktype: link_type, snaplen: 0, options });
            self.interfaces.push((name, link_type));
            self.interfaces.len() - 1
        });
        u32::try_from(index).ok()
    }

    fn packet(&mut self, cell: &Cell, unix_nanos: u64, frame: &Frame, lost: u64) {
        let Some(interface_id) = self.interface(cell, frame.place) else { return };
        let (data, header) = match frame.can_id {
            Some(id) => (socketcan(id, frame), SOCKETCAN_HEADER),
            None => (frame.bytes.to_vec(), 0),
        };
        // 1: received, 2: sent.
        let direction = if frame.direction == TapDirection::In { 1 } else { 2 };
        let mut options = vec![EnhancedPacketOption::Flags(direction)];
        if lost > 0 {
            options.push(EnhancedPacketOption::DropCount(lost));
        }
        if let Some(why) = rejection(frame) {
            options.push(EnhancedPacketOption::Comment(Cow::Owned(format!("rejected: {why}"))));
        }
        self.add(EnhancedPacketBlock {
            interface_id,
            timestamp: Duration::from_nanos(unix_nanos),
            original_len: u32::try_from(frame.len + header).unwrap_or(u32::MAX),
            data: Cow::Owned(data),
            options,
        });
    }

    fn add<'a>(&mut self, block: impl PcapNgBlock<'a>) {
        // Fails only for a packet of an interface that was not described, which cannot be.
        let _ = self.writer.write_pcapng_block(block);
    }
}

/// Id, length and three zeros before the data.
const SOCKETCAN_HEADER: usize = 8;

/// A CAN frame as SocketCAN has it, the id with its flags in network order.
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
