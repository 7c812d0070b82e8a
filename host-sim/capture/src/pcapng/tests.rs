//! Captures as another reader sees them: the one of the crate pcap-file.

use std::time::SystemTime;

use pcap_file::pcapng::{Block, PcapNgReader};
use proto_core::engine::{LinkId, PortId};
use proto_core::time::Instant;

use super::*;
use crate::record::{CellPort, Epoch};

fn cell(ports: &[(&str, bool)]) -> Arc<Cell> {
    let port = |(nth, (name, is_can)): (usize, &(&str, bool))| CellPort {
        id: PortId(nth as u8),
        name: (*name).to_owned(),
        is_can: *is_can,
        bit_rate: 115_200,
    };
    Arc::new(Cell {
        ports: ports.iter().enumerate().map(port).collect(),
        links: vec![(LinkId::MODBUS, "modbus".into())],
        decoder: Arc::default(),
        epoch: Epoch { at: Instant::from_micros(0), wall: SystemTime::UNIX_EPOCH + Duration::from_secs(5) },
    })
}

fn arrived(at: u64, what: What) -> Arrived {
    Arrived { record: Arc::new(Record { at: Instant::from_micros(at), lost: 2, what }), missed: 3 }
}

fn frame(place: TapPlace, verdict: TapVerdict, can_id: Option<CanId>) -> What {
    let bytes = Box::from([1, 2, 3]);
    What::Frame(Frame { place, direction: TapDirection::In, verdict, can_id, len: 3, bytes })
}

#[derive(Debug, PartialEq)]
struct Packet {
    interface: String,
    nanos: u128,
    data: Vec<u8>,
    comment: Option<String>,
    flags: u32,
    drops: u64,
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let mut reader = PcapNgReader::new(bytes).unwrap();
    let mut names = Vec::new();
    let mut packets = Vec::new();
    while let Some(block) = reader.next_block() {
        match block.unwrap() {
            Block::InterfaceDescription(interface) => {
                for option in &interface.options {
                    if let InterfaceDescriptionOption::IfName(name) = option {
                        names.push(name.to_string());
                    }
                }
            }
            Block::EnhancedPacket(packet) => {
                let (mut comment, mut flags, mut drops) = (None, 0, 0);
                for option in &packet.options {
                    match option {
                        EnhancedPacketOption::Comment(text) => comment = Some(text.to_string()),
                        EnhancedPacketOption::Flags(value) => flags = *value,
                        EnhancedPacketOption::DropCount(count) => drops = *count,
                        _ => {}
                    }
                }
                packets.push(Packet {
                    interface: names[packet.interface_id as usize].clone(),
                    nanos: packet.timestamp.as_nanos(),
                    data: packet.data.to_vec(),
                    comment,
                    flags,
                    drops,
                });
            }
            _ => {}
        }
    }
    packets
}

#[test]
fn packets_have_their_port_time_direction_and_verdict() {
    let mut capture = Pcapng::new(Scope { port: None, links: true });
    let mut bytes = capture.blocks(&arrived(0, What::Began(cell(&[("rs485-1", false), ("hand", true)]))));
    let port = |nth| TapPlace::Port(PortId(nth));
    let rejected = TapVerdict::Rejected(Rejection::Checksum);
    bytes.extend(capture.blocks(&arrived(7, frame(port(0), rejected, None))));
    bytes.extend(
        capture.blocks(&arrived(8, frame(port(1), TapVerdict::Taken, Some(CanId::Extended(0x1_0000))))),
    );
    bytes.extend(capture.blocks(&arrived(9, frame(TapPlace::Link(LinkId::MODBUS), TapVerdict::Link, None))));
    let remote = TapVerdict::Rejected(Rejection::Remote);
    bytes.extend(capture.blocks(&arrived(10, frame(port(1), remote, Some(CanId::Standard(0x123))))));
    assert_eq!(bytes[..4], MAGIC);
    let packets = packets(&bytes);
    let first = Packet {
        interface: "rs485-1".into(),
        nanos: 5_000_007_000,
        data: vec![1, 2, 3],
        comment: Some("rejected: a wrong checksum".into()),
        flags: 1,
        drops: 5,
    };
    assert_eq!(packets[0], first);
    assert_eq!((packets[1].interface.as_str(), &packets[1].comment), ("hand", &None));
    assert_eq!(packets[1].data, [0x80, 1, 0, 0, 3, 0, 0, 0, 1, 2, 3]);
    assert_eq!(packets[2].interface, "link modbus");
    assert_eq!(packets[3].data[..5], [0x40, 0, 1, 0x23, 3], "a remote frame");
}

#[test]
fn only_what_was_asked_for_is_captured() {
    let mut capture = Pcapng::new(Scope { port: Some("hand".into()), links: false });
    let mut bytes = capture.blocks(&arrived(0, What::Began(cell(&[("rs485-1", false), ("hand", true)]))));
    for place in [TapPlace::Port(PortId(0)), TapPlace::Port(PortId(1)), TapPlace::Link(LinkId::MODBUS)] {
        bytes.extend(capture.blocks(&arrived(1, frame(place, TapVerdict::Taken, Some(CanId::Standard(1))))));
    }
    let packets = packets(&bytes);
    assert_eq!(packets.len(), 1);
    assert_eq!(packets[0].interface, "hand");
}

#[test]
fn the_capture_goes_on_when_the_gateway_is_started_anew() {
    let mut capture = Pcapng::new(Scope::default());
    let mut bytes = capture.blocks(&arrived(0, What::Began(cell(&[("a", false), ("b", false)]))));
    bytes.extend(capture.blocks(&arrived(1, What::Began(cell(&[("b", false), ("c", true)])))));
    bytes.extend(capture.blocks(&arrived(2, frame(TapPlace::Port(PortId(0)), TapVerdict::Taken, None))));
    assert_eq!(packets(&bytes)[0].interface, "b");
}
