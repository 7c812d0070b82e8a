//! The engine on a Cortex-M7 has the same outputs as on this host, byte for byte (docs/cortex-m7.md section
//! 2): the engine of a cell is recorded, and its inputs are replayed to engines of a board's size, here and
//! in QEMU.
//!
//! `HOST_SIM_REPLAY` is the program for QEMU. Without it, the tests that need QEMU are counted as ignored:
//!
//! ```text
//! cargo firmware-examples
//! HOST_SIM_REPLAY=$PWD/target/thumbv7em-none-eabihf/firmware/examples/replay cargo test --test thumb
//! ```

mod arithmetic;
mod cells;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use cells::Recorded;
use libtest_mimic::{Arguments, Failed, Trial};
use proto_core::config::GatewayConfig;
use proto_core::engine::{Engine, Input, LinkId, Output};
use proto_core::record::{Entry, MAGIC, replay};
use recipe_cell::recording_difference;

/// The engine of a board (firmware/src/tasks/gateway.rs); the cell's own is larger.
type BoardEngine = Engine<4, 2, 128>;

const HOW: &str = "cargo firmware-examples, then HOST_SIM_REPLAY=target/thumbv7em-none-eabihf/firmware/\
                   examples/replay cargo test --test thumb (rustup target add thumbv7em-none-eabihf; \
                   Debian: apt-get install qemu-system-arm)";

fn main() -> ExitCode {
    let arguments = Arguments::from_args();
    let program = std::env::var_os("HOST_SIM_REPLAY").filter(|path| !path.is_empty()).map(PathBuf::from);
    if program.is_none() {
        eprintln!("thumb: what needs QEMU is skipped; {HOW}");
    }
    // Cargo runs tests in the package's folder; the path is relative to the workspace.
    let program = program.map(|path| match path.exists() {
        true => path,
        false => recipe_test_kit::repository().join(path),
    });
    let mut trials = Vec::new();
    for Recorded { name, record } in cells::all() {
        let title = format!("host: {name}");
        let cell = name.clone();
        trials.push(Trial::test(title, move || same(&record(&cell), on_this_host)));
        let thumb = program.clone().unwrap_or_default();
        let title = format!("thumb: {name}");
        let trial = Trial::test(title, move || same(&record(&name), |recording| in_qemu(&thumb, recording)));
        trials.push(trial.with_ignored_flag(program.is_none()));
    }
    trials.push(Trial::test("the same cell gives the same recording", || {
        for Recorded { name, record } in cells::all() {
            assert_eq!(recording_difference(&record(&name), &record(&name)), None, "{name}");
        }
        Ok(())
    }));
    trials.push(Trial::test("host: another byte is seen", || other_bytes_are_seen(on_this_host)));
    let thumb = program.clone().unwrap_or_default();
    let trial = Trial::test("thumb: another byte is seen", move || {
        other_bytes_are_seen(|recording| in_qemu(&thumb, recording))
    });
    trials.push(trial.with_ignored_flag(program.is_none()));
    libtest_mimic::run(&arguments, trials).exit_code()
}

/// The replay has the same outputs as the recording.
fn same(recording: &[u8], replay: impl Fn(&[u8]) -> Vec<u8>) -> Result<(), Failed> {
    let inputs = entries(recording).filter(|(_, entry)| matches!(entry, Entry::Input { .. })).count();
    assert!(inputs > 400, "only {inputs} inputs");
    match recording_difference(recording, &replay(recording)) {
        None => Ok(()),
        Some(difference) => Err(difference.into()),
    }
}

/// A changed input makes the replay differ from the recording, and so does a changed output.
fn other_bytes_are_seen(replay: impl Fn(&[u8]) -> Vec<u8>) -> Result<(), Failed> {
    let example = cells::all().swap_remove(0);
    let recording = (example.record)(&example.name);
    assert_eq!(recording_difference(&recording, &replay(&recording)), None);

    let head = [0xFF, 0xFF];
    let frame = |entry: &Entry<'_>| match *entry {
        Entry::Input { input: Input::PortBytes { bytes, .. }, .. } => bytes.len() == 7 && bytes[..2] == head,
        _ => false,
    };
    let (end, _) = entries(&recording).find(|(_, entry)| frame(entry)).expect("a frame in one piece");
    let mut other = recording.clone();
    other[end - 3] ^= 1;
    let expected = recording_difference(&recording, &replay(&other)).unwrap_or_default();
    assert!(expected.contains("PortBytes"), "the input is another: {expected}");
    // With the same input in both, the request differs.
    let difference = recording_difference(&other, &replay(&other)).expect("another request");
    let request = difference.contains("found     Output(LinkSend { link: LinkId(02)");
    assert!(request, "{difference}");

    let sent =
        |entry: &Entry<'_>| matches!(entry, Entry::Output(Output::LinkSend { link: LinkId::MODBUS, .. }));
    let (end, _) = entries(&recording).find(|(_, entry)| sent(entry)).expect("a request");
    let mut other = recording.clone();
    other[end - 1] ^= 0x80;
    let difference = recording_difference(&other, &replay(&other)).expect("the engine says something else");
    assert!(difference.contains("LinkSend"), "{difference}");

    let slept = |entry: &Entry<'_>| matches!(entry, Entry::Output(Output::Sleep { .. }));
    let (end, _) = entries(&recording).filter(|(_, entry)| slept(entry)).nth(9).expect("a deadline");
    let mut other = recording;
    other[end - 2] ^= 1;
    let difference =
        recording_difference(&other, &replay(&other)).expect("the engine sleeps as long as before");
    assert!(difference.contains("Sleep"), "{difference}");
    Ok(())
}

/// The entries, each with the offset of its end.
fn entries(recording: &[u8]) -> impl Iterator<Item = (usize, Entry<'_>)> {
    let mut rest = recording.strip_prefix(&MAGIC).expect("a recording");
    std::iter::from_fn(move || {
        let (entry, after) = Entry::parse(rest)?;
        rest = after;
        Some((recording.len() - rest.len(), entry))
    })
}

fn on_this_host(recording: &[u8]) -> Vec<u8> {
    let mut engine = Box::new(BoardEngine::idle());
    let mut config = Box::new(GatewayConfig::empty());
    let mut replayed = Vec::new();
    let done = replay(recording, &mut engine, &mut config, |piece| replayed.extend_from_slice(piece));
    done.unwrap_or_else(|error| panic!("{error}"));
    replayed
}

fn in_qemu(program: &Path, recording: &[u8]) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let [from, to] = ["recording", "replayed"].map(|name| folder.path().join(name));
    fs::write(&from, recording).unwrap();
    let semihosting = format!(
        "enable=on,target=native,arg=replay,arg={},arg={}",
        from.to_str().unwrap(),
        to.to_str().unwrap()
    );
    // `timeout` ends a program that hangs.
    let output = Command::new("timeout")
        .args(["-k", "5", "120", "qemu-system-arm", "-M", "mps2-an500", "-display", "none"])
        .args(["-monitor", "none", "-serial", "null", "-nic", "none", "-semihosting-config", &semihosting])
        .arg("-kernel")
        .arg(program)
        .output()
        .unwrap();
    let said = [output.stdout, output.stderr].concat();
    assert!(output.status.success(), "{}: {}", output.status, String::from_utf8_lossy(&said));
    fs::read(&to).unwrap()
}
