//! `--ready FILE`: a file with all addresses, which exists while they are open.
//!
//! It is created atomically and removed at the end. A ready file of an earlier run is removed before anything is
//! opened, so a program that waits for the file never reads an old one. Any other file stays.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde_json::Value;

use super::RunError;
use recipe_io::files::{Beside, Identity};

/// The path of a ready file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReadyFile {
    path: PathBuf,
}

impl ReadyFile {
    /// The file at `path`, which is not written yet. A ready file of an earlier run is removed.
    ///
    /// # Errors
    /// If another kind of file is there, or it could not be written.
    pub fn at(path: PathBuf) -> Result<Self, RunError> {
        let file = Self { path };
        if !file.is_free()? {
            fs::remove_file(&file.path).map_err(|error| file.refused(error))?;
        }
        // Reports a folder without write permission before anything is started.
        if file.folder().is_dir() {
            Beside::file(&file.path, b"").map_err(|error| file.refused(error))?;
        }
        Ok(file)
    }

    /// Writes the file. Dropping the result removes it.
    pub(super) fn write(&self, ready: &Value) -> Result<WrittenReadyFile, RunError> {
        let is_free = self.is_free()?;
        let text = format!("{ready}\n");
        let written = || -> io::Result<WrittenReadyFile> {
            fs::create_dir_all(self.folder())?;
            let (beside, file) = Beside::file(&self.path, text.as_bytes())?;
            match is_free {
                true => beside.put_new(&self.path)?,
                false => beside.replace(&self.path)?,
            }
            Ok(WrittenReadyFile { path: self.path.clone(), text: text.clone(), file })
        };
        written().map_err(|error| self.refused(error))
    }

    /// Whether the path is free; `false` for a ready file of an earlier run, an error for anything else.
    fn is_free(&self) -> Result<bool, RunError> {
        let refused = |message: &str| Err(self.refused(message));
        if self.path.file_name().is_none() || self.path.as_os_str().as_encoded_bytes().ends_with(b"/") {
            return refused(FOLDER);
        }
        match fs::symlink_metadata(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(true),
            Err(error) => Err(self.refused(error)),
            Ok(found) if found.is_dir() => refused(FOLDER),
            Ok(found) if !found.is_file() => refused("not a regular file; give another name"),
            Ok(found) => match read(&self.path, found.len()).map_err(|error| self.refused(error))? {
                Some(text) if is_ready(&text) => Ok(false),
                _ => refused("this file exists and was not left by a run; give another name or remove it"),
            },
        }
    }

    fn folder(&self) -> &Path {
        match self.path.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        }
    }

    fn refused(&self, why: impl std::fmt::Display) -> RunError {
        RunError::new(format!("--ready {}: {why}", self.path.display()))
    }
}

/// A written ready file. Dropping it removes the file, unless the file was changed.
#[derive(Debug)]
pub(super) struct WrittenReadyFile {
    path: PathBuf,
    text: String,
    /// Kept open, so no other file gets its inode number.
    file: fs::File,
}

impl Drop for WrittenReadyFile {
    fn drop(&mut self) {
        let own = self.file.metadata().map(|own| Identity::of(&own));
        let there = fs::symlink_metadata(&self.path).map(|there| (Identity::of(&there), there.len()));
        if let (Ok(own), Ok((there, len))) = (own, there)
            && own == there
            && read(&self.path, len).is_ok_and(|text| text.as_ref() == Some(&self.text))
        {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// The text of a file; `None` if it is not text, or too long for a ready file.
fn read(path: &Path, len: u64) -> io::Result<Option<String>> {
    if len > MAX_BYTES {
        return Ok(None);
    }
    Ok(String::from_utf8(fs::read(path)?).ok())
}

/// Whether this is the text of a ready file: an object of addresses with an object of ports, or an object of several
/// such cells. An empty file counts too: `mktemp` creates one, and nothing is lost with it.
fn is_ready(text: &str) -> bool {
    match serde_json::from_str::<Value>(text) {
        Ok(ready) => match ready.get("cells").and_then(Value::as_object) {
            Some(cells) => ready.as_object().is_some_and(|all| all.len() == 1) && cells.values().all(is_cell),
            None => is_cell(&ready),
        },
        Err(_) => text.is_empty(),
    }
}

fn is_cell(ready: &Value) -> bool {
    let addresses =
        |value: &Value| value.as_object().is_some_and(|ports| ports.values().all(Value::is_string));
    let is_address = |(key, value): (&String, &Value)| match key.as_str() {
        "ports" => addresses(value),
        _ => value.is_string(),
    };
    ready.as_object().is_some_and(|ready| ready.contains_key("ports") && ready.iter().all(is_address))
}

const FOLDER: &str = "a folder; give the name of a file in it";
const MAX_BYTES: u64 = 1 << 16;

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn place() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ready.json");
        (folder, path)
    }

    fn ready() -> Value {
        json!({ "command": "127.0.0.1:2000", "ports": { "rs485": "run/rs485" } })
    }

    #[test]
    fn it_exists_as_long_as_the_run() {
        let (_folder, path) = place();
        let path = path.with_file_name("run").join("ready.json");
        let file = ReadyFile::at(path.clone()).unwrap();
        assert!(!path.exists() && !path.parent().unwrap().exists(), "not yet written");
        let written = file.write(&ready()).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), format!("{}\n", ready()));
        drop(written);
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 0);
    }

    #[test]
    fn a_file_left_by_a_killed_run_is_removed_at_once() {
        let (_folder, path) = place();
        let cells = json!({ "cells": { "left": ready(), "right": { "ports": {} } } }).to_string();
        for left in [format!("{}\n", ready()), json!({ "ports": {} }).to_string(), cells, String::new()] {
            fs::write(&path, left).unwrap();
            let file = ReadyFile::at(path.clone()).unwrap();
            assert!(!path.exists(), "nobody reads the old one");
            let written = file.write(&ready()).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), format!("{}\n", ready()));
            drop(written);
            assert!(!path.exists());
        }
    }

    #[test]
    fn any_other_file_stays() {
        let (_folder, path) = place();
        let one_is_none = r#"{"cells":{"left":{"ports":{}},"right":{}}}"#;
        let and_more = r#"{"cells":{"left":{"ports":{}}},"ports":{}}"#;
        let long = format!("{}{}", ready(), " ".repeat(1 << 16));
        for other in [
            "[port]\n",
            "{}",
            "[]",
            "\n",
            r#"{"ports":[]}"#,
            r#"{"ports":{},"n":1}"#,
            &long,
            one_is_none,
            and_more,
        ] {
            fs::write(&path, other).unwrap();
            let message = ReadyFile::at(path.clone()).unwrap_err().to_string();
            assert!(
                message.starts_with(&format!("--ready {}: this file exists", path.display())),
                "{message}"
            );
            assert_eq!(fs::read_to_string(&path).unwrap(), other);
        }
        fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink("/dev/null", &path).unwrap();
        assert!(ReadyFile::at(path.clone()).unwrap_err().to_string().contains("not a regular file"));
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(ReadyFile::at(path.clone()).unwrap_err().to_string().contains("a folder; give the name"));
        let under = path.with_file_name("file").join("ready.json");
        fs::write(under.parent().unwrap(), "").unwrap();
        ReadyFile::at(under).unwrap_err();
        for no_name in ["", "..", "/", "new/"] {
            assert!(ReadyFile::at(no_name.into()).unwrap_err().to_string().ends_with(FOLDER), "{no_name:?}");
        }
    }

    #[test]
    fn a_file_created_during_the_start_stays_too() {
        let (_folder, path) = place();
        let file = ReadyFile::at(path.clone()).unwrap();
        fs::write(&path, "somebody's").unwrap();
        file.write(&ready()).unwrap_err();
        assert_eq!(fs::read_to_string(&path).unwrap(), "somebody's");
    }

    #[test]
    fn only_the_written_file_is_removed() {
        let (_folder, path) = place();
        let file = ReadyFile::at(path.clone()).unwrap();
        let written = file.write(&ready()).unwrap();
        fs::write(&path, "somebody's").unwrap();
        drop(written);
        assert_eq!(fs::read_to_string(&path).unwrap(), "somebody's");
        fs::remove_file(&path).unwrap();
        // Another run has written the same text to the same path.
        let first = file.write(&ready()).unwrap();
        let second = file.write(&ready()).unwrap();
        drop(first);
        assert!(path.exists());
        drop(second);
        assert!(!path.exists());
    }
}
