//! The body of a response without its framing.
//!
//! In: the bytes after the head, in pieces of any size. Out: the bytes of the body, and whether it has ended.

use super::head::Framing;

/// Extracts a body from the bytes of a connection.
#[derive(Debug)]
pub(crate) struct Unframer(BodyState);

#[derive(Debug, Clone, PartialEq, Eq)]
enum BodyState {
    Length(u64),
    Close,
    /// The received part of the line before a chunk.
    Size(Vec<u8>),
    Chunk(u64),
    /// The received part of the line end after a chunk.
    ChunkEnd(Vec<u8>),
    /// The lines after the last chunk: length of the present line, and of all lines.
    Trailer(usize, usize),
    Ended,
}

/// The bytes do not match the announced framing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct BrokenBody;

impl Unframer {
    pub(crate) fn new(framing: Framing) -> Self {
        Self(match framing {
            Framing::Length(0) => BodyState::Ended,
            Framing::Length(length) => BodyState::Length(length),
            Framing::Chunked => BodyState::Size(Vec::new()),
            Framing::Close => BodyState::Close,
        })
    }

    /// Whether the whole body has been received.
    pub(crate) fn has_ended(&self) -> bool {
        self.0 == BodyState::Ended
    }

    /// Whether the body may end here because the connection was closed.
    pub(crate) fn may_end(&self) -> bool {
        matches!(self.0, BodyState::Ended | BodyState::Close)
    }

    /// Appends the part of the body in `bytes` to `out`. Bytes after its end are ignored.
    pub(crate) fn push(&mut self, mut bytes: &[u8], out: &mut Vec<u8>) -> Result<(), BrokenBody> {
        while !bytes.is_empty() {
            match &mut self.0 {
                BodyState::Ended => return Ok(()),
                BodyState::Close => {
                    out.extend_from_slice(bytes);
                    return Ok(());
                }
                BodyState::Length(left) | BodyState::Chunk(left) => {
                    let len = usize::try_from(*left).unwrap_or(usize::MAX).min(bytes.len());
                    out.extend_from_slice(&bytes[..len]);
                    bytes = &bytes[len..];
                    *left -= len as u64;
                    if *left == 0 {
                        let is_chunk = matches!(self.0, BodyState::Chunk(_));
                        self.0 = if is_chunk { BodyState::ChunkEnd(Vec::new()) } else { BodyState::Ended };
                    }
                }
                BodyState::Size(line) => {
                    let end = bytes.iter().position(|byte| *byte == b'\n');
                    let taken = end.map_or(bytes.len(), |end| end + 1);
                    if line.len() + taken > MAX_LINE {
                        return Err(BrokenBody);
                    }
                    line.extend_from_slice(&bytes[..taken]);
                    bytes = &bytes[taken..];
                    if end.is_some() {
                        self.0 = match size(line).ok_or(BrokenBody)? {
                            0 => BodyState::Trailer(0, 0),
                            size => BodyState::Chunk(size),
                        };
                    }
                }
                BodyState::ChunkEnd(seen) => {
                    seen.push(bytes[0]);
                    bytes = &bytes[1..];
                    match &seen[..] {
                        b"\r" => {}
                        b"\r\n" => self.0 = BodyState::Size(Vec::new()),
                        _ => return Err(BrokenBody),
                    }
                }
                BodyState::Trailer(line, all) => {
                    let byte = bytes[0];
                    bytes = &bytes[1..];
                    *all += 1;
                    match byte {
                        b'\n' if *line == 0 => self.0 = BodyState::Ended,
                        b'\n' => *line = 0,
                        b'\r' => {}
                        _ => *line += 1,
                    }
                    if matches!(self.0, BodyState::Trailer(_, all) if all > MAX_TRAILER) {
                        return Err(BrokenBody);
                    }
                }
            }
        }
        Ok(())
    }
}

fn size(line: &[u8]) -> Option<u64> {
    let line = std::str::from_utf8(line).ok()?.strip_suffix("\r\n")?;
    let digits = line.split(';').next()?.trim_end_matches([' ', '\t']);
    let is_hex =
        !digits.is_empty() && digits.len() <= 15 && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    u64::from_str_radix(digits, 16).ok().filter(|_| is_hex)
}

/// Maximum length of the line before a chunk.
const MAX_LINE: usize = 256;
/// Maximum length of all trailer lines.
const MAX_TRAILER: usize = 4_096;

#[cfg(test)]
mod tests {
    use super::*;

    fn unframed(framing: Framing, bytes: &[u8], at_once: usize) -> (Result<(), BrokenBody>, Vec<u8>, bool) {
        let (mut unframer, mut out) = (Unframer::new(framing), Vec::new());
        let mut result = Ok(());
        for piece in bytes.chunks(at_once) {
            result = result.and_then(|()| unframer.push(piece, &mut out));
        }
        (result, out, unframer.has_ended())
    }

    #[test]
    fn a_body_is_the_same_however_it_is_cut() {
        let chunked = b"4\r\nabcd\r\n0a;name=value\r\n0123456789\r\n0\r\nTrailer: x\r\n\r\nmore";
        for at_once in 1..=chunked.len() {
            let (result, out, has_ended) = unframed(Framing::Chunked, chunked, at_once);
            assert_eq!((result, &out[..], has_ended), (Ok(()), &b"abcd0123456789"[..], true), "{at_once}");
            let (result, out, has_ended) = unframed(Framing::Length(4), b"abcdefgh", at_once);
            assert_eq!((result, &out[..], has_ended), (Ok(()), &b"abcd"[..], true), "{at_once}");
        }
        assert!(!unframed(Framing::Chunked, b"4\r\nabcd\r\n", 3).2);
        assert!(!unframed(Framing::Length(5), b"abcd", 3).2);
        assert_eq!(unframed(Framing::Close, b"abcd", 3), (Ok(()), b"abcd".to_vec(), false));
    }

    #[test]
    fn wrong_chunks_are_refused_and_take_no_room() {
        let long = [b"4;".as_slice(), &[b'x'; MAX_LINE]].concat();
        let trailer = [b"0\r\n".as_slice(), &[b'x'; MAX_TRAILER + 1]].concat();
        for wrong in [
            &b"\r\n"[..],
            b"-1\r\n",
            b"+4\r\n",
            b"4\n",
            b"g\r\n",
            b"1\r\nab",
            b"ffffffffffffffffff\r\n",
            &long,
            &trailer,
        ] {
            let (result, out, _) = unframed(Framing::Chunked, wrong, 7);
            assert_eq!(result, Err(BrokenBody), "{:?}", String::from_utf8_lossy(wrong));
            assert!(out.len() < 8);
        }
    }
}
