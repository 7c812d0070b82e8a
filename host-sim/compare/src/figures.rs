//! Figures of many samples, and of processes.

use std::fs;
use std::time::Duration;

use rustix::process::Pid;

/// The sample below which this share of all lies, from 0 to 1. Sorts them.
///
/// # Panics
/// Without samples.
pub(crate) fn quantile<T: PartialOrd + Copy>(samples: &mut [T], share: f64) -> T {
    assert!(!samples.is_empty(), "nothing was measured");
    samples.sort_by(|a, b| a.partial_cmp(b).expect("figures are numbers"));
    samples[((samples.len() - 1) as f64 * share).round() as usize]
}

/// Processor time that all threads of a process have used.
///
/// # Panics
/// If there is no such process.
pub(crate) fn processor_time(process: Pid) -> Duration {
    let tasks = format!("/proc/{}/task", process.as_raw_nonzero());
    let of_task = |path: std::path::PathBuf| {
        // A thread may end while they are listed.
        let stat = fs::read_to_string(path.join("schedstat")).unwrap_or_default();
        stat.split(' ').next().and_then(|nanos| nanos.parse().ok()).unwrap_or(0)
    };
    let nanos = fs::read_dir(&tasks).unwrap_or_else(|error| panic!("{tasks}: {error}"));
    Duration::from_nanos(nanos.map(|task| of_task(task.unwrap().path())).sum())
}
