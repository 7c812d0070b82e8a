//! MQTT 3.1.1, as far as an edge node needs it: the packets that it sends, and those that it may receive.
//!
//! In: the contents of packets, and bytes of the server in pieces of any size. Out: packets. Subscriptions use QoS 1
//! and publications QoS 0, so nothing waits for an acknowledgement, and QoS 2 is an error of the server.

use crate::bytes::ByteWriter;

/// Writes a packet. Calls `body` twice: to measure and to write.
pub(crate) fn packet(out: &mut ByteWriter<'_>, kind: u8, body: impl Fn(&mut ByteWriter<'_>)) {
    header(out, kind, ByteWriter::count(&body));
    body(out);
}

/// Writes the fixed header of a packet with `len` more bytes.
pub(crate) fn header(out: &mut ByteWriter<'_>, kind: u8, len: usize) {
    out.byte(kind);
    crate::protobuf::varint(out, len as u64);
}

/// Writes text or bytes after their length.
pub(crate) fn text(out: &mut ByteWriter<'_>, bytes: &[u8]) {
    // Longer texts are refused at their source; this only keeps the length in range.
    let len = u16::try_from(bytes.len()).unwrap_or(u16::MAX);
    out.put(&len.to_be_bytes());
    out.put(bytes.get(..usize::from(len)).unwrap_or_default());
}

/// As [`text`], for a text that `write` writes. Calls `write` twice.
pub(crate) fn text_of(out: &mut ByteWriter<'_>, write: impl Fn(&mut ByteWriter<'_>)) {
    let len = u16::try_from(ByteWriter::count(&write)).unwrap_or(u16::MAX);
    out.put(&len.to_be_bytes());
    write(out);
}

pub(crate) const MAX_BODY: usize = 268_435_455;

/// Types of packets, with their flags.
pub(crate) const CONNECT: u8 = 0x10;
pub(crate) const PUBLISH: u8 = 0x30;
pub(crate) const PUBACK: u8 = 0x40;
pub(crate) const SUBSCRIBE: u8 = 0x82;
pub(crate) const PINGREQ: u8 = 0xC0;
pub(crate) const DISCONNECT: u8 = 0xE0;

/// A packet from the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packet<'a> {
    /// The reply to CONNECT.
    ConnAck {
        /// The return code; 0: accepted.
        code: u8,
    },
    /// A message.
    Publish {
        /// Its topic.
        topic: &'a str,
        /// Its payload.
        payload: &'a [u8],
        /// The packet identifier to acknowledge; `None` at QoS 0.
        id: Option<u16>,
    },
    /// The reply to SUBSCRIBE.
    SubAck {
        /// Whether all subscriptions were accepted.
        is_accepted: bool,
    },
    /// The reply to PINGREQ.
    PingResp,
}

/// Bytes that an MQTT server may not send to this client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ProtocolError {
    /// A packet that a server does not send.
    Unexpected {
        /// The first byte of the packet.
        first: u8,
    },
    /// The length of a packet is malformed.
    Length,
    /// The content of a packet is too short, too long, or not text where text is required.
    Malformed {
        /// The first byte of the packet.
        first: u8,
    },
}

/// A buffer of received bytes. Publications longer than the buffer are skipped and counted.
#[derive(Debug, Clone)]
pub struct Inbox<const ROOM: usize> {
    buf: [u8; ROOM],
    len: usize,
    /// Length of the packet that was returned last, in bytes.
    used: usize,
    /// Number of bytes that are still to be skipped.
    skip: usize,
    skipped: u32,
}

impl<const ROOM: usize> Inbox<ROOM> {
    /// An empty buffer. `ROOM` must be at least 16.
    pub const fn new() -> Self {
        Self { buf: [0; ROOM], len: 0, used: 0, skip: 0, skipped: 0 }
    }

    /// Clears everything but the count of skipped publications.
    pub fn clear(&mut self) {
        (self.len, self.used, self.skip) = (0, 0, 0);
    }

    /// Number of publications that were skipped because they were too long.
    pub const fn skipped(&self) -> u32 {
        self.skipped
    }

    /// Takes as many bytes as fit, and returns how many. If [`Inbox::next_packet`] is called until it returns no
    /// packet, there is always room.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        self.drop_used();
        let skipped = self.skip.min(bytes.len());
        self.skip = self.skip.saturating_sub(skipped);
        let wanted = bytes.get(skipped..).unwrap_or_default();
        let room = self.buf.get_mut(self.len..).unwrap_or_default();
        let count = room.len().min(wanted.len());
        for (to, from) in room.iter_mut().zip(wanted) {
            *to = *from;
        }
        self.len = self.len.saturating_add(count);
        skipped.saturating_add(count)
    }

    /// The next complete packet.
    ///
    /// # Errors
    /// If the peer does not behave as an MQTT 3.1.1 server. The connection cannot be used after that.
    pub fn next_packet(&mut self) -> Result<Option<Packet<'_>>, ProtocolError> {
        self.drop_used();
        let bytes = self.buf.get(..self.len).unwrap_or_default();
        let Some((&first, rest)) = bytes.split_first() else { return Ok(None) };
        check_first(first)?;
        let Some((body_len, digits)) = remaining_length(rest)? else { return Ok(None) };
        let total = body_len.saturating_add(digits).saturating_add(1);
        if total > ROOM {
            if first >> 4 != 3 {
                return Err(ProtocolError::Malformed { first });
            }
            self.skipped = self.skipped.saturating_add(1);
            self.skip = total.saturating_sub(self.len);
            self.len = 0;
            return Ok(None);
        }
        let start = digits.saturating_add(1);
        if self.len < total {
            return Ok(None);
        }
        self.used = total;
        let body = self.buf.get(start..total).unwrap_or_default();
        parse(first, body).ok_or(ProtocolError::Malformed { first }).map(Some)
    }

    fn drop_used(&mut self) {
        let used = core::mem::take(&mut self.used).min(self.len);
        if used == 0 {
            return;
        }
        self.len = self.len.saturating_sub(used);
        for to in 0..self.len {
            let byte = self.buf.get(to.saturating_add(used)).copied().unwrap_or(0);
            if let Some(place) = self.buf.get_mut(to) {
                *place = byte;
            }
        }
    }
}

impl<const ROOM: usize> Default for Inbox<ROOM> {
    fn default() -> Self {
        Self::new()
    }
}

fn check_first(first: u8) -> Result<(), ProtocolError> {
    match first {
        0x20 | 0x90 | 0xD0 => Ok(()),
        // RETAIN and DUP in any combination, at QoS 0 or 1; no DUP at QoS 0.
        0x30..=0x3F if first & 0b100 == 0 && first & 0b1010 != 0b1000 => Ok(()),
        _ => Err(ProtocolError::Unexpected { first }),
    }
}

/// The remaining length, and the number of bytes of its encoding; `None` if these have not all arrived.
fn remaining_length(bytes: &[u8]) -> Result<Option<(usize, usize)>, ProtocolError> {
    let mut len = 0_usize;
    for (nth, shift) in [0_u32, 7, 14, 21].into_iter().enumerate() {
        let Some(&byte) = bytes.get(nth) else { return Ok(None) };
        len |= usize::from(byte & 0x7F).checked_shl(shift).unwrap_or(0);
        if byte & 0x80 == 0 {
            return Ok(Some((len, nth.saturating_add(1))));
        }
    }
    Err(ProtocolError::Length)
}

fn parse(first: u8, body: &[u8]) -> Option<Packet<'_>> {
    Some(match first {
        0x20 => match *body {
            [0 | 1, code] => Packet::ConnAck { code },
            _ => return None,
        },
        0x90 => {
            let (_, codes) = body.split_at_checked(2)?;
            if codes.is_empty() || codes.iter().any(|code| !matches!(code, 0..=2 | 0x80)) {
                return None;
            }
            Packet::SubAck { is_accepted: !codes.contains(&0x80) }
        }
        0xD0 if body.is_empty() => Packet::PingResp,
        0x30..=0x3F => {
            let (len, rest) = word(body)?;
            let (topic, rest) = rest.split_at_checked(len.into())?;
            let topic = core::str::from_utf8(topic).ok()?;
            if topic.is_empty() || topic.contains(['+', '#', '\0']) {
                return None;
            }
            let (id, payload) = match first & 0b10 {
                0 => (None, rest),
                _ => word(rest).filter(|(id, _)| *id != 0).map(|(id, rest)| (Some(id), rest))?,
            };
            Packet::Publish { topic, payload, id }
        }
        _ => return None,
    })
}

fn word(bytes: &[u8]) -> Option<(u16, &[u8])> {
    let (word, rest) = bytes.split_first_chunk()?;
    Some((u16::from_be_bytes(*word), rest))
}

#[cfg(test)]
#[path = "mqtt_tests.rs"]
mod tests;
