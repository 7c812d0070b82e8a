//! `--console-key FILE`: the key, in a file that nobody else can read.

use std::path::Path;

use recipe_api::key::Key;
use recipe_io::files::read_private;

use crate::RunError;

/// Reads a key: 32 hexadecimal digits and a line end.
///
/// # Errors
/// If the file cannot be read, others may read it, or it holds anything else.
pub fn read_key(path: &Path) -> Result<Key, RunError> {
    let refused =
        |why: &dyn std::fmt::Display| RunError::new(format!("--console-key {}: {why}", path.display()));
    let text = read_private(path, 100).map_err(|error| refused(&error))?;
    // Do not repeat the contents: a mistyped key is almost the key.
    Key::parse(text.trim_end()).ok_or_else(|| {
        refused(&"not 32 hexadecimal digits; `(umask 077; openssl rand -hex 16 > FILE)` makes a key")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_key_is_its_owners_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        let write = |text: &str, mode| {
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            read_key(&path).map(|_| ()).map_err(|error| error.to_string())
        };
        let key = "00112233445566778899aabbccddeeff\n";
        assert_eq!(write(key, 0o600), Ok(()));
        assert_eq!(write(key, 0o400), Ok(()));
        for mode in [0o640, 0o604, 0o620, 0o601] {
            let error = write(key, mode).unwrap_err();
            assert!(error.contains(&format!("its mode is {mode:04o}")), "{error}");
        }
        for wrong in ["", "0011", &key[1..], &format!("{key}x"), &"0".repeat(32)] {
            let error = write(wrong, 0o600).unwrap_err();
            assert!(error.contains("not 32 hexadecimal digits"), "{error}");
            assert!(wrong.len() < 3 || !error.contains(wrong.trim()), "{error}");
        }
        assert!(read_key(folder.path()).is_err());
        assert!(read_key(&folder.path().join("none")).is_err());
    }
}
