//! What captures hold, by a reader of its own, and their bytes, which were once those of the crate pcap-file. Wireshark
//! reads them in `.ci/run foreign`.

use std::time::{Duration, SystemTime};

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
    nanos: u64,
    data: Vec<u8>,
    comment: Option<String>,
    flags: u32,
    drops: u64,
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// Type and body of every block.
fn blocks(mut bytes: &[u8]) -> Vec<(u32, &[u8])> {
    let mut blocks = Vec::new();
    while !bytes.is_empty() {
        let len = word(bytes, 4) as usize;
        assert_eq!((len % 4, word(bytes, len - 4) as usize), (0, len));
        blocks.push((word(bytes, 0), &bytes[8..len - 4]));
        bytes = &bytes[len..];
    }
    blocks
}

/// Number and value of every option, up to their end.
fn options(mut bytes: &[u8]) -> Vec<(u16, &[u8])> {
    let mut options = Vec::new();
    loop {
        let (code, len) = (word(bytes, 0) as u16, (word(bytes, 0) >> 16) as usize);
        if code == 0 {
            assert_eq!(bytes, [0; 4], "nothing behind the end");
            return options;
        }
        options.push((code, &bytes[4..4 + len]));
        bytes = &bytes[4 + len.next_multiple_of(4)..];
    }
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    let mut names = Vec::new();
    let mut packets = Vec::new();
    for (kind, body) in blocks(bytes) {
        if kind == INTERFACE {
            let options = options(&body[8..]);
            names.extend(
                options.iter().filter(|(code, _)| *code == INTERFACE_NAME).map(|(_, name)| text(name)),
            );
        }
        if kind == PACKET {
            let len = word(body, 12) as usize;
            let (mut comment, mut flags, mut drops) = (None, 0, 0);
            for (code, value) in options(&body[20 + len.next_multiple_of(4)..]) {
                match code {
                    COMMENT => comment = Some(text(value)),
                    PACKET_FLAGS => flags = word(value, 0),
                    PACKET_DROP_COUNT => drops = u64::from_le_bytes(value.try_into().unwrap()),
                    _ => {}
                }
            }
            packets.push(Packet {
                interface: names[word(body, 0) as usize].clone(),
                nanos: u64::from(word(body, 4)) << 32 | u64::from(word(body, 8)),
                data: body[20..20 + len].to_vec(),
                comment,
                flags,
                drops,
            });
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
    assert_eq!(bytes.escape_ascii().to_string(), WRITTEN.escape_ascii().to_string());
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

const WRITTEN: &[u8] = b"\
    \x0A\x0D\x0D\x0A4\0\0\0M<+\x1A\x01\0\0\0\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\x04\0\x0E\0\
    recipe gateway\0\0\0\0\0\x004\0\0\0\
    \x01\0\0\x008\0\0\0\x93\0\0\0\0\0\0\0\x02\0\x07\0rs485-1\0\x09\0\x01\0\x09\0\0\0\x08\0\
    \x08\0\0\xC2\x01\0\0\0\0\0\0\0\0\x008\0\0\0\
    \x01\0\0\x004\0\0\0\xE3\0\0\0\0\0\0\0\x02\0\x04\0hand\x09\0\x01\0\x09\0\0\0\x08\0\x08\
    \0\0\xC2\x01\0\0\0\0\0\0\0\0\x004\0\0\0\
    \x01\0\0\x000\0\0\0\x93\0\0\0\0\0\0\0\x02\0\x0B\0link modbus\0\x09\0\x01\0\x09\0\0\0\0\
    \0\0\x000\0\0\0\
    \x06\0\0\0\\\0\0\0\0\0\0\0\x01\0\0\0X\x0D\x06*\x03\0\0\0\x03\0\0\0\x01\x02\x03\0\x02\
    \0\x04\0\x01\0\0\0\x04\0\x08\0\x05\0\0\0\0\0\0\0\x01\0\x1A\0rejected: a wrong checks\
    um\0\0\0\0\0\0\\\0\0\0\
    \x06\0\0\0D\0\0\0\x01\0\0\0\x01\0\0\0@\x11\x06*\x0B\0\0\0\x0B\0\0\0\x80\x01\0\0\x03\
    \0\0\0\x01\x02\x03\0\x02\0\x04\0\x01\0\0\0\x04\0\x08\0\x05\0\0\0\0\0\0\0\0\0\0\0D\0\
    \0\0\
    \x06\0\0\0<\0\0\0\x02\0\0\0\x01\0\0\0(\x15\x06*\x03\0\0\0\x03\0\0\0\x01\x02\x03\0\
    \x02\0\x04\0\x01\0\0\0\x04\0\x08\0\x05\0\0\0\0\0\0\0\0\0\0\0<\0\0\0\
    \x06\0\0\0`\0\0\0\x01\0\0\0\x01\0\0\0\x10\x19\x06*\x0B\0\0\0\x0B\0\0\0@\0\x01#\x03\0\
    \0\0\x01\x02\x03\0\x02\0\x04\0\x01\0\0\0\x04\0\x08\0\x05\0\0\0\0\0\0\0\x01\0\x18\0re\
    jected: a remote frame\0\0\0\0`\0\0\0\
";
