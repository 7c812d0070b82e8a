//! Files and symbolic links that are created atomically: under a temporary name in the same folder, and then renamed.
//!
//! Does not know their contents. The caller decides whether an existing one may be replaced.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

/// A file or link under its temporary name; removed if dropped before it was moved to its place.
#[derive(Debug)]
pub struct Beside {
    name: PathBuf,
    moved: bool,
}

impl Beside {
    /// Calls `make` with an unused name in the folder of `place`.
    ///
    /// # Errors
    /// Those of `make`, which must refuse a name in use with [`io::ErrorKind::AlreadyExists`].
    pub fn make<T>(place: &Path, make: impl Fn(&Path) -> io::Result<T>) -> io::Result<(Self, T)> {
        let mut left = MAX_NAMES;
        loop {
            let nth = NEXT.fetch_add(1, Relaxed);
            let name = place.with_file_name(format!(".host-sim-{}-{nth}", std::process::id()));
            match make(&name) {
                // Left by a killed run.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists && left > 0 => left -= 1,
                made => return made.map(|made| (Self { name, moved: false }, made)),
            }
        }
    }

    /// A new file with this content, opened for reading and writing.
    ///
    /// # Errors
    /// As [`Beside::make`], or if the bytes cannot be written.
    pub fn file(place: &Path, bytes: &[u8]) -> io::Result<(Self, fs::File)> {
        let new = |name: &Path| fs::File::options().read(true).write(true).create_new(true).open(name);
        let (beside, mut file) = Self::make(place, new)?;
        io::Write::write_all(&mut file, bytes)?;
        Ok((beside, file))
    }

    /// The temporary name.
    pub fn name(&self) -> &Path {
        &self.name
    }

    /// Moves the file to `place`, where nothing may exist.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] if something exists.
    pub fn put_new(mut self, place: &Path) -> io::Result<()> {
        match renameat_with(CWD, &self.name, CWD, place, RenameFlags::NOREPLACE) {
            // Not every file system can check and rename in one step.
            Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) => {
                if fs::symlink_metadata(place).is_ok() {
                    return Err(io::ErrorKind::AlreadyExists.into());
                }
                fs::rename(&self.name, place)?;
            }
            renamed => renamed?,
        }
        self.moved = true;
        Ok(())
    }

    /// Moves the file to `place` and replaces the file or link there.
    ///
    /// # Errors
    /// If the file cannot be moved, such as to the path of a folder.
    pub fn replace(mut self, place: &Path) -> io::Result<()> {
        fs::rename(&self.name, place)?;
        self.moved = true;
        Ok(())
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        if !self.moved {
            let _ = fs::remove_file(&self.name);
        }
    }
}

/// Reads at most `max` bytes of a file that only its owner may access, such as a key.
///
/// # Errors
/// If it is not a regular file, others may read or write it, it cannot be read, or is not UTF-8. No error repeats its
/// contents.
pub fn read_private(path: &Path, max: u64) -> io::Result<String> {
    use std::os::unix::fs::MetadataExt;
    let file = fs::File::open(path)?;
    // Check the opened file: its path may lead to another file by now.
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    if metadata.mode() & 0o077 != 0 {
        let mode = metadata.mode() & 0o777;
        return Err(io::Error::other(format!("others may use it, its mode is {mode:04o}; chmod 0600 it")));
    }
    let mut text = String::new();
    io::Read::read_to_string(&mut io::Read::take(file, max), &mut text)?;
    Ok(text)
}

/// The identity of a file or link. A file that was deleted and created again has another identity, as long as the first
/// is open or linked elsewhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    device: u64,
    inode: u64,
}

impl Identity {
    /// Device and inode number.
    pub fn of(metadata: &fs::Metadata) -> Self {
        use std::os::unix::fs::MetadataExt;
        Self { device: metadata.dev(), inode: metadata.ino() }
    }
}

static NEXT: AtomicU32 = AtomicU32::new(0);
/// Maximum number of names to try: a killed process may have had the same process id and left files.
const MAX_NAMES: u32 = 100;

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn an_existing_file_is_replaced_only_on_request() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("place");
        let make = |text: &str| Beside::file(&place, text.as_bytes()).unwrap().0;
        make("first").put_new(&place).unwrap();
        let error = make("second").put_new(&place).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read(&place).unwrap(), b"first");
        make("third").replace(&place).unwrap();
        assert_eq!(fs::read(&place).unwrap(), b"third");
        assert_eq!(names(folder.path()), ["place"], "nothing stays beside it");
    }

    #[test]
    fn what_could_not_be_moved_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("place");
        fs::create_dir(&place).unwrap();
        let (beside, _file) = Beside::file(&place, b"text").unwrap();
        assert_eq!(names(folder.path()).len(), 2);
        beside.replace(&place).unwrap_err();
        drop(Beside::file(&place, b"text").unwrap());
        assert_eq!(names(folder.path()), ["place"]);
    }

    #[test]
    fn names_left_by_a_killed_run_are_skipped() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("place");
        let taken = std::cell::Cell::new(3);
        let (beside, ()) = Beside::make(&place, |name| match taken.get() {
            0 => fs::write(name, "mine"),
            left => {
                taken.set(left - 1);
                Err(io::ErrorKind::AlreadyExists.into())
            }
        })
        .unwrap();
        beside.put_new(&place).unwrap();
        let always = |_: &Path| -> io::Result<()> { Err(io::ErrorKind::AlreadyExists.into()) };
        assert_eq!(Beside::make(&place, always).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
    }
}
