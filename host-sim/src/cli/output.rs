//! Files that commands write: never over a file that they are made from, nor over one that nobody meant.

use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use recipe_io::files::{Beside, Identity};

/// What a command writes.
pub(super) struct OutputFile<'a> {
    /// The bytes.
    pub bytes: &'a [u8],
    /// In messages: "the image" or "it".
    pub name: &'a str,
    /// The file that it is made from, if it is made from one.
    pub made_from: Option<&'a Path>,
}

impl OutputFile<'_> {
    /// Writes it to a new file, a pipe or a device, or in place of a file that `may_be_replaced`; `kept` says
    /// what such a file is otherwise.
    pub(super) fn put(
        &self,
        path: &Path,
        may_be_replaced: impl FnOnce() -> io::Result<bool>,
        kept: &str,
    ) -> io::Result<()> {
        let refused = |message: &str| Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
        let found = match fs::metadata(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                if path.is_symlink() {
                    return refused("a link to a file that does not exist; give another name");
                }
                return Beside::file(path, self.bytes)?.0.put_new(path);
            }
            found => found?,
        };
        let kind = found.file_type();
        if kind.is_char_device() || kind.is_fifo() {
            // A pipe or a device: nothing is replaced.
            return fs::File::options().write(true).open(path)?.write_all(self.bytes);
        }
        if kind.is_dir() {
            return refused("a folder; give the name of a file in it");
        }
        if !kind.is_file() {
            return refused("not a regular file; give another name");
        }
        let source = self.made_from.map(fs::metadata).transpose()?;
        if source.is_some_and(|source| Identity::of(&found) == Identity::of(&source)) {
            return refused(&format!("this is the file that {} is made from; give another name", self.name));
        }
        if !may_be_replaced()? {
            return refused(&format!("this file exists{kept}; give another name or --force"));
        }
        // Replace the target of a symbolic link, not the link.
        let place = fs::canonicalize(path)?;
        Beside::file(&place, self.bytes)?.0.replace(&place)
    }
}
