//! The revisions of a configuration as files: `--console-state DIR`.
//!
//! `revisions.json` lists the revisions and says which one is live. It is replaced atomically, after the texts that it
//! names are on the disk and before texts that it no longer names are removed, so it is correct at any time, even after
//! a power failure.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use recipe_api::key::{BodyHash, Hash, Hex};
use recipe_api::revisions::{MAX_REVISIONS, Revision, Revisions, Stored};
use recipe_io::files::Beside;
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};

use crate::RunError;

#[derive(Debug)]
pub(super) struct RevisionStore {
    folder: Option<StoreFolder>,
    index: Index,
    texts: BTreeMap<u32, Arc<str>>,
    /// The revision of the file that the process was started with, not written yet, and the revision that it replaces.
    started_with: Option<(u32, Option<u32>)>,
}

#[derive(Debug)]
struct StoreFolder {
    path: PathBuf,
    /// Held locked: only one process may use a folder.
    _lock: File,
}

/// `revisions.json`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Index {
    live: u32,
    #[serde(default)]
    previous: Option<u32>,
    /// Hash of the file that the process was started with when the live revision became live.
    file: String,
    kept: Vec<RevisionEntry>,
}

/// Metadata of a revision.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct RevisionEntry {
    pub(super) number: u32,
    /// When it was stored, in seconds since 1970.
    pub(super) stored_at: u64,
    /// Its origin: the address of a client, or the name of a file.
    pub(super) from: String,
}

impl RevisionStore {
    /// Opens the store of a folder, or one in memory. If the file that the process was started with has changed, a
    /// person has edited it: it becomes the newest revision, and live.
    pub(super) fn open(path: Option<&Path>, file: (&str, &str)) -> Result<Self, RunError> {
        let mut store =
            Self { folder: None, index: Index::default(), texts: BTreeMap::new(), started_with: None };
        if let Some(path) = path {
            let refused = |why: &dyn std::fmt::Display| {
                RunError::new(format!("--console-state {}: {why}", path.display()))
            };
            let lock = lock(path).map_err(|error| match error.kind() {
                io::ErrorKind::WouldBlock => refused(&"another process uses this folder"),
                _ => refused(&error),
            })?;
            store.folder = Some(StoreFolder { path: path.to_owned(), _lock: lock });
            store.read().map_err(|error| refused(&error))?;
        }
        let (name, text) = file;
        let digest = Hex(&hash(text)).to_string();
        if store.index.file != digest || store.index.kept.is_empty() {
            let number = store.index.kept.last().map_or(1, |entry| entry.number + 1);
            let needed = [Some(store.index.live), store.index.previous];
            let numbers: Vec<u32> = store.index.kept.iter().map(|entry| entry.number).collect();
            let unneeded = numbers.iter().copied().find(|&number| !needed.contains(&Some(number)));
            let forget = unneeded.filter(|_| numbers.len() >= MAX_REVISIONS);
            let before = numbers.contains(&store.index.live).then_some(store.index.live);
            let mut index = store.with(number, name, forget);
            (index.live, index.previous, index.file) = (number, before, digest);
            store.index = index;
            store.texts.insert(number, text.into());
            forget.inspect(|forget| drop(store.texts.remove(forget)));
            store.started_with = Some((number, forget));
        }
        Ok(store)
    }

    /// Writes the revision of the file that the process was started with. Called once the gateway has started: a
    /// revision that does not start replaces none.
    pub(super) fn has_started(&mut self) -> Result<(), RunError> {
        let Some((number, forget)) = self.started_with.take() else { return Ok(()) };
        let text = self.texts.get(&number).cloned().unwrap_or_default();
        let written = self.put(number, &text, forget, self.index.clone());
        written.map_err(|error| RunError::new(format!("--console-state: {error}")))
    }

    pub(super) fn revisions(&self) -> Option<Revisions> {
        let mut kept = proto_core::heapless::Vec::new();
        for entry in &self.index.kept {
            kept.push(self.revision(entry.number)?).ok()?;
        }
        Revisions::new(Stored { kept, live: self.index.live, previous: self.index.previous })
    }

    /// Metadata of the revisions, the oldest first.
    pub(super) fn entries(&self) -> &[RevisionEntry] {
        &self.index.kept
    }

    pub(super) fn text(&self, number: u32) -> Option<&Arc<str>> {
        self.texts.get(&number)
    }

    pub(super) fn texts(&self) -> &BTreeMap<u32, Arc<str>> {
        &self.texts
    }

    fn revision(&self, number: u32) -> Option<Revision> {
        Some(Revision { number, digest: digest(self.text(number)?) })
    }

    pub(super) fn keep(
        &mut self,
        number: u32,
        text: &str,
        from: &str,
        forget: Option<u32>,
    ) -> io::Result<()> {
        let index = self.with(number, from, forget);
        self.put(number, text, forget, index)
    }

    pub(super) fn mark(&mut self, live: u32, previous: u32) -> io::Result<()> {
        let index = Index { live, previous: Some(previous), ..self.index.clone() };
        self.write_index(&index)?;
        self.index = index;
        Ok(())
    }

    /// The index with a new revision, and without revision `forget`.
    fn with(&self, number: u32, from: &str, forget: Option<u32>) -> Index {
        let mut index = self.index.clone();
        index.kept.retain(|entry| Some(entry.number) != forget);
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let stored_at = since.map_or(0, |since| since.as_secs());
        index.kept.push(RevisionEntry { number, stored_at, from: from.to_owned() });
        index
    }

    fn put(&mut self, number: u32, text: &str, forget: Option<u32>, index: Index) -> io::Result<()> {
        if let Some(folder) = &self.folder {
            folder.replace(&name(number), text.as_bytes())?;
        }
        self.write_index(&index)?;
        self.index = index;
        self.texts.insert(number, text.into());
        if let Some(forget) = forget {
            self.texts.remove(&forget);
            if let Some(folder) = &self.folder {
                // A file that remains is removed at the next start.
                let _ = fs::remove_file(folder.path.join(name(forget)));
            }
        }
        Ok(())
    }

    fn write_index(&self, index: &Index) -> io::Result<()> {
        match &self.folder {
            Some(folder) => folder.replace(INDEX, &serde_json::to_vec_pretty(index)?),
            None => Ok(()),
        }
    }

    /// Reads the folder, and removes texts that the index does not name.
    fn read(&mut self) -> io::Result<()> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let index = match fs::read(folder.path.join(INDEX)) {
            Ok(bytes) => {
                serde_json::from_slice(&bytes).map_err(|error| wrong(format!("{INDEX}: {error}")))?
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Index::default(),
            Err(error) => return Err(error),
        };
        let Index { kept, live, .. } = &index;
        let is_rising = kept.is_sorted_by(|one, next| one.number < next.number);
        // The next revision needs a number too.
        let is_last = kept.last().is_some_and(|last| last.number == u32::MAX);
        if kept.len() > MAX_REVISIONS || !is_rising || is_last {
            return Err(wrong(format!(
                "{INDEX}: not a list of at most {MAX_REVISIONS} rising numbers below {}",
                u32::MAX
            )));
        }
        if !kept.is_empty() && kept.iter().all(|entry| entry.number != *live) {
            return Err(wrong(format!("{INDEX}: the live revision {live} is not kept")));
        }
        for entry in kept {
            let name = name(entry.number);
            let text = fs::read_to_string(folder.path.join(&name));
            let text = text.map_err(|error| wrong(format!("{name}: {error}")))?;
            self.texts.insert(entry.number, text.into());
        }
        for entry in fs::read_dir(&folder.path)? {
            let path = entry?.path();
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or("");
            let number = name.strip_prefix("revision-").and_then(|name| name.strip_suffix(".toml"));
            let number = number.and_then(|number| number.parse().ok());
            if number.is_some_and(|number: u32| !self.texts.contains_key(&number)) {
                fs::remove_file(&path)?;
            }
        }
        self.index = index;
        Ok(())
    }
}

impl StoreFolder {
    /// Replaces a file atomically, even if the power fails.
    fn replace(&self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let place = self.path.join(name);
        let (beside, file) = Beside::file(&place, bytes)?;
        file.set_permissions(fs::Permissions::from_mode(0o600))?;
        file.sync_all()?;
        beside.replace(&place)?;
        File::open(&self.path)?.sync_all()
    }
}

/// Creates the folder if it does not exist, and locks it.
fn lock(path: &Path) -> io::Result<File> {
    fs::create_dir_all(path)?;
    let lock = File::options().create(true).truncate(false).write(true).open(path.join("lock"))?;
    flock(&lock, FlockOperation::NonBlockingLockExclusive)?;
    Ok(lock)
}

fn name(number: u32) -> String {
    format!("revision-{number}.toml")
}

fn wrong(message: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, message)
}

fn hash(text: &str) -> Hash {
    let mut hash = BodyHash::new();
    hash.update(text.as_bytes());
    hash.finish()
}

/// The beginning of a text's hash, which tells revisions of the same number apart.
pub(super) fn digest(text: &str) -> u32 {
    hash(text).first_chunk().map_or(0, |bytes| u32::from_be_bytes(*bytes))
}

const INDEX: &str = "revisions.json";

#[cfg(test)]
#[path = "store_tests.rs"]
mod tests;
