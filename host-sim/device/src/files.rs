//! Files and links that appear at their place whole or not at all.
//!
//! Each is made under a name of its own beside its place and moved there. Nothing here knows what is in
//! them; whether something may be replaced is the caller's business.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

/// Something beside its place; removed when dropped before it was moved there.
#[derive(Debug)]
pub struct Beside {
    name: PathBuf,
    moved: bool,
}

impl Beside {
    /// Has `make` make it under a name in `place`'s folder that nothing has.
    ///
    /// # Errors
    /// Those of `make`; it must refuse a name that is taken with [`io::ErrorKind::AlreadyExists`].
    pub fn make<T>(place: &Path, make: impl Fn(&Path) -> io::Result<T>) -> io::Result<(Self, T)> {
        let mut left = MOST_NAMES;
        loop {
            let nth = NEXT.fetch_add(1, Relaxed);
            let name = place.with_file_name(format!(".host-sim-{}-{nth}", std::process::id()));
            match make(&name) {
                // A run that was killed left it.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists && left > 0 => left -= 1,
                made => return made.map(|made| (Self { name, moved: false }, made)),
            }
        }
    }

    /// A new file with this content, opened for reading and writing.
    ///
    /// # Errors
    /// As of [`Beside::make`], and when the bytes cannot be written.
    pub fn file(place: &Path, bytes: &[u8]) -> io::Result<(Self, fs::File)> {
        let new = |name: &Path| fs::File::options().read(true).write(true).create_new(true).open(name);
        let (beside, mut file) = Self::make(place, new)?;
        io::Write::write_all(&mut file, bytes)?;
        Ok((beside, file))
    }

    /// What it is called until then.
    pub fn name(&self) -> &Path {
        &self.name
    }

    /// Moves it to `place`, where nothing may be.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] when there is something.
    pub fn put_new(mut self, place: &Path) -> io::Result<()> {
        match renameat_with(CWD, &self.name, CWD, place, RenameFlags::NOREPLACE) {
            // Not every file system can look and move in one step.
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

    /// Moves it to `place`, in the stead of the file or link that is there.
    ///
    /// # Errors
    /// When it cannot be moved there, as to the place of a folder.
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

/// Which file or link it is; what has been deleted and made again is another one, as long as the first
/// is open or still there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    device: u64,
    inode: u64,
}

impl Identity {
    /// The identity that the system gives.
    pub fn of(metadata: &fs::Metadata) -> Self {
        use std::os::unix::fs::MetadataExt;
        Self { device: metadata.dev(), inode: metadata.ino() }
    }
}

static NEXT: AtomicU32 = AtomicU32::new(0);
/// Names that are tried: a process that was killed can have left some under the number that is ours now.
const MOST_NAMES: u32 = 100;

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
    fn what_is_there_is_replaced_only_when_that_is_meant() {
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
    fn names_that_a_killed_run_left_are_passed_over() {
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
