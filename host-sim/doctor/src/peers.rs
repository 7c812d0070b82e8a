//! Findings about slaves and other peers that a port polls.

use proto_core::config::{Exchange, Transaction};
use proto_core::device::{Algorithm, ByteOrder};
use proto_core::modbus::Exception;
use proto_core::schedule::Presence;

use crate::bytes::{HexBytes, count};
use crate::finding::{Cause, Finding};
use crate::port_case::PortCase;
use crate::state::Peer;

pub(crate) fn examine(seen: &PortCase<'_>, findings: &mut Vec<Finding>) {
    let exchanges = seen.case.config.exchanges_of(seen.recipe);
    let is_served =
        exchanges.iter().any(|exchange| matches!(exchange.transaction, Transaction::Served { .. }));
    if is_served {
        served(seen, exchanges, findings);
        return;
    }
    let is_modbus = exchanges.iter().any(|exchange| matches!(exchange.transaction, Transaction::Rtu { .. }));
    for &peer in &seen.status.peers {
        let counters = peer.counters;
        if peer.presence == Presence::Down && counters.requests >= 2 {
            findings.push(silent(seen, peer, is_modbus));
        } else if counters.refused > 0 && counters.refused.saturating_mul(10) > counters.replies {
            findings.push(refuses(seen, peer, is_modbus));
        } else if counters.checksums >= 3 && counters.checksums.saturating_mul(10) > counters.replies {
            findings.push(noise(seen, peer));
        }
    }
}

fn name(peer: Peer, is_modbus: bool) -> String {
    let word = if is_modbus { "slave" } else { "device" };
    format!("{word} {}", peer.number)
}

fn silent(seen: &PortCase<'_>, peer: Peer, is_modbus: bool) -> Finding {
    let who = name(peer, is_modbus);
    let asked =
        format!("{who} asked {} times, {} good replies", peer.counters.requests, peer.counters.replies);
    let bytes = seen.record.bytes();
    let expected = format!("replies of {who}");
    if is_modbus {
        let frames = rtu_frames(&bytes);
        // A received request is no reply: eight bytes of a function that only reads.
        let is_request = |frame: &&[u8]| frame.len() == 8 && (1..=4).contains(&frame[1]) && frame[2] != 3;
        if frames.iter().any(|frame| frame[0] == peer.number && is_request(frame)) {
            return seen.place.fault(
                Cause::Echo,
                format!("{asked}; the request itself is heard"),
                expected,
                "The adapter hears what it sends",
                "Write echo = true for the port, or switch the adapter's echo off",
            );
        }
        let known = |number: u8| seen.status.peers.iter().any(|peer| peer.number == number);
        if let Some(frame) = frames.iter().find(|frame| !known(frame[0])) {
            return seen.place.fault(
                Cause::PeerOther,
                format!("{asked}; a right frame of slave {} is heard: {}", frame[0], HexBytes(shown(frame))),
                expected,
                "The slave has another address",
                format!(
                    "Set the slave's address to {}, or write slave = {} in the recipe",
                    peer.number, frame[0]
                ),
            );
        }
    }
    // The settings were right once, so only power and wires are left.
    if peer.counters.replies > peer.counters.checksums.saturating_mul(10) {
        return seen.place.fault(
            Cause::PeerSilent,
            format!("{asked}; it has answered before, and does not any more"),
            expected,
            "It was switched off or unplugged, or a wire is open",
            "Check its power and its wires; it is asked again now and then",
        );
    }
    if peer.counters.checksums > 0 {
        return noise(seen, peer);
    }
    if !bytes.is_empty() && seen.counters.bytes_in > 0 && seen.status.peers.len() == 1 {
        return seen.place.fault(
            Cause::PeerSilent,
            format!(
                "{asked}; {} heard: {}",
                count(seen.counters.bytes_in as usize, "byte"),
                HexBytes(shown(&bytes))
            ),
            expected,
            "Something answers, and no reply is right: baud rate, parity, address or protocol",
            "Compare the settings of the port with the device's",
        );
    }
    seen.place.fault(
        Cause::PeerSilent,
        format!("{asked}; no byte of it"),
        expected,
        "It is off or has another address, baud rate or parity, or the wires A and B are open or swapped",
        "Check power, address and line settings of the device",
    )
}

fn noise(seen: &PortCase<'_>, peer: Peer) -> Finding {
    seen.place.fault(
        Cause::ChecksumWrong,
        format!(
            "{} replies of {} with a wrong checksum, {} good ones",
            peer.counters.checksums, peer.number, peer.counters.replies
        ),
        "replies with a right one",
        "Bytes are damaged: two slaves with one address, parity, or a bad line",
        "Check addresses, parity, ground and termination",
    )
}

fn refuses(seen: &PortCase<'_>, peer: Peer, is_modbus: bool) -> Finding {
    let why = match (is_modbus, peer.counters.refusal) {
        (true, code) if code > 0 => format!(": {} (code {code})", Exception::from_code(code)),
        _ => String::new(),
    };
    seen.place.fault(
        Cause::PeerRefuses,
        format!(
            "{} refuses {} of {} requests{why}",
            name(peer, is_modbus),
            peer.counters.refused,
            peer.counters.requests
        ),
        "answers",
        "A register address, a count or a function is not the device's",
        "Compare the exchanges of the recipe with the device's manual; many count registers from 1",
    )
}

/// Findings for a port where the gateway is the slave.
fn served(seen: &PortCase<'_>, exchanges: &[Exchange], findings: &mut Vec<Finding>) {
    let Some(own) = exchanges.first().map(|exchange| exchange.peer) else { return };
    if seen.counters.frames_in > 0 || !seen.is_silent() {
        return;
    }
    let frames_of = seen.record.bytes();
    let frames = rtu_frames(&frames_of);
    if let Some(frame) = frames.iter().find(|frame| frame[0] != own && frame[0] != 0) {
        findings.push(seen.place.fault(
            Cause::PeerOther,
            format!("requests to slave {}: {}", frame[0], HexBytes(shown(frame))),
            format!("requests to slave {own}"),
            "The master asks another address",
            format!("Let the master ask slave {own}, or write slave = {} in the recipe", frame[0]),
        ));
    }
}

fn shown(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len().min(12)]
}

/// Frames of Modbus RTU in a byte stream: an address, a function and a matching checksum.
fn rtu_frames(bytes: &[u8]) -> Vec<&[u8]> {
    let (mut at, mut frames) = (0, Vec::new());
    while at + 4 <= bytes.len() {
        match rtu_len(&bytes[at..]) {
            Some(len) => {
                frames.push(&bytes[at..at + len]);
                at += len;
            }
            None => at += 1,
        }
    }
    frames
}

/// The length of the Modbus RTU frame at the front.
fn rtu_len(bytes: &[u8]) -> Option<usize> {
    let function = *bytes.get(1)?;
    let is_known = matches!(function & 0x7F, 1..=6 | 15 | 16 | 22 | 23);
    if !is_known || bytes[0] > 247 {
        return None;
    }
    // A reply with a byte count, a request or a short reply, both of function 22, a refusal.
    let counted = bytes.get(2).map(|count| usize::from(*count) + 5);
    let lens = [counted, Some(8), Some(10), Some(5)];
    lens.into_iter().flatten().find(|&len| {
        bytes.get(..len).is_some_and(|frame| {
            let (front, sum) = frame.split_at(len - 2);
            let right = Algorithm::CRC16_MODBUS.of([front]);
            let order = Algorithm::CRC16_MODBUS.order();
            let found = match order {
                ByteOrder::Little => u16::from_le_bytes([sum[0], sum[1]]),
                _ => u16::from_be_bytes([sum[0], sum[1]]),
            };
            u32::from(found) == right
        })
    })
}
