//! The configuration image: what a board stores instead of the TOML file (docs/configuration.md
//! section 6).
//!
//! In: a checked configuration, or bytes from flash or a file. Out: the other. An image of an older
//! version is migrated. An image that was cut short, damaged in any bit, written for a newer
//! version, or that holds an invalid configuration is refused with a reason. Bytes after the image
//! are ignored, because flash is erased in whole sectors. [`Scan`] reads one without keeping what is in
//! it, where there is no room for a second configuration.
//!
//! **To change a serialized type,** raise [`VERSION`], copy the types as they were into the module
//! of the old version, with `From` into today's, and give `decode_into` a new first reader. What an
//! old version reads is never changed afterwards. `tests/golden` has the images that must
//! remain readable.

mod scan;
mod v3;
mod v4;

pub use scan::Scan;

use core::fmt;

use crc::{CRC_32_ISO_HDLC, Crc};
use heapless::VecView;
use postcard::Deserializer;
use serde::de::DeserializeOwned;

use super::error::Counted;
use super::{ConfigError, ConfigMut, ConfigView, GatewayConfig};

/// The first bytes of every image.
pub const MAGIC: [u8; 4] = *b"RGCI";
/// The version of the payload: one more for every change of a serialized type.
pub const VERSION: u32 = 4;
/// The oldest version that is read.
pub const OLDEST_VERSION: u32 = 3;
/// Length of the header: magic, version, payload length and CRC-32, four bytes each, little-endian.
pub const HEADER: usize = 16;
/// Maximum length of an image, header included. Every configuration that a board has room for is
/// shorter; only a file with hundreds of fields and CAN ids is longer, and is refused when the
/// image is made.
pub const MAX_IMAGE: usize = 16 * 1024;

/// Why an image is refused.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum ImageError {
    /// The image is shorter than the header, or than the header announces.
    TooShort {
        /// Number of bytes needed.
        needed: usize,
        /// Number of bytes available.
        available: usize,
    },
    /// It does not begin with [`MAGIC`]: erased flash, or something else.
    NotAnImage {
        /// What it begins with.
        found: [u8; 4],
    },
    /// The image has an unknown version: a newer one.
    Version {
        /// The image's version.
        found: u32,
    },
    /// The header announces more bytes than an image can have.
    TooLong {
        /// The payload's length in the header.
        payload: u32,
    },
    /// A bit has changed since the image was written.
    Crc {
        /// The CRC in the header.
        stored: u32,
        /// The CRC of the bytes.
        computed: u32,
    },
    /// The payload is not a configuration; it was written with other types.
    Contents,
    /// The image has more entries than the configuration has room for.
    TooMany {
        /// The list.
        what: Counted,
        /// Number of entries in the image.
        needed: usize,
        /// Number of entries there is room for.
        room: usize,
    },
    /// The configuration is invalid.
    Config(ConfigError),
}

/// Whether a file of text can have the byte.
const fn is_text(byte: u8) -> bool {
    matches!(byte, b' '..=b'~' | b'\t' | b'\n' | b'\r')
}

impl fmt::Display for ImageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooShort { needed, available } => {
                write!(f, "the image is cut short: {needed} bytes are needed, {available} are there")
            }
            Self::NotAnImage { found } if found.iter().all(|&byte| is_text(byte)) => f.write_str(
                "this is text, not a configuration image; `host-sim image FILE -o OUT` makes the image of a TOML file",
            ),
            Self::NotAnImage { found } => write!(f, "not a configuration image: it begins with {found:02X?}"),
            Self::Version { found } => {
                write!(f, "the image has version {found}; this program reads {OLDEST_VERSION} to {VERSION}")
            }
            Self::TooLong { payload } => {
                write!(f, "the image announces {payload} bytes; at most {MAX_IMAGE} are allowed")
            }
            Self::Crc { stored, computed } => {
                write!(
                    f,
                    "the image is damaged: it stores the CRC {stored:08X}, its bytes give {computed:08X}"
                )
            }
            Self::Contents => write!(f, "the image does not contain a configuration"),
            Self::TooMany { what, needed, room } => {
                write!(f, "the image has {needed} {what}; there is room for {room}")
            }
            Self::Config(error) => write!(f, "the image's configuration is invalid: {error}"),
        }
    }
}

impl core::error::Error for ImageError {}

/// The buffer is too short for the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoSpace {
    /// Length of the buffer; no image is longer than [`MAX_IMAGE`].
    pub available: usize,
}

impl fmt::Display for NoSpace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the image does not fit in {} bytes", self.available)
    }
}

impl core::error::Error for NoSpace {}

/// Writes the image of a configuration in the newest version, and returns its length.
///
/// The configuration is checked when the image is read, not here.
///
/// ```
/// use proto_core::config::{GatewayConfig, Port, Recipe, image};
/// type Config = GatewayConfig<1, 1, 1, 0, 0>;
///
/// // A host program writes it to a file.
/// let outputs = &["DigitalOutputCommand[1]"];
/// let config: Config = GatewayConfig::builder()
///     .controller("192.168.12.138")
///     .recipe(Recipe::realtime("outputs").stream_input(&[0xFF, 0xFF], &[0xEE, 0xEE], outputs))
///     .port(Port::rs485("rs485-1", "outputs"))
///     .build()?;
/// let mut flash = [0xFF; image::MAX_IMAGE];
/// let len = image::encode(&config, &mut flash)?;
///
/// // The board reads it; what follows in its sector does not matter.
/// let mut read = Config::empty();
/// image::decode_into(&flash, &mut read)?;
/// assert_eq!((read, len < 128), (config, true));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`NoSpace`] when `out` is too short.
pub fn encode<'c>(config: impl Into<ConfigView<'c>>, out: &mut [u8]) -> Result<usize, NoSpace> {
    encode_view(config.into(), out)
}

fn encode_view(config: ConfigView<'_>, out: &mut [u8]) -> Result<usize, NoSpace> {
    let no_space = NoSpace { available: out.len() };
    let (header, room) = out.split_at_mut_checked(HEADER).ok_or(no_space)?;
    let payload = v4::write(config, room).map_err(|_| no_space)?;
    let length = u32::try_from(payload.len()).map_err(|_| no_space)?;
    let crc = checksum(VERSION, length, payload);
    let words = [u32::from_le_bytes(MAGIC), VERSION, length, crc];
    for (bytes, word) in header.chunks_exact_mut(4).zip(words) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    Ok(HEADER.saturating_add(payload.len()))
}

/// Reads an image and checks the configuration in it.
///
/// # Errors
/// [`ImageError`] says what is wrong with it.
pub fn decode(bytes: &[u8]) -> Result<GatewayConfig, ImageError> {
    let mut config = GatewayConfig::empty();
    decode_into(bytes, &mut config)?;
    Ok(config)
}

/// Same as [`decode`], in place and into a configuration of any size: for boards whose stack is
/// smaller than a few configurations of almost 60 KiB each.
///
/// # Errors
/// Same as [`decode`]; `config` must not be used then.
pub fn decode_into<
    const PORTS: usize,
    const RECIPES: usize,
    const FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
    const EXCHANGES: usize,
>(
    bytes: &[u8],
    config: &mut GatewayConfig<PORTS, RECIPES, FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>,
) -> Result<(), ImageError> {
    decode_view(bytes, config.view_mut())
}

fn decode_view(bytes: &[u8], mut config: ConfigMut<'_>) -> Result<(), ImageError> {
    let (version, mut rest) = payload(bytes)?;
    read_head(version, &mut rest, &mut config)?;
    for list in &v4::LISTS {
        let room = config.clear(*list);
        let count = count(&mut rest, *list, room)?;
        read_entries(version, *list, count, &mut rest, &mut config)?;
    }
    if !rest.is_empty() {
        return Err(ImageError::Contents);
    }
    config.view().validate().map_err(ImageError::Config)
}

/// What is in front of the lists: the controller, and the board's address.
fn read_head(version: u32, rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    match version {
        3 => v3::read_head(rest, config),
        _ => v4::read_head(rest, config),
    }
}

/// The number of entries of a list.
fn count(rest: &mut &[u8], what: Counted, room: usize) -> Result<usize, ImageError> {
    let needed: usize = item(rest)?;
    if needed > room {
        return Err(ImageError::TooMany { what, needed, room });
    }
    Ok(needed)
}

/// The next entries of a list, behind those that are there.
fn read_entries(
    version: u32,
    list: Counted,
    count: usize,
    rest: &mut &[u8],
    config: &mut ConfigMut<'_>,
) -> Result<(), ImageError> {
    match version {
        3 => v3::read_entries(list, count, rest, config),
        _ => v4::read_entries(list, count, rest, config),
    }
}

fn item<T: DeserializeOwned>(rest: &mut &[u8]) -> Result<T, ImageError> {
    let (item, behind) = postcard::take_from_bytes(rest).map_err(|_| ImageError::Contents)?;
    *rest = behind;
    Ok(item)
}

/// So many entries, which may be of an older version's type.
fn items<T: DeserializeOwned + Into<Today>, Today>(
    rest: &mut &[u8],
    count: usize,
    all: &mut VecView<Today>,
) -> Result<(), ImageError> {
    for _ in 0..count {
        // Not by `item`: each result that is passed on is copied, and recipes are large.
        let mut reader = Deserializer::from_bytes(rest);
        let pushed = match T::deserialize(&mut reader) {
            Ok(item) => all.push(item.into()).is_ok(),
            Err(_) => false,
        };
        match reader.finalize() {
            Ok(behind) if pushed => *rest = behind,
            _ => return Err(ImageError::Contents),
        }
    }
    Ok(())
}

impl ConfigMut<'_> {
    /// Empties a list; returns how many entries it has room for.
    fn clear(&mut self, list: Counted) -> usize {
        fn clear<T>(all: &mut VecView<T>) -> usize {
            all.clear();
            all.capacity()
        }
        match list {
            Counted::Recipes => clear(self.recipes),
            Counted::Ports => clear(self.ports),
            Counted::Fields => clear(self.fields),
            Counted::Commands => clear(self.commands),
            Counted::SafeValues => clear(self.safe_values),
            Counted::Exchanges => clear(self.exchanges),
            Counted::ExchangeFrames => clear(self.frames),
            _ => 0,
        }
    }
}

/// The length of the image whose header is at the start of `bytes`.
///
/// # Errors
/// [`ImageError`] if it is not a header, or if the announced length is not possible.
pub fn image_len(bytes: &[u8]) -> Result<usize, ImageError> {
    let (_, length, _) = header(bytes)?;
    Ok(HEADER.saturating_add(length as usize))
}

/// Version, payload length and CRC.
fn header(bytes: &[u8]) -> Result<(u32, u32, u32), ImageError> {
    let too_short = ImageError::TooShort { needed: HEADER, available: bytes.len() };
    let header: &[u8; HEADER] = bytes.first_chunk().ok_or(too_short)?;
    let (words, _) = header.as_chunks::<4>();
    let &[magic, version, length, crc] = words else { return Err(too_short) };
    if magic != MAGIC {
        return Err(ImageError::NotAnImage { found: magic });
    }
    let version = u32::from_le_bytes(version);
    if !(OLDEST_VERSION..=VERSION).contains(&version) {
        return Err(ImageError::Version { found: version });
    }
    let length = u32::from_le_bytes(length);
    if length as usize > MAX_IMAGE.saturating_sub(HEADER) {
        return Err(ImageError::TooLong { payload: length });
    }
    Ok((version, length, u32::from_le_bytes(crc)))
}

/// The CRC-32 of an image that is whole and of a version that is read; the configuration in it is not looked at.
///
/// # Errors
/// [`ImageError`] says what is wrong with the image.
pub fn intact(bytes: &[u8]) -> Result<u32, ImageError> {
    payload(bytes)?;
    let (_, _, crc) = header(bytes)?;
    Ok(crc)
}

/// The version and the payload.
fn payload(bytes: &[u8]) -> Result<(u32, &[u8]), ImageError> {
    let (version, length, stored) = header(bytes)?;
    let needed = HEADER.saturating_add(length as usize);
    let payload = bytes.get(HEADER..needed).ok_or(ImageError::TooShort { needed, available: bytes.len() })?;
    let computed = checksum(version, length, payload);
    if computed != stored {
        return Err(ImageError::Crc { stored, computed });
    }
    Ok((version, payload))
}

/// Over version, length and payload: the header must be intact as well.
fn checksum(version: u32, length: u32, payload: &[u8]) -> u32 {
    let mut digest = CRC.digest();
    digest.update(&version.to_le_bytes());
    digest.update(&length.to_le_bytes());
    digest.update(payload);
    digest.finalize()
}

static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

#[cfg(test)]
mod tests;
