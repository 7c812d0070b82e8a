//! The symbolic link by which other programs find a pseudoterminal.
//!
//! A link belongs to the process that created it, as long as that process runs. The process holds a lock on a file
//! beside the link, `.NAME.lock`, which the kernel releases however the process ends. The file says which link was
//! created. This distinguishes a link left by a killed run from a link still in use, even if another program has the
//! terminal's number now.

use std::fs;
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, symlink};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, OFlags, flock};

use crate::files::{Beside, Identity};

/// A link to a pseudoterminal; removed when dropped, if it is still the one that was created.
#[derive(Debug)]
pub(super) struct Symlink {
    path: PathBuf,
    made: Made,
    /// Released after the link has been removed.
    _lock: Lock,
}

impl Symlink {
    /// Creates a link to `target` at `path`, and the folder if it does not exist.
    ///
    /// # Errors
    /// With the path in the message: the folder cannot be created, or the path holds something other than a link that
    /// is no longer in use.
    pub(super) fn create(path: &Path, target: &Path) -> io::Result<Self> {
        let create = || -> io::Result<Self> {
            path.parent().map_or(Ok(()), fs::create_dir_all)?;
            let mut lock = Lock::take(path)?;
            let is_free = is_free(path, lock.left)?;
            let (beside, ()) = Beside::make(path, |name| symlink(target, name))?;
            let made = Made::of(&fs::symlink_metadata(beside.name())?);
            lock.record(made)?;
            if is_free {
                beside.put_new(path)?
            } else {
                beside.replace(path)?
            }
            Ok(Self { path: path.to_owned(), made, _lock: lock })
        };
        create().map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Symlink {
    fn drop(&mut self) {
        if fs::symlink_metadata(&self.path).is_ok_and(|there| Made::of(&there) == self.made) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Whether nothing is at `path`; `false` for a link that may be replaced, an error for anything else. `left` is the
/// link that the last run left there.
fn is_free(path: &Path, left: Option<Made>) -> io::Result<bool> {
    let refused = |message: String| Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
    let found = match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(true),
        found => found?,
    };
    let target = if found.is_symlink() { fs::read_link(path)? } else { PathBuf::new() };
    if !target.starts_with("/dev/pts") {
        return refused(
            "this exists and is not a link to a pseudoterminal; give another path or remove it".to_owned(),
        );
    }
    if left == Some(Made::of(&found)) {
        return Ok(false);
    }
    match fs::symlink_metadata(&target) {
        // A pseudoterminal disappears with the program that opened it.
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        _ => refused(format!(
            "a link to {}, which a program has open; give another path or end that program; if \
             it does not use this link, remove the link",
            target.display()
        )),
    }
}

/// The lock of a path.
#[derive(Debug)]
struct Lock {
    path: PathBuf,
    file: fs::File,
    /// The link that the last holder created and did not remove.
    left: Option<Made>,
}

impl Lock {
    fn take(link: &Path) -> io::Result<Self> {
        let Some(name) = link.file_name() else {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "not the name of a link"));
        };
        let mut hidden = std::ffi::OsString::from(".");
        hidden.push(name);
        hidden.push(".lock");
        let path = link.with_file_name(hidden);
        for _ in 0..MAX_TRIES {
            let mut file = fs::File::options()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .custom_flags(OFlags::NOFOLLOW.bits().cast_signed())
                .open(&path)
                .map_err(|error| named(&path, &error))?;
            let mut text = String::new();
            let read = |file: &mut fs::File, text: &mut String| file.take(MAX_RECORD).read_to_string(text);
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(rustix::io::Errno::WOULDBLOCK) => {
                    let _ = read(&mut file, &mut text);
                    return Err(in_use(LinkRecord::parse(&text)));
                }
                Err(error) => return Err(named(&path, &error.into())),
            }
            // The last holder may have removed the file since it was opened.
            let own = Identity::of(&file.metadata()?);
            if !fs::symlink_metadata(&path).is_ok_and(|there| Identity::of(&there) == own) {
                continue;
            }
            let is_text = read(&mut file, &mut text).is_ok();
            let record = LinkRecord::parse(&text);
            if !is_text || (record.is_none() && !text.is_empty()) {
                let what = "the lock of the link cannot be created: another file is there; give another path";
                return Err(named(&path, &io::Error::new(io::ErrorKind::AlreadyExists, what)));
            }
            return Ok(Self { path, file, left: record.map(|record| record.made) });
        }
        Err(in_use(None))
    }

    /// Records the identity of the link before the link is moved to its place, so no link is ever unknown.
    fn record(&mut self, made: Made) -> io::Result<()> {
        let record = LinkRecord { process: std::process::id(), made };
        self.file.rewind()?;
        self.file.set_len(0)?;
        self.file.write_all(record.to_line().as_bytes())
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Removed while the lock is held: the next holder creates a new file.
        let _ = fs::remove_file(&self.path);
    }
}

fn named(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

fn in_use(holder: Option<LinkRecord>) -> io::Error {
    let message = match holder {
        Some(LinkRecord { process, .. }) if process == std::process::id() => {
            "another port uses this path; give each port its own path".to_owned()
        }
        Some(LinkRecord { process, .. }) => {
            format!("another run of host-sim uses this path, process {process}; end it or give another path")
        }
        None => "another run of host-sim uses this path; end it or give another path".to_owned(),
    };
    io::Error::new(io::ErrorKind::ResourceBusy, message)
}

/// The content of a lock file: the holder, and the link that it created.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LinkRecord {
    process: u32,
    made: Made,
}

impl LinkRecord {
    fn to_line(self) -> String {
        let Self { process, made: Made { inode, seconds, nanos } } = self;
        format!("{WORD} {process} {inode} {seconds} {nanos}\n")
    }

    /// `None` if no run wrote this.
    fn parse(text: &str) -> Option<Self> {
        let words: Vec<_> = text.strip_suffix('\n')?.split(' ').collect();
        let [WORD, process, inode, seconds, nanos] = words[..] else { return None };
        let made =
            Made { inode: inode.parse().ok()?, seconds: seconds.parse().ok()?, nanos: nanos.parse().ok()? };
        Some(Self { process: process.parse().ok()?, made })
    }
}

/// The identity of a link. A link is never modified, so a different time means a different link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Made {
    inode: u64,
    seconds: i64,
    nanos: i64,
}

impl Made {
    fn of(link: &fs::Metadata) -> Self {
        Self { inode: link.ino(), seconds: link.mtime(), nanos: link.mtime_nsec() }
    }
}

const WORD: &str = "host-sim";
/// Maximum length of a record, bytes.
const MAX_RECORD: u64 = 256;
const MAX_TRIES: usize = 100;

#[cfg(test)]
mod tests {
    use super::*;

    /// A terminal of another program; it exists until the descriptor is dropped.
    fn terminal() -> (std::os::fd::OwnedFd, PathBuf) {
        let master =
            rustix::pty::openpt(rustix::pty::OpenptFlags::RDWR | rustix::pty::OpenptFlags::NOCTTY).unwrap();
        let name = rustix::pty::ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
        (master, name.into())
    }

    /// The name of a terminal that is gone. A low number would soon be in use.
    const GONE: &str = "/dev/pts/4000000";

    /// Replaces the link at `path` by one of another program.
    fn put_another(path: &Path, target: &Path) {
        let made = || Made::of(&fs::symlink_metadata(path).unwrap());
        let before = made();
        // The file system's clock may not have advanced yet.
        while made() == before {
            fs::remove_file(path).unwrap();
            symlink(target, path).unwrap();
        }
    }

    fn place() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("line");
        (folder, path)
    }

    fn count(path: &Path) -> usize {
        fs::read_dir(path.parent().unwrap()).unwrap().count()
    }

    /// Leaves what a killed run leaves: the lock is released, and nothing is removed.
    fn kill(link: Symlink) {
        flock(&link._lock.file, FlockOperation::Unlock).unwrap();
        std::mem::forget(link);
    }

    #[test]
    fn a_link_belongs_to_one_run_and_is_removed_with_it() {
        let (_folder, path) = place();
        let (_terminal, name) = terminal();
        let link = Symlink::create(&path, &name).unwrap();
        assert_eq!((link.path(), fs::read_link(&path).unwrap()), (&*path, name.clone()));
        let message = Symlink::create(&path, &name).unwrap_err().to_string();
        assert_eq!(
            message,
            format!("{}: another port uses this path; give each port its own path", path.display())
        );
        // Even after it was removed from outside.
        fs::remove_file(&path).unwrap();
        Symlink::create(&path, &name).unwrap_err();
        drop(link);
        drop(Symlink::create(&path, &name).unwrap());
        assert_eq!(count(&path), 0);
    }

    #[test]
    fn a_link_left_by_a_killed_run_is_replaced_even_if_its_terminals_number_is_in_use() {
        let (_folder, path) = place();
        let (_another, name) = terminal();
        for target in [&*name, Path::new(GONE)] {
            kill(Symlink::create(&path, target).unwrap());
            let (_own, own) = terminal();
            let link = Symlink::create(&path, &own).unwrap();
            assert_eq!(fs::read_link(&path).unwrap(), own);
            drop(link);
            assert_eq!(count(&path), 0);
        }
    }

    #[test]
    fn a_link_of_a_running_program_stays() {
        let (_folder, path) = place();
        let (_another, name) = terminal();
        // It has the terminal's number of a killed run, but the link is another one.
        kill(Symlink::create(&path, &name).unwrap());
        put_another(&path, &name);
        let message = Symlink::create(&path, Path::new(GONE)).unwrap_err().to_string();
        let expected =
            format!("{}: a link to {}, which a program has open; ", path.display(), name.display());
        assert!(message.starts_with(&expected), "{message}");
        assert_eq!((fs::read_link(&path).unwrap(), count(&path)), (name, 1));
    }

    #[test]
    fn a_link_of_a_program_that_is_gone_is_replaced() {
        let (_folder, path) = place();
        symlink(GONE, &path).unwrap();
        let (_terminal, name) = terminal();
        let link = Symlink::create(&path, &name).unwrap();
        assert_eq!(fs::read_link(&path).unwrap(), name);
        // Another program's is not removed, not even one to the same terminal.
        put_another(&path, &name);
        drop(link);
        assert_eq!((fs::read_link(&path).unwrap(), count(&path)), (name, 1));
    }

    #[test]
    fn anything_else_at_the_path_or_in_place_of_the_lock_stays() {
        let (_folder, path) = place();
        let refused = || Symlink::create(&path, Path::new(GONE)).unwrap_err().to_string();
        fs::write(&path, "precious").unwrap();
        assert!(refused().contains("line: this exists and is not a link"), "{}", refused());
        assert_eq!((fs::read(&path).unwrap().as_slice(), count(&path)), (&b"precious"[..], 1));
        fs::remove_file(&path).unwrap();
        symlink("/dev/null", &path).unwrap();
        assert!(refused().contains("this exists and is not a link"));
        assert_eq!(fs::read_link(&path).unwrap(), Path::new("/dev/null"));
        fs::remove_file(&path).unwrap();
        let lock = path.with_file_name(".line.lock");
        for other in [&b"precious"[..], b"\xFF", b"host-sim 1 2 3\n", &[b' '; 1 << 10]] {
            fs::write(&lock, other).unwrap();
            assert!(
                refused().contains(".line.lock: the lock of the link cannot be created"),
                "{}",
                refused()
            );
            assert_eq!((fs::read(&lock).unwrap().as_slice(), count(&path)), (other, 1));
        }
    }

    #[test]
    fn records_are_read_as_they_were_written() {
        let record = LinkRecord { process: 7, made: Made { inode: 8, seconds: -9, nanos: 10 } };
        assert_eq!(LinkRecord::parse(&record.to_line()), Some(record));
        for other in [
            "",
            "\n",
            "host-sim 7 8 9 10",
            "host-sim 7 8 9 10 11\n",
            "other 7 8 9 10\n",
            "host-sim 7 8 9 x\n",
        ] {
            assert_eq!(LinkRecord::parse(other), None, "{other:?}");
        }
    }
}
