use std::vec::Vec;

use super::*;

fn inbox(bytes: &[u8]) -> Inbox<64> {
    let mut inbox = Inbox::new();
    assert_eq!(inbox.push(bytes), bytes.len());
    inbox
}

#[test]
fn packets_come_whole_from_any_pieces() {
    let stream =
        b"\x20\x02\x00\x00\x90\x04\x00\x01\x01\x01\x30\x05\x00\x01a!?\x32\x05\x00\x01a\x00\x07\xD0\x00";
    for cut in 0..stream.len() {
        let mut inbox = Inbox::<32>::new();
        let mut seen = Vec::new();
        for piece in [&stream[..cut], &stream[cut..]] {
            let mut rest = piece;
            while !rest.is_empty() {
                let taken = inbox.push(rest);
                assert!(taken > 0);
                rest = &rest[taken..];
                while let Some(packet) = inbox.next_packet().unwrap() {
                    seen.push(match packet {
                        Packet::ConnAck { code } => (0, code.into(), 0),
                        Packet::SubAck { is_accepted } => (1, is_accepted.into(), 0),
                        Packet::Publish { topic: "a", payload, id } => (2, payload.len(), id.unwrap_or(0)),
                        Packet::Publish { topic, .. } => panic!("{topic}"),
                        Packet::PingResp => (3, 0, 0),
                    });
                }
            }
        }
        assert_eq!(seen, [(0, 0, 0), (1, 1, 0), (2, 2, 0), (2, 0, 7), (3, 0, 0)], "cut at {cut}");
    }
}

#[test]
fn what_no_server_sends_is_refused() {
    for wrong in [
        // Packets that only a client sends.
        &[0x10, 0][..],
        &[0x82, 0],
        &[0xC0, 0],
        // Acknowledgements, though nothing was published at QoS 1 or 2.
        &[0x40, 2, 0, 1],
        &[0x00, 0],
        &[0xF0, 0],
        // Wrong flags.
        &[0x21, 2, 0, 0],
        &[0xD1, 0],
        // QoS 2 and 3, and DUP at QoS 0.
        &[0x34, 5, 0, 1, b'a', 0, 1],
        &[0x36, 5, 0, 1, b'a', 0, 1],
        &[0x38, 3, 0, 1, b'a'],
        // Wrong lengths.
        &[0x30, 0x80, 0x80, 0x80, 0x80],
        &[0x20, 1, 0],
        &[0x20, 3, 0, 0, 0],
        &[0x20, 2, 2, 0],
        &[0x90, 2, 0, 1],
        &[0x90, 3, 0, 1, 3],
        &[0xD0, 1, 0],
        &[0x20, 0x80, 1],
        // Wrong topics.
        &[0x30, 2, 0, 0],
        &[0x30, 3, 0, 2, b'a'],
        &[0x30, 3, 0, 1, b'+'],
        &[0x30, 3, 0, 1, 0xFF],
        // Wrong packet identifiers.
        &[0x32, 4, 0, 1, b'a', 0],
        &[0x32, 5, 0, 1, b'a', 0, 0],
    ] {
        assert!(inbox(wrong).next_packet().is_err(), "{wrong:02X?}");
    }
}

#[test]
fn a_long_publication_is_skipped_and_what_follows_is_read() {
    let mut stream = [&[0x30, 200, 1, 0, 1, b'a'][..], &[7; 197]].concat();
    stream.extend_from_slice(&[0xD0, 0]);
    for piece in 1..80 {
        let mut inbox = Inbox::<64>::new();
        let mut packets = 0;
        for chunk in stream.chunks(piece) {
            let mut rest = chunk;
            while !rest.is_empty() {
                let taken = inbox.push(rest);
                rest = &rest[taken..];
                while let Some(packet) = inbox.next_packet().unwrap() {
                    assert_eq!(packet, Packet::PingResp);
                    packets += 1;
                }
            }
        }
        assert_eq!((packets, inbox.skipped()), (1, 1), "in pieces of {piece}");
    }
}

#[test]
fn lengths_have_as_few_bytes_as_they_need() {
    for (len, bytes) in [
        (0, &[0x30, 0][..]),
        (127, &[0x30, 127]),
        (128, &[0x30, 0x80, 1]),
        (16_384, &[0x30, 0x80, 0x80, 1]),
        (MAX_BODY, &[0x30, 0xFF, 0xFF, 0xFF, 0x7F]),
    ] {
        let mut buf = [0xA5; 8];
        let mut out = ByteWriter::new(&mut buf);
        header(&mut out, PUBLISH, len);
        assert_eq!(out.finish(), Some(bytes));
    }
}
