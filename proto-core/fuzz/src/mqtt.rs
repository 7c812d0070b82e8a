//! What an MQTT server sends, right, changed and cut, in pieces, against a reader of all bytes at once.

use recipe_sparkplug::mqtt::{Inbox, Packet};

use crate::source::Source;

const ROOM: usize = 64;

/// A packet, with bytes of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Seen {
    Accepted(u8),
    Message {
        topic: String,
        payload: Vec<u8>,
        id: Option<u16>,
    },
    Subscribed(bool),
    Pong,
    /// Nothing is read behind it.
    Wrong,
}

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let (mut bytes, mut cuts) = (Vec::new(), Vec::new());
    while !input.is_empty() && bytes.len() < 1_000 {
        match input.u8() {
            0..20 => bytes.extend_from_slice(&[0x20, 2, 0, input.u8() % 6]),
            20..40 => bytes.extend_from_slice(&[0x90, 4, 0, 1, 1, input.one_of(&[0, 1, 0x80])]),
            40..55 => bytes.extend_from_slice(&[0xD0, 0]),
            55..120 => {
                let (qos, topic) = (input.below(2), input.one_of(&["a", "spBv1.0/hall/NCMD/press", "ä", ""]));
                let mut body = (topic.len() as u16).to_be_bytes().to_vec();
                body.extend_from_slice(topic.as_bytes());
                if qos == 1 {
                    body.extend_from_slice(&input.u16().to_be_bytes());
                }
                body.resize(body.len() + usize::from(input.u8()) % 90, b'x');
                bytes.push(0x30 | (qos as u8) << 1 | u8::from(input.flag()));
                if body.len() > 127 {
                    bytes.push((body.len() & 127) as u8 | 128);
                    bytes.push((body.len() >> 7) as u8);
                } else {
                    bytes.push(body.len() as u8);
                }
                bytes.extend_from_slice(&body);
            }
            120..190 => cuts.push(bytes.len()),
            190..230 => {
                let at = input.below(bytes.len().max(1));
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = input.u8();
                }
            }
            230..240 => {
                bytes.pop();
            }
            _ => bytes.push(input.u8()),
        }
    }
    let expected = reference(&bytes);
    cuts.retain(|cut| *cut <= bytes.len());
    cuts.sort_unstable();
    let mut inbox = Inbox::<ROOM>::new();
    let (mut seen, mut start) = (Vec::new(), 0);
    'all: for end in cuts.into_iter().chain([bytes.len()]) {
        let mut rest = &bytes[start..end];
        start = end;
        while !rest.is_empty() {
            let taken = inbox.push(rest);
            assert!((1..=rest.len()).contains(&taken), "{taken} of {}", rest.len());
            rest = &rest[taken..];
            let mut packets = 0;
            loop {
                match inbox.next_packet() {
                    Ok(Some(packet)) => seen.push(owned(packet)),
                    Ok(None) => break,
                    Err(_) => {
                        seen.push(Seen::Wrong);
                        break 'all;
                    }
                }
                packets += 1;
                assert!(packets <= ROOM, "it does not come to rest");
            }
        }
    }
    assert_eq!(seen, expected, "{bytes:02X?}");
}

fn owned(packet: Packet<'_>) -> Seen {
    match packet {
        Packet::ConnAck { code } => Seen::Accepted(code),
        Packet::Publish { topic, payload, id } => {
            Seen::Message { topic: topic.to_owned(), payload: payload.to_vec(), id }
        }
        Packet::SubAck { is_accepted } => Seen::Subscribed(is_accepted),
        Packet::PingResp => Seen::Pong,
    }
}

/// MQTT 3.1.1, sections 2.2 and 3, for what a server sends to a client that subscribes at QoS 1.
fn reference(mut bytes: &[u8]) -> Vec<Seen> {
    let mut seen = Vec::new();
    while let Some((&first, behind)) = bytes.split_first() {
        let (kind, flags) = (first >> 4, first & 15);
        let is_known = match kind {
            2 | 9 | 13 => flags == 0,
            // QoS 0 or 1; a repetition only at QoS 1.
            3 => matches!(flags >> 1, 0b000 | 0b001 | 0b101),
            _ => false,
        };
        if !is_known {
            seen.push(Seen::Wrong);
            break;
        }
        let digits = behind.iter().take(4).take_while(|byte| **byte >= 128).count();
        if digits == 4 {
            seen.push(Seen::Wrong);
            break;
        }
        if behind.len() <= digits {
            break;
        }
        let len = behind[..=digits].iter().rev().fold(0, |len, byte| len * 128 + usize::from(byte & 127));
        let behind = &behind[digits + 1..];
        if len + digits + 2 > ROOM {
            if kind != 3 {
                seen.push(Seen::Wrong);
                break;
            }
            bytes = behind.get(len..).unwrap_or_default();
            continue;
        }
        let Some(body) = behind.get(..len) else { break };
        bytes = &behind[len..];
        let packet = match kind {
            2 => (len == 2 && body[0] < 2).then(|| Seen::Accepted(body[1])),
            9 => {
                let codes = body.get(2..).unwrap_or_default();
                let is_right = !codes.is_empty() && codes.iter().all(|code| *code <= 2 || *code == 128);
                is_right.then(|| Seen::Subscribed(codes.iter().all(|code| *code != 128)))
            }
            13 => (len == 0).then_some(Seen::Pong),
            _ => message(body, flags & 2 != 0),
        };
        let is_right = packet.is_some();
        seen.push(packet.unwrap_or(Seen::Wrong));
        if !is_right {
            break;
        }
    }
    seen
}

fn message(body: &[u8], has_id: bool) -> Option<Seen> {
    let len = usize::from(*body.first()?) * 256 + usize::from(*body.get(1)?);
    let topic = String::from_utf8(body.get(2..2 + len)?.to_vec()).ok()?;
    if topic.is_empty() || topic.chars().any(|c| "+#\0".contains(c)) {
        return None;
    }
    let rest = &body[2 + len..];
    let (id, payload) = match has_id {
        false => (None, rest),
        true => {
            let id = u16::from(*rest.first()?) * 256 + u16::from(*rest.get(1)?);
            (Some(id).filter(|id| *id > 0).map(Some)?, &rest[2..])
        }
    };
    Some(Seen::Message { topic, payload: payload.to_vec(), id })
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    vec![
        vec![0, 0, 20, 1, 40, 55, 0, 0, 5, 0],
        vec![0, 5, 120, 55, 1, 1, 0, 7, 30, 1, 120, 40],
        vec![55, 0, 1, 89, 0, 120, 55, 1, 1, 0, 9, 89, 0, 120, 40],
        vec![255, 0x30, 255, 0x80, 255, 0x80, 255, 0x80, 255, 0x80],
        vec![20, 2, 190, 1, 3, 40, 40],
        vec![55, 0, 2, 3, 0, 230, 120, 255, 0],
    ]
}
