//! Files with a key: 32 hexadecimal digits that only the owner can read.

use std::io;
use std::path::Path;

use recipe_api::key::{Hex, KEY_LEN, Key};
use recipe_io::random::random;

use crate::digits::{self, wrong};
use crate::failure::Failure;

/// Reads the key of a file.
///
/// # Errors
/// If it cannot be read, others may read it, or it holds anything else.
pub fn read(path: &Path) -> Result<Key, Failure> {
    read_with_digits(path).map(|(key, _)| key)
}

/// As [`read`], with the digits, which are sent to a board.
pub(crate) fn read_with_digits(path: &Path) -> Result<(Key, String), Failure> {
    let digits = digits::read(path)?;
    let key = Key::parse(&digits)
        .ok_or_else(|| wrong(path, &"not 32 hexadecimal digits; `host-sim ctl keygen FILE` makes a key"))?;
    Ok((key, digits))
}

/// Makes a key of 128 random bits and writes it to a new file of mode 0600. Returns the key and its digits.
///
/// # Errors
/// If the file exists or cannot be written.
pub fn make(path: &Path) -> Result<(Key, String), Failure> {
    let (key, digits) = new().map_err(|error| wrong(path, &error))?;
    digits::write_new(path, &digits, 0o600)?;
    Ok((key, digits))
}

fn new() -> io::Result<(Key, String)> {
    loop {
        let digits = Hex(&random::<KEY_LEN>()?).to_string();
        // One key of 2^124 is refused as a placeholder, such as all zeros.
        if let Some(key) = Key::parse(&digits) {
            return Ok((key, digits));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{MetadataExt, PermissionsExt};

    use super::*;

    #[test]
    fn a_new_key_is_its_owners_alone_and_never_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        let (_, digits) = make(&path).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{digits}\n"));
        read(&path).unwrap();
        let error = make(&path).unwrap_err();
        assert!(error.message().contains("keys are not replaced"), "{error:?}");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{digits}\n"));
        let (_, other) = make(&folder.path().join("other")).unwrap();
        assert_ne!(digits, other);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "nothing stays beside them");
    }

    #[test]
    fn a_key_that_others_can_read_is_refused_and_never_shown() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        let (_, digits) = make(&path).unwrap();
        for mode in [0o640, 0o604] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            let error = read(&path).unwrap_err();
            assert!(error.message().contains(&format!("its mode is {mode:04o}")), "{error:?}");
        }
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        for wrong in ["", &digits[1..], &format!("{digits}0")] {
            std::fs::write(&path, wrong).unwrap();
            let error = read(&path).unwrap_err();
            assert!(error.message().contains("not 32 hexadecimal digits"), "{error:?}");
            assert!(!error.message().contains(&digits[1..]), "{error:?}");
        }
        assert!(read(&folder.path().join("none")).is_err());
    }
}
