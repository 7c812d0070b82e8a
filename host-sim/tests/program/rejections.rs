//! Statistics and rejections of a device with frames of its own, in a real process on a pseudoterminal.

use std::io::Write;
use std::path::Path;

use recipe_test_kit::{HostSim, example};
use rustix::process::Signal;

use super::BINARY;

/// Of [listener.toml](files/listener.toml): a frame, the same of slave 8, and one with a damaged byte.
const REPLY: [u8; 11] = [0x09, 0x17, 0x06, 0xF9, 0x00, 0x00, 0xDC, 0xD0, 0x1E, 0x4E, 0x11];
const OTHER: [u8; 11] = [0x08, 0x17, 0x06, 0xF9, 0x00, 0x00, 0xDC, 0xD0, 0x1E, 0x43, 0x81];
const WRONG: [u8; 11] = [0x09, 0x17, 0x06, 0xF9, 0x00, 0x00, 0xDC, 0x42, 0x1E, 0x4E, 0x11];

/// Sends frames to a gateway with this file and waits until its counters say this of each.
fn counted(file: &Path, port: &str, frames: &[(&[u8], &str, u64)]) {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join(port);
    let gateway = HostSim::start(
        BINARY
            .command()
            .args(["gateway", "--stats", "20ms", "-c"])
            .arg(file)
            // A busy machine makes pauses within a frame.
            .arg(format!("--set=port.{port}.idle_gap_ms=1000"))
            .arg(format!("--bind={port}=pty:{}", line.display())),
    );
    let mut device = std::fs::File::options().read(true).write(true).open(&line).unwrap();
    for &(frame, counter, count) in frames {
        device.write_all(frame).unwrap();
        let stats = gateway.next_stats(|stats| stats["ports"][port][counter] == count);
        if let Some(why) = counter.strip_prefix("rejected_") {
            assert_eq!(stats["ports"][port]["last_rejection"]["why"], why, "{stats}");
        }
    }
    gateway.ended_by(Signal::TERM);
}

#[test]
fn statistics_count_wrong_checksums_and_other_devices_apart() {
    counted(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/program/files/listener.toml"),
        "status",
        &[(&OTHER, "rejected_other_device", 1), (&WRONG, "rejected_checksum", 1), (&REPLY, "frames_in", 1)],
    );
}

#[test]
fn statistics_count_fields_that_are_no_numbers() {
    counted(
        &example("scale.toml"),
        "scale",
        &[
            (b"ST,GS,+  12x34kg\r\n", "rejected_unreadable", 1),
            (b"ST,GS,+  12.34kg\r\n", "frames_in", 1),
            // More than the register holds.
            (b"ST,GS,+ 812.34kg\r\n", "rejected_out_of_range", 1),
        ],
    );
}
