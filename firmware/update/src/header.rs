//! The header of a slot (docs/update.md section 3).
//!
//! It has 192 bytes, six words of flash: the signature, then 128 signed bytes, which contain the hash of the image. So
//! the signature is checked over 128 bytes only, and the hash can be computed in pieces, between which other tasks run.

use core::fmt;

use crc::{CRC_32_ISO_HDLC, Crc};
use recipe_store::Slot;
use salty::{Keypair, Sha512, Signature};

/// Number of bytes of a header.
pub const HEADER: usize = 192;
/// Number of bytes that are signed: the header without the signature.
pub const SIGNED: usize = 128;
/// Offset of the image in a slot, in bytes: the alignment of a vector table of the Cortex-M7.
pub const IMAGE_OFFSET: u32 = 1024;

const SIGNATURE: usize = HEADER - SIGNED;
const MAGIC: [u8; 4] = *b"RGFW";
const VERSION: u32 = 1;
/// Number of bytes that the CRC of the header covers: the signed bytes except the CRC itself.
const CHECKED: usize = SIGNED - 4;

/// The name of a board, such as `nucleo-h743zi`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BoardName([u8; 16]);

impl BoardName {
    /// A name of 1 to 16 small letters, digits and `-`; `None` for other texts.
    pub fn parse(name: &str) -> Option<Self> {
        let mut bytes = [0; 16];
        if name.len() > bytes.len() {
            return None;
        }
        bytes.iter_mut().zip(name.bytes()).for_each(|(place, byte)| *place = byte);
        Self::of_bytes(bytes)
    }

    fn of_bytes(bytes: [u8; 16]) -> Option<Self> {
        let len = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
        let (name, rest) = bytes.split_at_checked(len)?;
        let is_name = |byte: &u8| matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'-');
        let is_right = len > 0 && name.iter().all(is_name) && rest.iter().all(|byte| *byte == 0);
        is_right.then_some(Self(bytes))
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        let len = self.0.iter().position(|byte| *byte == 0).unwrap_or(self.0.len());
        self.0.get(..len).and_then(|name| core::str::from_utf8(name).ok()).unwrap_or("")
    }
}

impl fmt::Display for BoardName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// The version of a firmware. A higher one is newer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Version {
    /// The first number.
    pub major: u16,
    /// The second number.
    pub minor: u16,
    /// The third number.
    pub patch: u16,
}

impl Version {
    /// Builds a version.
    pub const fn new(major: u16, minor: u16, patch: u16) -> Self {
        Self { major, minor, patch }
    }

    /// Three numbers with dots between, such as `0.3.0`; `None` for other texts.
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.as_bytes().split(|byte| *byte == b'.').map(|part| {
            let is_number = match part {
                [b'1'..=b'9', rest @ ..] => rest.iter().all(u8::is_ascii_digit),
                other => other == b"0",
            };
            str::from_utf8(part).ok()?.parse().ok().filter(|_| is_number)
        });
        let version = Self::new(parts.next()??, parts.next()??, parts.next()??);
        parts.next().is_none().then_some(version)
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { major, minor, patch } = self;
        write!(f, "{major}.{minor}.{patch}")
    }
}

/// Versions of the configuration image that a firmware supports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Formats {
    /// The oldest that it reads.
    pub oldest: u32,
    /// The newest that it reads.
    pub newest: u32,
    /// The version that it writes.
    pub written: u32,
}

impl Formats {
    /// `None` unless `written` is between `oldest` and `newest`.
    pub fn new(oldest: u32, newest: u32, written: u32) -> Option<Self> {
        (oldest <= written && written <= newest).then_some(Self { oldest, newest, written })
    }

    /// Whether an image of this version can be read.
    pub fn reads(&self, version: u32) -> bool {
        (self.oldest..=self.newest).contains(&version)
    }
}

/// Facts about an image that the image does not contain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageFacts {
    /// The board it is for.
    pub board: BoardName,
    /// The slot it is linked for.
    pub slot: Slot,
    /// Version of the firmware.
    pub version: Version,
    /// Configuration versions that it supports.
    pub formats: Formats,
    /// The version of the store that it reads and writes.
    pub store: u32,
}

/// A header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    parts: ImageFacts,
    /// Length of the image in bytes; never 0.
    length: u32,
    /// CRC-32 of the image.
    crc: u32,
    /// SHA-512 of the image.
    hash: [u8; 64],
    signature: [u8; SIGNATURE],
}

/// Why bytes are not a valid header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum HeaderError {
    /// The magic number is missing: there is no firmware.
    NotAHeader {
        /// Found instead of the magic number.
        found: [u8; 4],
    },
    /// It was made for a newer version of the format.
    Version {
        /// The version found.
        found: u32,
    },
    /// The CRC does not match.
    Crc {
        /// The CRC in the header.
        stored: u32,
        /// The CRC of its bytes.
        computed: u32,
    },
    /// There is no such slot.
    Slot {
        /// The slot number found.
        found: u32,
    },
    /// The name of the board is invalid.
    Board,
    /// The image is empty.
    Empty,
    /// The versions of the configuration contradict each other.
    Formats,
    /// A reserved byte is not zero.
    Reserved,
}

impl fmt::Display for HeaderError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotAHeader { found } => write!(f, "not a firmware: it begins with {found:02X?}"),
            Self::Version { found } => {
                write!(f, "the header has version {found}; this program reads {VERSION}")
            }
            Self::Crc { stored, computed } => {
                write!(
                    f,
                    "the header is damaged: it stores the CRC {stored:08X}, its bytes give {computed:08X}"
                )
            }
            Self::Slot { found } => write!(f, "there is no slot {found}"),
            Self::Board => f.write_str("the header names no board"),
            Self::Empty => f.write_str("the image is empty"),
            Self::Formats => f.write_str("the firmware would not read the configurations that it writes"),
            Self::Reserved => f.write_str("the header has contents that this program does not know"),
        }
    }
}

impl core::error::Error for HeaderError {}

/// A header was not signed with this key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Foreign;

impl fmt::Display for Foreign {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the firmware was not signed with the key of this board")
    }
}

impl core::error::Error for Foreign {}

/// Public key (Ed25519).
#[derive(Debug, Clone, PartialEq)]
pub struct PublicKey(salty::PublicKey);

impl PublicKey {
    /// `None` if the bytes are not a point of the curve.
    pub fn parse(bytes: &[u8; 32]) -> Option<Self> {
        salty::PublicKey::try_from(bytes).ok().map(Self)
    }

    /// The public key of the private key with this seed.
    pub fn of_seed(seed: &[u8; 32]) -> Self {
        Self(Keypair::from(seed).public)
    }

    /// The 32 bytes of the key.
    pub fn bytes(&self) -> [u8; 32] {
        self.0.to_bytes()
    }
}

impl Header {
    /// Builds the header of an image, signed with the key of this seed; `None` if the image is empty or its length
    /// exceeds a `u32`.
    pub fn sign(parts: ImageFacts, image: &[u8], seed: &[u8; 32]) -> Option<Self> {
        let length = u32::try_from(image.len()).ok().filter(|length| *length > 0)?;
        let mut hash = Sha512::new();
        hash.update(image);
        let hash = hash.finalize();
        let unsigned = Self { parts, length, crc: CRC.checksum(image), hash, signature: [0; SIGNATURE] };
        let signature = Keypair::from(seed).sign(&unsigned.signed()).to_bytes();
        Some(Self { signature, ..unsigned })
    }

    /// Parses a header. Checks its form only, not the signature.
    pub fn parse(bytes: &[u8; HEADER]) -> Result<Self, HeaderError> {
        let mut fields = HeaderReader(bytes);
        let signature = fields.take();
        let magic = fields.take();
        if magic != MAGIC {
            return Err(HeaderError::NotAHeader { found: magic });
        }
        let version = fields.number();
        if version != VERSION {
            return Err(HeaderError::Version { found: version });
        }
        let slot = fields.number();
        let length = fields.number();
        let board = fields.take();
        let hash = fields.take();
        let numbers: [u16; 4] = core::array::from_fn(|_| u16::from_le_bytes(fields.take()));
        let (oldest, newest, written) = (fields.number(), fields.number(), fields.number());
        let (store, crc, stored) = (fields.number(), fields.number(), fields.number());
        let checked = bytes.get(SIGNATURE..).and_then(|signed| signed.get(..CHECKED));
        let computed = CRC.checksum(checked.unwrap_or(&[]));
        if stored != computed {
            return Err(HeaderError::Crc { stored, computed });
        }
        let [major, minor, patch, 0] = numbers else { return Err(HeaderError::Reserved) };
        let of_number = u8::try_from(slot).ok().and_then(Slot::of_number);
        let parts = ImageFacts {
            board: BoardName::of_bytes(board).ok_or(HeaderError::Board)?,
            slot: of_number.ok_or(HeaderError::Slot { found: slot })?,
            version: Version { major, minor, patch },
            formats: Formats::new(oldest, newest, written).ok_or(HeaderError::Formats)?,
            store,
        };
        if length == 0 {
            return Err(HeaderError::Empty);
        }
        Ok(Self { parts, length, crc, hash, signature })
    }

    /// The bytes that are signed.
    pub fn signed(&self) -> [u8; SIGNED] {
        let ImageFacts { board, slot, version, formats, store } = self.parts;
        let mut bytes = [0; SIGNED];
        let mut fields = bytes.iter_mut();
        let mut put = |part: &[u8]| fields.by_ref().zip(part).for_each(|(place, byte)| *place = *byte);
        put(&MAGIC);
        [VERSION, slot.number().into(), self.length].iter().for_each(|number| put(&number.to_le_bytes()));
        put(&board.0);
        put(&self.hash);
        [version.major, version.minor, version.patch, 0].iter().for_each(|part| put(&part.to_le_bytes()));
        let numbers = [formats.oldest, formats.newest, formats.written, store, self.crc];
        numbers.iter().for_each(|number| put(&number.to_le_bytes()));
        let crc = CRC.checksum(bytes.get(..CHECKED).unwrap_or(&[]));
        bytes.iter_mut().skip(CHECKED).zip(crc.to_le_bytes()).for_each(|(place, byte)| *place = byte);
        bytes
    }

    /// The header as it is in flash.
    pub fn encode(&self) -> [u8; HEADER] {
        let mut bytes = [0; HEADER];
        let signed = self.signed();
        let all = self.signature.iter().chain(&signed);
        bytes.iter_mut().zip(all).for_each(|(place, byte)| *place = *byte);
        bytes
    }

    /// Checks the signature. Blocks for some million instructions, so a board calls it only when no cell depends on the
    /// board.
    pub fn verify(&self, key: &PublicKey) -> Result<(), Foreign> {
        key.0.verify(&self.signed(), &Signature::from(&self.signature)).map_err(|_| Foreign)
    }

    /// Facts about the image that the image does not contain.
    pub fn parts(&self) -> &ImageFacts {
        &self.parts
    }

    /// Length of the image in bytes.
    pub fn length(&self) -> u32 {
        self.length
    }

    /// The version of the firmware.
    pub fn version(&self) -> Version {
        self.parts.version
    }

    /// The slot it is linked for.
    pub fn slot(&self) -> Slot {
        self.parts.slot
    }

    /// SHA-512 of the image.
    pub fn hash(&self) -> &[u8; 64] {
        &self.hash
    }

    pub(crate) fn crc(&self) -> u32 {
        self.crc
    }
}

struct HeaderReader<'b>(&'b [u8]);

impl HeaderReader<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        match self.0.split_first_chunk() {
            Some((field, rest)) => {
                self.0 = rest;
                *field
            }
            // Not reached: the fields together are as long as the header.
            None => [0; N],
        }
    }

    fn number(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }
}

/// Computed with a table, because a loader checks an image at each start.
pub(crate) static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

#[cfg(test)]
mod tests {
    use super::*;
    use std::format;
    use std::string::ToString;

    const SEED: [u8; 32] = [0x42; 32];

    fn header() -> Header {
        let formats = Formats::new(1, 3, 3).unwrap();
        let board = BoardName::parse("nucleo-h743zi").unwrap();
        let parts = ImageFacts { board, slot: Slot::A, version: Version::new(0, 3, 1), formats, store: 1 };
        Header::sign(parts, b"an image", &SEED).unwrap()
    }

    /// Written by Python's `struct`, `hashlib` and `zlib`, and signed by OpenSSL with the first key of RFC 8032. Boards
    /// in the field check headers of this form: it does not change.
    const FIRST: &[&str] = &[
        "5507b125d886514e85b06dc07194940d7d81c2fbc0e473c0c8b6aa4ae9df15330acf8ba6231ac44bd8e846084655c72a",
        "7185b4e1e040c4706f5fe994e031cf0a524746570100000001000000030400006e75636c656f2d683734337a69000000",
        "b2100013ea0d2bb329e2bfcf2bce9609a7d3ef6cdf6d34eddd55336f054d500ff33b1678e125743055e735cfdb65b859",
        "10055254a84dcc1798a654ebc3841284000003000000000001000000030000000300000001000000d5d022f75d405b46",
    ];

    #[test]
    fn a_header_is_what_others_write() {
        let seed = "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60";
        let bytes = |digits: &str| -> std::vec::Vec<u8> {
            let pairs = digits.as_bytes().chunks(2).map(|pair| std::str::from_utf8(pair).unwrap());
            pairs.map(|pair| u8::from_str_radix(pair, 16).unwrap()).collect()
        };
        let image: std::vec::Vec<u8> = (0..1_024).map(|at| at as u8).chain(*b"end").collect();
        let parts = ImageFacts { slot: Slot::B, version: Version::new(0, 3, 0), ..*header().parts() };
        let header = Header::sign(parts, &image, &bytes(seed).try_into().unwrap()).unwrap();
        assert_eq!(header.encode()[..], bytes(&FIRST.concat())[..]);
        let key = "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a";
        let key = PublicKey::parse(&bytes(key).try_into().unwrap()).unwrap();
        assert_eq!(header.verify(&key), Ok(()));
    }

    #[test]
    fn every_changed_bit_is_found() {
        let bytes = header().encode();
        let key = PublicKey::of_seed(&SEED);
        for bit in 0..8 * HEADER {
            let mut changed = bytes;
            changed[bit / 8] ^= 1 << (bit % 8);
            match Header::parse(&changed) {
                Ok(read) => {
                    assert!(bit < 8 * SIGNATURE, "bit {bit}");
                    assert_eq!(read.verify(&key), Err(Foreign), "bit {bit}");
                }
                Err(_) => assert!(bit >= 8 * SIGNATURE, "bit {bit}"),
            }
        }
    }

    #[test]
    fn a_valid_crc_does_not_replace_the_signature() {
        let other = Header { length: 9, ..header() };
        let read = Header::parse(&other.encode()).unwrap();
        assert_eq!(read.verify(&PublicKey::of_seed(&SEED)), Err(Foreign));
    }

    #[test]
    fn what_contradicts_itself_is_refused() {
        let sealed = |change: &dyn Fn(&mut [u8; HEADER])| {
            let mut bytes = header().encode();
            change(&mut bytes);
            let crc = CRC.checksum(&bytes[64..188]);
            bytes[188..].copy_from_slice(&crc.to_le_bytes());
            Header::parse(&bytes).unwrap_err()
        };
        assert_eq!(sealed(&|bytes| bytes[68] = 2), HeaderError::Version { found: 2 });
        assert_eq!(sealed(&|bytes| bytes[72] = 2), HeaderError::Slot { found: 2 });
        assert_eq!(sealed(&|bytes| bytes[76..80].fill(0)), HeaderError::Empty);
        assert_eq!(sealed(&|bytes| bytes[80] = b'N'), HeaderError::Board);
        assert_eq!(sealed(&|bytes| bytes[80..96].fill(0)), HeaderError::Board);
        assert_eq!(sealed(&|bytes| bytes[95] = b'x'), HeaderError::Board);
        assert_eq!(sealed(&|bytes| bytes[166] = 1), HeaderError::Reserved);
        assert_eq!(sealed(&|bytes| bytes[168] = 4), HeaderError::Formats);
        let blank = Header::parse(&[0xFF; HEADER]).unwrap_err();
        assert_eq!(blank.to_string(), "not a firmware: it begins with [FF, FF, FF, FF]");
    }

    #[test]
    fn versions_and_names_are_read_as_they_are_shown() {
        for text in ["0.3.0", "10.20.65535"] {
            assert_eq!(format!("{}", Version::parse(text).unwrap()), text);
        }
        for text in ["", "1", "1.2", "1.2.3.4", "1.2.65536", "01.2.3", "1.2.+3", "1.2.x", "1..2", "0.3.0-rc1"]
        {
            assert_eq!(Version::parse(text), None, "{text}");
        }
        assert!(Version::new(0, 10, 0) > Version::new(0, 9, 9));
        for name in ["a", "nucleo-h743zi", "0123456789abcdef"] {
            assert_eq!(BoardName::parse(name).unwrap().as_str(), name);
        }
        for name in ["", "0123456789abcdefg", "Nucleo", "a b", "a\0b"] {
            assert_eq!(BoardName::parse(name), None, "{name}");
        }
    }
}
