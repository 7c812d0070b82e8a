//! Files that hold the hexadecimal digits of one key, and a line end.

use std::fmt::Display;
use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use recipe_io::files::{Beside, read_private};

use crate::failure::Failure;

/// Maximum length of a file, more than a key and its line end.
pub(crate) const MAX_FILE: u64 = 100;

/// The digits of a private key. Error messages do not repeat them: a mistyped key is almost the key.
pub(crate) fn read(path: &Path) -> Result<String, Failure> {
    let mut text = read_private(path, MAX_FILE).map_err(|error| wrong(path, &error))?;
    text.truncate(text.trim_end().len());
    Ok(text)
}

/// Writes a new file atomically: it is complete and on the disk before its name exists.
pub(crate) fn write_new(path: &Path, digits: &str, mode: u32) -> Result<(), Failure> {
    let written = || {
        let new = |name: &Path| File::options().write(true).create_new(true).mode(mode).open(name);
        let (beside, mut file) = Beside::make(path, new)?;
        writeln!(file, "{digits}")?;
        file.sync_all()?;
        beside.put_new(path)
    };
    written().map_err(|error| match error.kind() {
        io::ErrorKind::AlreadyExists => exists(path),
        _ => wrong(path, &error),
    })
}

pub(crate) fn exists(path: &Path) -> Failure {
    wrong(path, &"this file exists; give another name, keys are not replaced")
}

pub(crate) fn wrong(path: &Path, why: &dyn Display) -> Failure {
    Failure::wrong(format!("the key {}: {why}", path.display()))
}
