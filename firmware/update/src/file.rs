//! The update file: one firmware, linked for each slot (docs/update.md section 3).
//!
//! It begins with a head of 16 bytes. Then follow, for each link, its header and its image, padded with 0xFF to whole
//! words of 32 bytes.

use core::fmt;

use recipe_store::{Slot, WORD};
use salty::Sha512;

use crate::check::BadImage;
use crate::header::{CRC, HEADER, Header, HeaderError, ImageFacts};

/// Number of bytes before the first link.
pub const FILE_HEAD: usize = 16;

const MAGIC: [u8; 4] = *b"RGUP";
const VERSION: u32 = 1;
const LINKS: usize = Slot::ALL.len();

/// An update file, borrowed from its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UpdateFile<'b> {
    links: [Option<SlotImage<'b>>; LINKS],
}

/// The firmware linked for one slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotImage<'b> {
    /// What it is.
    pub header: Header,
    /// The header as it is in the file.
    pub header_bytes: &'b [u8; HEADER],
    /// The image.
    pub image: &'b [u8],
}

/// Why a file is not an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum FileError {
    /// The magic number is missing.
    NotAnUpdate,
    /// It was made for a newer version of the format.
    Version {
        /// The version found.
        found: u32,
    },
    /// It is truncated, or has trailing bytes.
    Length {
        /// Length according to the file, in bytes.
        said: u32,
        /// Length of the file, in bytes.
        found: usize,
    },
    /// The number of links is wrong.
    Links {
        /// Number of links.
        found: u32,
    },
    /// The header of a link is wrong.
    Header {
        /// Its number in the file, from 0.
        link: u8,
        /// Why.
        why: HeaderError,
    },
    /// A link extends beyond the file, or is padded with bytes other than 0xFF.
    Image {
        /// The slot it is for.
        slot: Slot,
    },
    /// Two links are for one slot.
    Twice {
        /// That slot.
        slot: Slot,
    },
    /// The links belong to different firmware versions.
    Different,
}

impl fmt::Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotAnUpdate => f.write_str("not an update file"),
            Self::Version { found } => {
                write!(f, "the update file has version {found}; this program reads {VERSION}")
            }
            Self::Length { said, found } => {
                write!(
                    f,
                    "the update file has {found} bytes and says that it has {said}: it was cut short or changed"
                )
            }
            Self::Links { found } => {
                write!(f, "the update file has {found} links; 1 to {LINKS} are possible")
            }
            Self::Header { link, why } => write!(f, "link {link} of the update file: {why}"),
            Self::Image { slot } => write!(f, "the image for slot {slot:?} is damaged"),
            Self::Twice { slot } => write!(f, "two images are for slot {slot:?}"),
            Self::Different => f.write_str("the images are not of one firmware"),
        }
    }
}

impl core::error::Error for FileError {}

/// Head of a file with this number of links and this total length in bytes.
pub fn file_head(links: u32, length: u32) -> [u8; FILE_HEAD] {
    let mut head = [0; FILE_HEAD];
    let parts = [MAGIC, VERSION.to_le_bytes(), links.to_le_bytes(), length.to_le_bytes()];
    head.iter_mut().zip(parts.as_flattened()).for_each(|(place, byte)| *place = *byte);
    head
}

/// Number of bytes of 0xFF behind an image of this length.
pub fn link_padding(length: usize) -> usize {
    length.checked_next_multiple_of(WORD).unwrap_or(length).saturating_sub(length)
}

impl<'b> UpdateFile<'b> {
    /// Parses a file. Checks its form and that the links are of one firmware. Does not check their contents
    /// ([`SlotImage::check`]) or signatures ([`Header::verify`]).
    pub fn parse(bytes: &'b [u8]) -> Result<Self, FileError> {
        let (head, mut rest) = bytes.split_first_chunk::<FILE_HEAD>().ok_or(FileError::NotAnUpdate)?;
        let &[magic, version, links, said] = head.as_chunks::<4>().0 else {
            return Err(FileError::NotAnUpdate);
        };
        if magic != MAGIC {
            return Err(FileError::NotAnUpdate);
        }
        let [version, count, said] = [version, links, said].map(u32::from_le_bytes);
        if version != VERSION {
            return Err(FileError::Version { found: version });
        }
        if said as usize != bytes.len() {
            return Err(FileError::Length { said, found: bytes.len() });
        }
        if !(1..=LINKS as u32).contains(&count) {
            return Err(FileError::Links { found: count });
        }
        let mut links: [Option<SlotImage<'b>>; LINKS] = [None; LINKS];
        let mut first: Option<ImageFacts> = None;
        for nth in 0..count {
            let link = u8::try_from(nth).unwrap_or(u8::MAX);
            let cut = HeaderError::NotAHeader { found: [0; 4] };
            let (header_bytes, behind) =
                rest.split_first_chunk::<HEADER>().ok_or(FileError::Header { link, why: cut })?;
            let header = Header::parse(header_bytes).map_err(|why| FileError::Header { link, why })?;
            let slot = header.slot();
            let length = header.length() as usize;
            let (image, behind) = behind.split_at_checked(length).ok_or(FileError::Image { slot })?;
            let (fill, behind) =
                behind.split_at_checked(link_padding(length)).ok_or(FileError::Image { slot })?;
            if fill.iter().any(|byte| *byte != 0xFF) {
                return Err(FileError::Image { slot });
            }
            let parts = ImageFacts { slot: Slot::A, ..*header.parts() };
            if *first.get_or_insert(parts) != parts {
                return Err(FileError::Different);
            }
            let place = links.get_mut(usize::from(slot.number()));
            if place.is_none_or(|place| place.replace(SlotImage { header, header_bytes, image }).is_some()) {
                return Err(FileError::Twice { slot });
            }
            rest = behind;
        }
        match rest {
            [] => Ok(Self { links }),
            _ => Err(FileError::Length { said, found: bytes.len().saturating_sub(rest.len()) }),
        }
    }

    /// The link for a slot.
    pub fn link(&self, slot: Slot) -> Option<&SlotImage<'b>> {
        self.links.get(usize::from(slot.number()))?.as_ref()
    }

    /// All links, in the order of the slots.
    pub fn links(&self) -> impl Iterator<Item = &SlotImage<'b>> {
        self.links.iter().flatten()
    }
}

impl SlotImage<'_> {
    /// Checks the image against CRC and hash of the header.
    pub fn check(&self) -> Result<(), BadImage> {
        if CRC.checksum(self.image) != self.header.crc() {
            return Err(BadImage::Crc);
        }
        let mut hash = Sha512::new();
        hash.update(self.image);
        if hash.finalize() != *self.header.hash() {
            return Err(BadImage::Hash);
        }
        Ok(())
    }
}
