//! Recordings of runs without sockets.

use std::fs;
use std::path::Path;

use proto_core::engine::Input;
use recipe_test_kit::{example, until};

use super::*;
use crate::replay::{Report, Stopped, replay};
use crate::test_run::{FILE, TestRun, config};

fn start(folder: &Path, watch: &Watch, budget: u64) -> Recording {
    let options = RecordOptions { folder: folder.to_owned(), budget, file: MIN_FILE };
    Recording::start(watch, options).unwrap()
}

fn used(folder: &Path) -> u64 {
    Folder::open(folder).unwrap().parts().unwrap().iter().map(|(_, len)| len).sum()
}

fn messages(path: &Path) -> Vec<(String, Vec<u8>)> {
    let bytes = fs::read(path).unwrap();
    let stream = mcap::MessageStream::new(&bytes).unwrap();
    stream.map(|message| message.map(|m| (m.channel.topic.clone(), m.data.to_vec())).unwrap()).collect()
}

#[test]
fn a_run_is_recorded_by_name_and_replayed_to_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let watch = Watch::new();
    let recording = start(folder.path(), &watch, 1 << 30);
    let mut run = TestRun::begin(&watch);
    for value in [1, 2, 3] {
        run.frame(value);
    }
    run.end();
    watch.close();
    recording.finish();
    let (path, _) = Folder::open(folder.path()).unwrap().parts().unwrap().remove(0);
    let found = messages(&path);
    let values: Vec<_> = found.iter().filter(|(topic, _)| topic == "/rs485__1/input").collect();
    assert_eq!(values.len(), 3);
    assert_eq!(values[2].1, br#"{"DigitalOutputCommand_1_":3}"#);
    for path in [folder.path(), &path] {
        let report = replay(path, None).unwrap();
        assert!(
            matches!(report, Report { starts: 1, inputs: 8, is_cut: false, stopped: None, .. }),
            "{report:?}"
        );
    }
}

#[test]
fn each_configuration_of_a_run_has_its_own_values() {
    let folder = tempfile::tempdir().unwrap();
    let watch = Watch::new();
    let recording = start(folder.path(), &watch, 1 << 30);
    let toml = fs::read_to_string(example(FILE)).unwrap();
    let other = toml.replace("DigitalOutputCommand[1]", "DigitalOutputCommand[2]");
    for toml in [toml, other] {
        let mut run = TestRun::begin_with(&watch, &toml);
        run.frame(7);
        run.end();
    }
    watch.close();
    recording.finish();
    let parts = Folder::open(folder.path()).unwrap().parts().unwrap();
    let values: Vec<_> = parts.iter().flat_map(|(path, _)| messages(path)).collect();
    let values: Vec<_> = values.iter().filter(|(topic, _)| topic == "/rs485__1/input").collect();
    assert_eq!(values[0].1, br#"{"DigitalOutputCommand_1_":7}"#);
    assert_eq!(values[1].1, br#"{"DigitalOutputCommand_2_":7}"#);
    let report = replay(folder.path(), None).unwrap();
    assert!(matches!(report, Report { starts: 2, files: 2, stopped: None, is_cut: false, .. }), "{report:?}");
}

#[test]
fn the_plain_recording_is_the_one_of_the_core() {
    let folder = tempfile::tempdir().unwrap();
    let watch = Watch::new();
    let recording = start(folder.path(), &watch, 1 << 30);
    let mut run = TestRun::begin(&watch);
    run.frame(1);
    run.end();
    watch.close();
    recording.finish();
    let mut plain = Vec::new();
    replay(folder.path(), Some(&mut plain)).unwrap();
    let mut engine = Box::new(proto_core::engine::Engine::<8>::new(&*config()).unwrap());
    let mut again = Vec::new();
    let mut scratch = config();
    proto_core::record::replay(&plain, &mut engine, &mut scratch, |bytes| again.extend_from_slice(bytes))
        .unwrap();
    assert_eq!(plain, again);
    let path = folder.path().join("plain");
    fs::write(&path, &plain).unwrap();
    assert_eq!(replay(&path, None).unwrap().stopped, None);
    // A file that was cut anywhere is the same up to there.
    for len in [plain.len() - 1, plain.len() / 2, plain.len() - 40] {
        fs::write(&path, &plain[..len]).unwrap();
        let report = replay(&path, None).unwrap();
        assert!(report.stopped.is_none() && report.is_cut, "{len}: {report:?}");
    }
    // And one that was changed is not.
    let last = plain.len() - 1;
    plain[last] ^= 1;
    fs::write(&path, &plain).unwrap();
    assert!(matches!(replay(&path, None).unwrap().stopped, Some(Stopped::Differs(_))));
}

#[test]
fn a_full_folder_loses_its_oldest_files_and_what_is_left_says_that_the_start_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    let watch = Watch::new();
    let budget = 3 * MIN_FILE;
    let recording = start(folder.path(), &watch, budget);
    let mut run = TestRun::begin(&watch);
    let mut most = 0;
    until("the first file to go", || {
        (0..2_000).for_each(|nth| run.frame(nth as u8));
        // The disk may be slow; what it does not take is missed.
        std::thread::sleep(Duration::from_millis(20));
        most = most.max(used(folder.path()));
        let parts = Folder::open(folder.path()).unwrap().parts().unwrap();
        parts.first().filter(|(path, _)| !path.to_str().unwrap().ends_with(".0001.mcap")).map(|_| ())
    });
    run.end();
    watch.close();
    recording.finish();
    let parts = Folder::open(folder.path()).unwrap().parts().unwrap();
    assert!(most <= budget && used(folder.path()) <= budget, "{most} of {budget}");
    assert!(parts.iter().all(|(_, len)| *len <= MIN_FILE), "{parts:?}");
    parts.iter().for_each(|(path, _)| assert!(messages(path).len() > 100));
    let message = replay(folder.path(), None).unwrap_err().to_string();
    assert!(message.contains("its first part was dropped"), "{message}");
}

#[test]
fn lost_calls_are_a_gap_that_replay_finds() {
    let folder = tempfile::tempdir().unwrap();
    let watch = Watch::new();
    let recording = start(folder.path(), &watch, 1 << 30);
    let mut run = TestRun::begin(&watch);
    run.frame(1);
    run.pass(1);
    run.input(Input::Tick, 4);
    run.frame(2);
    run.end();
    watch.close();
    recording.finish();
    let stopped = replay(folder.path(), None).unwrap().stopped;
    assert!(matches!(stopped, Some(Stopped::Gap { missing: 4, .. })), "{stopped:?}");
}

#[test]
fn what_a_killed_process_leaves_is_readable() {
    let folder = tempfile::tempdir().unwrap();
    let watch = Watch::new();
    let recording = start(folder.path(), &watch, 1 << 30);
    let mut run = TestRun::begin(&watch);
    run.frame(1);
    // It is on its way to the disk after a second, without an end.
    let path = until("a chunk in the file", || {
        let parts = Folder::open(folder.path()).unwrap().parts().unwrap();
        parts.into_iter().find(|(_, len)| *len > 1_000).map(|(path, _)| path)
    });
    let copy = tempfile::tempdir().unwrap();
    let name = copy.path().join(path.file_name().unwrap());
    fs::copy(&path, &name).unwrap();
    let report = replay(&name, None).unwrap();
    assert!(report.inputs >= 4 && report.stopped.is_none(), "{report:?}");
    // Cut anywhere, what is before is there.
    let bytes = fs::read(&name).unwrap();
    for len in [bytes.len() - 1, bytes.len() - 10] {
        fs::write(&name, &bytes[..len]).unwrap();
        let report = replay(&name, None).unwrap();
        assert!(report.is_cut && report.stopped.is_none(), "{report:?}");
    }
    watch.close();
    recording.finish();
}

#[test]
fn a_failure_is_over_when_the_disk_is_back() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("recordings");
    let watch = Watch::new();
    let recording = start(&place, &watch, 1 << 30);
    // Nothing can be made in a folder that is gone.
    fs::remove_dir(&place).unwrap();
    let mut run = TestRun::begin(&watch);
    until("a failure", || {
        run.frame(1);
        (recording.failures() > 0).then_some(())
    });
    fs::create_dir(&place).unwrap();
    until("a file", || {
        run.frame(2);
        std::thread::sleep(Duration::from_millis(20));
        (used(&place) > 0).then_some(())
    });
    run.end();
    watch.close();
    recording.finish();
    let replayed = replay(&place, None);
    assert!(matches!(replayed, Err(crate::replay::ReplayError::NoStart(_))), "{replayed:?}");
}

#[test]
fn a_length_that_no_memory_has_is_a_file_that_was_cut() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("damaged.mcap");
    let head = [&b"\x89MCAP0\r\n\x01"[..], &u64::MAX.to_le_bytes(), &[0; 16]].concat();
    for bytes in [head.clone(), [&head[..9], &(1_u64 << 40).to_le_bytes(), &[0; 16]].concat()] {
        std::fs::write(&file, bytes).unwrap();
        let error = replay(&file, None).unwrap_err().to_string();
        assert!(error.ends_with("not a recording of a gateway"), "{error}");
    }
}

#[test]
fn a_record_that_is_longer_than_its_chunk_is_the_end_of_the_file() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("damaged.mcap");
    // A chunk without times, sizes, checksum and compression, whose one record says to have 40 bytes.
    let record = [&[0x05][..], &40_u64.to_le_bytes(), &[0; 8]].concat();
    let len = record.len() as u64;
    let chunk = [&[0; 16][..], &len.to_le_bytes(), &[0; 8], &len.to_le_bytes(), &record].concat();
    let bytes = [&b"\x89MCAP0\r\n\x06"[..], &(chunk.len() as u64).to_le_bytes(), &chunk, &[0; 64]].concat();
    std::fs::write(&file, bytes).unwrap();
    let error = replay(&file, None).unwrap_err().to_string();
    assert!(error.ends_with("not a recording of a gateway"), "{error}");
}
