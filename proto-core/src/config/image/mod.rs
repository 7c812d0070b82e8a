//! The configuration image: the form in which a board stores its configuration (docs/configuration.md section 6).
//!
//! In: a checked configuration, or bytes from flash or a file. Out: the other. An image of an older version is
//! migrated. An image is refused with a reason if it is truncated, has a changed bit, has a newer version, or holds an
//! invalid configuration. Bytes after the image are ignored, because flash is erased in whole sectors. [`Scan`] checks
//! an image without keeping its contents, if there is no space for a second configuration.
//!
//! **To change a serialized type,** raise [`VERSION`], copy the old types into the module of the old version, with
//! `From` into the new ones, and add a reader for them to `decode_into`. Readers of old versions never change
//! afterwards. `tests/golden` has the images that must remain readable.

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
/// The version of the payload, raised for every change of a serialized type.
pub const VERSION: u32 = 4;
/// The oldest readable version.
pub const OLDEST_VERSION: u32 = 3;
/// Length of the header: magic, version, payload length and CRC-32, four bytes each, little-endian.
pub const HEADER: usize = 16;
/// Maximum length of an image, header included. Every configuration that fits a board is shorter; only a file with
/// hundreds of fields and CAN ids is longer, which is refused when the image is written.
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
    /// The bytes do not begin with [`MAGIC`], such as erased flash.
    NotAnImage {
        /// The first bytes.
        found: [u8; 4],
    },
    /// The version is unknown, such as a newer one.
    Version {
        /// The image's version.
        found: u32,
    },
    /// The header's length exceeds the maximum.
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
    /// The payload does not decode: it was written with other types.
    Contents,
    /// The image has more entries than the configuration can hold.
    TooMany {
        /// The list.
        what: Counted,
        /// Number of entries in the image.
        needed: usize,
        /// Number of entries that fit.
        room: usize,
    },
    /// The configuration is invalid.
    Config(ConfigError),
}

/// Whether the byte may occur in a text file.
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
/// The configuration is not checked here, but when the image is read.
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
/// [`NoSpace`] if `out` is too short.
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

/// Decodes an image and checks the configuration.
///
/// # Errors
/// [`ImageError`], with the reason.
pub fn decode(bytes: &[u8]) -> Result<GatewayConfig, ImageError> {
    let mut config = GatewayConfig::empty();
    decode_into(bytes, &mut config)?;
    Ok(config)
}

/// Like [`decode`], but in place and into a configuration of any size: for boards whose stack is smaller than a few
/// configurations of almost 60 KiB each.
///
/// # Errors
/// Those of [`decode`]; do not use `config` then.
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

/// Reads the data before the lists: the controller, and the board's address.
fn read_head(version: u32, rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    match version {
        3 => v3::read_head(rest, config),
        _ => v4::read_head(rest, config),
    }
}

/// Reads the number of entries of a list.
fn count(rest: &mut &[u8], what: Counted, room: usize) -> Result<usize, ImageError> {
    let needed: usize = item(rest)?;
    if needed > room {
        return Err(ImageError::TooMany { what, needed, room });
    }
    Ok(needed)
}

/// Appends the next entries to a list.
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

/// Reads this many entries, whose type may be that of an older version.
fn items<T: DeserializeOwned + Into<Today>, Today>(
    rest: &mut &[u8],
    count: usize,
    all: &mut VecView<Today>,
) -> Result<(), ImageError> {
    for _ in 0..count {
        // Does not use `item`, which copies each result once more; recipes are large.
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
    /// Empties a list and returns its capacity.
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

/// The length of the image with its header at the front of `bytes`.
///
/// # Errors
/// [`ImageError`] if there is no header, or its length is invalid.
pub fn image_len(bytes: &[u8]) -> Result<usize, ImageError> {
    let (_, length, _) = header(bytes)?;
    Ok(HEADER.saturating_add(length as usize))
}

/// Version, payload length and CRC of the header.
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

/// The CRC-32 of an image, which must be complete and of a readable version. Does not check the configuration.
///
/// # Errors
/// [`ImageError`], with the reason.
pub fn intact(bytes: &[u8]) -> Result<u32, ImageError> {
    payload(bytes)?;
    let (_, _, crc) = header(bytes)?;
    Ok(crc)
}

/// Checks an image and returns its version and payload.
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

/// Covers version, length and payload, so a damaged header is detected too.
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
