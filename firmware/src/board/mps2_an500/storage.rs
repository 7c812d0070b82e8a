//! The configuration image: a file of the host, named by the second semihosting argument
//! (`-semihosting-config ...,arg=firmware,arg=PATH`).

use core::fmt;

use proto_core::config::image::MAX_IMAGE;
use semihosting::experimental::time::SystemTime;
use semihosting::fs::File;
use semihosting::io::Read;
use static_cell::ConstStaticCell;

use super::arguments::{FileName, argument};

/// Why there is no image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StorageError {
    /// No file was named.
    NoName,
    /// The file cannot be read.
    Unreadable,
}

impl fmt::Display for StorageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoName => f.write_str("no configuration: give its path as the second semihosting argument"),
            Self::Unreadable => {
                f.write_str("cannot read the configuration file")?;
                // Include the name of the file, which tells the user what to look for.
                argument(1, |path| write!(f, " {path}")).unwrap_or(Ok(()))
            }
        }
    }
}

pub(super) fn read() -> Result<&'static [u8], StorageError> {
    static IMAGE: ConstStaticCell<[u8; MAX_IMAGE]> = ConstStaticCell::new([0; MAX_IMAGE]);
    let name = FileName::argument(1).ok_or(StorageError::NoName)?;
    let mut file = File::open(name.as_c_str()).map_err(|_| StorageError::Unreadable)?;
    let image = IMAGE.take();
    let mut len = 0;
    while let Some(buf @ [_, ..]) = image.get_mut(len..) {
        match file.read(buf) {
            Ok(0) => break,
            Ok(count) => len += count,
            Err(_) => return Err(StorageError::Unreadable),
        }
    }
    Ok(&image[..len])
}

pub(super) fn random() -> Option<[u8; 32]> {
    let mut file = File::open(c"/dev/urandom").ok()?;
    let mut bytes = [0; 32];
    let mut len = 0;
    while let Some(buf @ [_, ..]) = bytes.get_mut(len..) {
        len += file.read(buf).ok().filter(|count| *count > 0)?;
    }
    Some(bytes)
}

/// The host's clock in seconds.
pub(super) fn host_time() -> u64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |time| time.as_secs())
}
