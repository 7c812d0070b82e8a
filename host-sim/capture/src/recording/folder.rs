//! The folder of recordings: which files are recordings, and their size.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// A folder of recordings. Other files in it are ignored.
#[derive(Debug, Clone)]
pub struct Folder {
    path: PathBuf,
}

impl Folder {
    /// Opens the folder, and creates it if it does not exist.
    pub fn open(path: &Path) -> io::Result<Self> {
        fs::create_dir_all(path)?;
        let folder = Self { path: path.to_owned() };
        folder.parts()?;
        Ok(folder)
    }

    /// The path of a part, counted from 1.
    pub fn part(&self, run: &str, part: u32) -> PathBuf {
        self.path.join(format!("{run}.{part:04}.mcap"))
    }

    /// All parts of all runs, the oldest first, with their sizes.
    pub fn parts(&self) -> io::Result<Vec<(PathBuf, u64)>> {
        let mut parts = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let entry = entry?;
            let name = entry.file_name();
            let Some((run, part)) = name.to_str().and_then(split) else { continue };
            let found = entry.metadata()?;
            if found.is_file() {
                parts.push(((run.to_owned(), part), entry.path(), found.len()));
            }
        }
        parts.sort();
        Ok(parts.into_iter().map(|(_, path, len)| (path, len)).collect())
    }

    /// Removes the oldest parts until the others take at most this many bytes.
    pub fn make_room(&self, bytes: u64) -> io::Result<()> {
        let parts = self.parts()?;
        let mut used: u64 = parts.iter().map(|(_, len)| len).sum();
        for (path, len) in parts {
            if used <= bytes {
                break;
            }
            fs::remove_file(path)?;
            used = used.saturating_sub(len);
        }
        Ok(())
    }

    /// The parts of the newest run; empty if there is none.
    pub fn newest_run(&self) -> io::Result<Vec<PathBuf>> {
        let parts: Vec<_> = self.parts()?.into_iter().map(|(path, _)| path).collect();
        let Some(run) = parts.last().and_then(|path| run_of(path)) else { return Ok(Vec::new()) };
        Ok(parts.into_iter().filter(|path| run_of(path).is_some_and(|other| other == run)).collect())
    }
}

/// The run that a file belongs to, by its name.
pub(crate) fn run_of(path: &Path) -> Option<String> {
    split(path.file_name()?.to_str()?).map(|(run, _)| run.to_owned())
}

/// Run and part in the name of a recording's file.
fn split(name: &str) -> Option<(&str, u32)> {
    let (run, part) = name.strip_suffix(".mcap")?.rsplit_once('.')?;
    let is_run = run.len() == RUN_LEN && run.bytes().all(|byte| byte.is_ascii_digit() || byte == b'-');
    let is_part = part.len() >= 4 && part.bytes().all(|byte| byte.is_ascii_digit());
    (is_run && is_part).then_some((run, part.parse().ok()?))
}

/// Length of `20260102-030405-678`, UTC.
const RUN_LEN: usize = 19;

/// The name of a run that begins at `now`.
pub fn run_name(now: SystemTime) -> String {
    let since = now.duration_since(UNIX_EPOCH).unwrap_or_default();
    let (days, second) = (since.as_secs() / 86_400, since.as_secs() % 86_400);
    let (year, month, day) = civil(days);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}-{:03}", since.subsec_millis())
}

/// Year, month and day of a day since 1970, in the Gregorian calendar.
fn civil(days: u64) -> (u64, u64, u64) {
    // Counted from 1 March of the year 0, so the leap day is the last day of a year.
    let days = days + 719_468;
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day = day_of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day_of_month = day - (153 * month + 2) / 5 + 1;
    let (month, next) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    (era * 400 + year + next, month, day_of_month)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn runs_are_called_after_their_time() {
        for (secs, name) in [
            (0, "19700101-000000-000"),
            (951_782_399, "20000228-235959-000"),
            (951_782_400, "20000229-000000-000"),
            (951_868_800, "20000301-000000-000"),
            (1_709_251_199, "20240229-235959-000"),
            (1_795_380_527, "20261122-204847-000"),
            (4_107_542_400, "21000301-000000-000"),
        ] {
            assert_eq!(run_name(UNIX_EPOCH + Duration::from_secs(secs)), name);
        }
    }

    #[test]
    fn the_oldest_go_and_nothing_else_does() {
        let place = tempfile::tempdir().unwrap();
        let folder = Folder::open(place.path()).unwrap();
        let make = |name: &str| fs::write(place.path().join(name), [0; 100]).unwrap();
        for name in ["notes.txt", "other.mcap", "20260101-000000-000.1.mcap", "00000000-000000-000.mcap"] {
            make(name);
        }
        let (old, new) = ("20260101-000000-000", "20260102-000000-000");
        for (run, part) in [(new, 1), (old, 10_000), (old, 2), (new, 2), (old, 9_999)] {
            fs::write(folder.part(run, part), [0; 100]).unwrap();
        }
        let names = || {
            let name =
                |(path, _): (PathBuf, u64)| path.file_name().unwrap().to_str().unwrap()[6..].to_owned();
            folder.parts().unwrap().into_iter().map(name).collect::<Vec<_>>()
        };
        assert_eq!(
            names()[..3],
            ["01-000000-000.0002.mcap", "01-000000-000.9999.mcap", "01-000000-000.10000.mcap"]
        );
        folder.make_room(320).unwrap();
        assert_eq!(names()[0], "01-000000-000.10000.mcap");
        folder.make_room(299).unwrap();
        assert_eq!(folder.newest_run().unwrap(), [folder.part(new, 1), folder.part(new, 2)]);
        assert_eq!(names().len(), 2);
        folder.make_room(0).unwrap();
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 4);
    }
}
