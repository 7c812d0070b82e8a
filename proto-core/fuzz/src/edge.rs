//! Settings of a board's edge node, and datagrams of a time server, right, changed and cut.

use proto_core::time::Instant;
use recipe_sparkplug::document::{MAX_DOCUMENT, NodeDocument};
use recipe_sparkplug::sntp::{PACKET, Sntp};

use crate::source::Source;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    match input.flag() {
        true => document(input),
        false => time(input),
    }
}

/// What is read is written as the same bytes.
fn document(mut input: Source<'_>) {
    let mut bytes = b"RGWE\x01\x01".to_vec();
    while !input.is_empty() {
        match input.u8() {
            // A text.
            0..60 => {
                let len = input.below(20);
                bytes.push(len as u8);
                bytes.extend((0..len).map(|_| b'a' + input.u8() % 26));
            }
            // A time in milliseconds.
            60..90 => bytes.extend_from_slice(&(u32::from(input.u16()) * 60).to_le_bytes()),
            90..120 => bytes.extend_from_slice(&input.u16().to_le_bytes()),
            120..180 => bytes.push(input.u8() % 2),
            180..200 => {
                let at = input.below(bytes.len());
                bytes[at] = input.u8();
            }
            200..210 => {
                bytes.pop();
            }
            _ => bytes.push(input.u8()),
        }
        if bytes.is_empty() {
            bytes.push(b'R');
        }
    }
    let mut document = NodeDocument::empty();
    if document.decode(&bytes) == Ok(true) {
        let mut written = [0; MAX_DOCUMENT];
        assert_eq!(document.encode(&mut written), Ok(&bytes[..]));
    }
}

/// A time is only told by the answer to the newest request, once, and is of this century.
fn time(mut input: Source<'_>) {
    let mut sntp = Sntp::new(u64::from(input.u16()));
    let (mut now, mut asked) = (0_u64, None);
    while !input.is_empty() {
        now += u64::from(input.u16());
        let at = Instant::from_millis(now);
        if let Some(request) = sntp.poll(at) {
            asked = Some(request);
        }
        assert!(sntp.deadline() > at, "it is asked without end");
        let mut datagram = [0; PACKET + 20];
        datagram.iter_mut().for_each(|byte| *byte = input.u8());
        let is_answer = input.flag() && asked.is_some();
        if let Some(request) = asked.filter(|_| is_answer) {
            datagram[24..32].copy_from_slice(&request[40..48]);
            (datagram[0], datagram[1]) = (0x24, input.u8());
        }
        let len = input.below(datagram.len() + 1);
        if let Ok(utc_ms) = sntp.receive(at, &datagram[..len]) {
            assert!(is_answer && len >= PACKET, "{datagram:?}");
            assert!((1_704_067_200_000..4_102_444_803_000).contains(&utc_ms), "{utc_ms}");
            asked = None;
        }
    }
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    // A whole document, byte by byte, and two datagrams.
    let whole = b"\x01b\x5b\x07\x03g/n\x00\x1e\x00\x01g\x01n\x00\x64\x00\x00\x00\xf4\x01\x00\x00\x80\xee\x36\x00\x00\x00\x00";
    let mut document = vec![1];
    document.extend(whole.iter().flat_map(|byte| [0xFF, *byte]));
    vec![document, vec![0; 200]]
}
