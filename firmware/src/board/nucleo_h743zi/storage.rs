//! The configuration image that a debug probe has written: in the second flash bank, at `_config_start` (memory.x).
//!
//! A flash word that was programmed twice, or incompletely because of a power failure, has no valid error correction
//! code, and reading it causes a bus fault. So each flash word of the image is first read once with bus faults ignored.

use core::fmt;

use proto_core::config::image::{HEADER, MAX_IMAGE, image_len};

use super::readable::can_read;

unsafe extern "C" {
    static _config_start: u8;
}

/// Size of a flash word, the unit of programming and error correction.
pub(super) const FLASH_WORD: usize = 32;

const _: () = assert!(HEADER <= FLASH_WORD);

/// Why there is no image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StorageError {
    /// A flash word of the image cannot be read.
    Torn { address: usize },
}

impl fmt::Display for StorageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Torn { address } => {
                write!(
                    f,
                    "the configuration is damaged: flash at {address:08X} cannot be read; flash it again"
                )
            }
        }
    }
}

/// The image; if there is no header of an image, only the first flash word.
pub(super) fn read() -> Result<&'static [u8], StorageError> {
    let start = &raw const _config_start;
    check(start.addr(), FLASH_WORD)?;
    // SAFETY: `start` is the address of a flash word that was just found readable. The program never writes to this
    // sector.
    let header = unsafe { core::slice::from_raw_parts(start, FLASH_WORD) };
    let len = image_len(header).map_or(FLASH_WORD, |len| len.clamp(HEADER, MAX_IMAGE));
    check(start.addr(), len)?;
    // SAFETY: `len` bytes from `start` were found readable, and the program never writes to this sector. They are
    // within its region, because `len` is at most `MAX_IMAGE`, which is less than the region.
    Ok(unsafe { core::slice::from_raw_parts(start, len) })
}

/// Checks that all flash words of a range can be read.
fn check(start: usize, len: usize) -> Result<(), StorageError> {
    (start..start + len)
        .step_by(FLASH_WORD)
        .try_for_each(|address| if can_read(address) { Ok(()) } else { Err(StorageError::Torn { address }) })
}
