//! Files with the keys for signing firmware: 64 hexadecimal digits each. Only the owner can read the private key.

use std::ffi::OsString;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use recipe_api::key::{Hex, from_hex};
use recipe_io::random::random;
use recipe_update::PublicKey;

use crate::digits::{self, MAX_FILE, exists, write_new, wrong};
use crate::failure::Failure;

/// A private key. It is never shown, not even in debug output.
pub(crate) struct Seed(pub(crate) [u8; 32]);

/// Makes a key pair: the private key in a new file of mode 0600, the public key in another file whose name ends in
/// `.pub`. Returns the digits of the public key, and the name of its file.
pub fn make(path: &Path) -> Result<(String, PathBuf), Failure> {
    let public_path = beside(path);
    // Checked first: a private key without its public key would have to be deleted by hand.
    if public_path.exists() {
        return Err(exists(&public_path));
    }
    let seed = random().map(Seed).map_err(|error| wrong(path, &error))?;
    let public = Hex(&PublicKey::of_seed(&seed.0).bytes()).to_string();
    write_new(path, &Hex(&seed.0).to_string(), 0o600)?;
    write_new(&public_path, &public, 0o644)?;
    Ok((public, public_path))
}

pub(crate) fn read(path: &Path) -> Result<Seed, Failure> {
    from_hex(&digits::read(path)?).map(Seed).ok_or_else(|| {
        wrong(path, &"not 64 hexadecimal digits; `host-sim ctl keygen --signing FILE` makes a key")
    })
}

pub(crate) fn read_public(path: &Path) -> Result<PublicKey, Failure> {
    let mut text = String::new();
    let file = File::open(path).and_then(|file| file.take(MAX_FILE).read_to_string(&mut text));
    file.map_err(|error| wrong(path, &error))?;
    from_hex(text.trim_end())
        .as_ref()
        .and_then(PublicKey::parse)
        .ok_or_else(|| wrong(path, &"not a public key: 64 hexadecimal digits of a file that ends in .pub"))
}

/// The name of the file with the public key.
fn beside(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".pub");
    name.into()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{MetadataExt, PermissionsExt};

    use super::*;

    #[test]
    fn a_new_key_is_its_owners_alone_and_never_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("signing.key");
        let (digits, public_path) = make(&path).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        assert_eq!(public_path, folder.path().join("signing.key.pub"));
        assert_eq!(std::fs::read_to_string(&public_path).unwrap(), format!("{digits}\n"));
        let seed = read(&path).unwrap();
        assert_eq!(read_public(&public_path).unwrap(), PublicKey::of_seed(&seed.0));
        let before = std::fs::read(&path).unwrap();
        let error = make(&path).unwrap_err();
        assert!(error.message().contains("keys are not replaced"), "{error:?}");
        std::fs::remove_file(&public_path).unwrap();
        assert!(make(&path).is_err());
        assert_eq!(std::fs::read(&path).unwrap(), before);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing stays beside it");
    }

    #[test]
    fn a_key_that_is_none_is_refused_and_never_shown() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("signing.key");
        make(&path).unwrap();
        let digits = std::fs::read_to_string(&path).unwrap();
        for wrong in ["", &digits[1..], &format!("0{digits}"), &digits.replace(['a', '3', '7'], "x")] {
            std::fs::write(&path, wrong).unwrap();
            let error = read(&path).err().unwrap();
            assert!(error.message().contains("not 64 hexadecimal digits"), "{error:?}");
            assert!(!error.message().contains(&digits[40..60]), "{error:?}");
        }
        std::fs::write(&path, &digits).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(read(&path).err().unwrap().message().contains("its mode is 0644"));
        // A point that is not on the curve.
        std::fs::write(&path, format!("{:0<64}\n", "02")).unwrap();
        assert!(read_public(&path).unwrap_err().message().contains("not a public key"));
    }
}
