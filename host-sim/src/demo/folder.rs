//! The temporary folder with the links to the demo's pseudoterminals.

use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A temporary folder, removed with its content when it is dropped.
#[derive(Debug)]
pub(super) struct TempFolder(Arc<Owned>);

/// Removes the folder earlier.
#[derive(Debug)]
pub(super) struct Remover(Arc<Owned>);

#[derive(Debug)]
struct Owned {
    path: PathBuf,
    /// Held while something is made in the folder, and while it is removed.
    making: Mutex<()>,
}

impl TempFolder {
    /// Makes a folder in the system's folder for temporary files.
    pub(super) fn new() -> io::Result<Self> {
        Self::within(&std::env::temp_dir())
    }

    fn within(folder: &Path) -> io::Result<Self> {
        let mut nth = 0;
        loop {
            let path = folder.join(format!("host-sim-demo-{}-{nth}", std::process::id()));
            match std::fs::DirBuilder::new().mode(0o700).create(&path) {
                // It belongs to another process, or to one that was killed.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists && nth < MOST_NAMES => nth += 1,
                made => return made.map(|()| Self(Arc::new(Owned { path, making: Mutex::new(()) }))),
            }
        }
    }

    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.0.path.join(name)
    }

    /// Calls `make` to make something in the folder.
    pub(super) fn fill<T>(&self, make: impl FnOnce() -> T) -> T {
        let _making = self.0.lock();
        make()
    }

    pub(super) fn remover(&self) -> Remover {
        Remover(Arc::clone(&self.0))
    }
}

impl Drop for TempFolder {
    fn drop(&mut self) {
        let _making = self.0.lock();
        self.0.remove();
    }
}

impl Remover {
    /// Removes the folder and ends the process. Nothing is made in the folder in between.
    pub(super) fn remove_and_exit(&self, code: i32) -> ! {
        let _making = self.0.lock();
        self.0.remove();
        std::process::exit(code)
    }
}

impl Owned {
    fn lock(&self) -> MutexGuard<'_, ()> {
        self.making.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn remove(&self) {
        // Can fail once if links are removed at the same time.
        for _ in 0..MOST_TRIES {
            match std::fs::remove_dir_all(&self.path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {}
                _ => return,
            }
        }
    }
}

const MOST_NAMES: u32 = 100;
const MOST_TRIES: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_nobody_elses_and_goes_with_everything_in_it() {
        let among = tempfile::tempdir().unwrap();
        let names = || std::fs::read_dir(among.path()).unwrap().count();
        let left = format!("host-sim-demo-{}-0", std::process::id());
        std::fs::create_dir(among.path().join(left)).unwrap();
        let (first, second) =
            (TempFolder::within(among.path()).unwrap(), TempFolder::within(among.path()).unwrap());
        std::fs::write(first.path("line"), "").unwrap();
        assert_eq!(names(), 3);
        let _remover = first.remover();
        drop((first, second));
        assert_eq!(names(), 1, "what others left is theirs");
    }
}
