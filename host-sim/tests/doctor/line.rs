//! Faults of a serial line, on a pseudoterminal.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use recipe_test_kit::{HostSim, example};

use super::{BINARY, Feeder, appears, doctor, finds, logs};

/// A frame of the force sensor.
fn force(head: &[u8], tail: &[u8], float: impl Fn(f32) -> [u8; 4]) -> Vec<u8> {
    let values = [1.25_f32, -0.5, 12.75, 0.031, -2.5, 100.0];
    [head, values.map(float).as_flattened(), tail].concat()
}

const HEAD: [u8; 2] = [0x48, 0xAA];
const TAIL: [u8; 2] = [0x0D, 0x0A];

/// What a device sends, and what is said of it by the gateway and by the doctor.
#[track_caller]
fn said(file: &Path, port: &str, bytes: &[u8], cause: &str, words: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join(port);
    let bind = format!("--bind={port}=pty:{}", line.display());
    let gateway = HostSim::start(BINARY.run("gateway", file).arg("-v").arg(&bind));
    let feeder = (!bytes.is_empty()).then(|| Feeder::start(&line, bytes));
    logs(&gateway, &[&[&*format!("port {port}: ")], words].concat());
    gateway.stats("the words are in the statistics", |stats| {
        let findings = stats["findings"].as_array().cloned().unwrap_or_default();
        findings.iter().any(|text| words.iter().all(|word| text.as_str().unwrap().contains(word)))
    });
    gateway.end();
    let findings = doctor(file, &[bind]);
    drop(feeder);
    finds(&findings, cause, words);
}

fn force_says(bytes: &[u8], cause: &str, words: &[&str]) {
    said(&example("force-sensor.toml"), "force", bytes, cause, words);
}

#[test]
fn no_bytes() {
    force_says(&[], "no_bytes", &["0 bytes in ", "frames that begin with 48 AA"]);
}

#[test]
fn garbage() {
    let noise: Vec<u8> = (0..29_u32).map(|nth| (nth * 97 + 31) as u8 & 0x7E).collect();
    force_says(&noise, "no_head", &["0 frames", "the head 48 AA", "baud rate or parity"]);
}

#[test]
fn a_swapped_head() {
    let frame = force(&[0xAA, 0x48], &TAIL, f32::to_le_bytes);
    force_says(&frame, "head_swapped", &["0 frames; first seen AA 48; expected the head 48 AA"]);
}

#[test]
fn a_wrong_tail() {
    let frame = force(&HEAD, &[0x0A, 0x0D], f32::to_le_bytes);
    force_says(&frame, "tail_differs", &["frames end with 0A 0D; expected the tail 0D 0A"]);
}

#[test]
fn an_extra_byte() {
    let frame = force(&HEAD, &[7, 0x0D, 0x0A], f32::to_le_bytes);
    force_says(&frame, "length_differs", &["frames of 29 bytes", "1 byte longer"]);
}

#[test]
fn the_wrong_byte_order() {
    let frame = force(&HEAD, &TAIL, f32::to_be_bytes);
    force_says(&frame, "byte_order", &["The device sends big-endian"]);
}

fn listener() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/program/files/listener.toml")
}

#[test]
fn a_wrong_address() {
    let frame = [0x08, 0x17, 0x06, 0xF9, 0x00, 0x00, 0xDC, 0xD0, 0x1E, 0x43, 0x81];
    said(&listener(), "status", &frame, "other_device", &["with 08 in byte 1; expected 09 there"]);
}

#[test]
fn a_wrong_checksum() {
    let frame = [0x09, 0x17, 0x06, 0xF9, 0x00, 0x00, 0xDC, 0xD0, 0x1E, 0x11, 0x4E];
    said(&listener(), "status", &frame, "checksum_kind", &["right as crc16-modbus, high byte first"]);
}

/// A slave that answers each request with the same reply.
fn slave(line: &Path, reply: &'static [u8]) {
    let line = line.to_owned();
    std::thread::spawn(move || {
        appears(&line);
        let mut device = std::fs::File::options().read(true).write(true).open(&line).unwrap();
        // It ends with the line.
        while device.read_exact(&mut [0; 8]).is_ok() && device.write_all(reply).is_ok() {}
    });
}

#[test]
fn another_slave_answers() {
    const MASTER: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "line"
kind = "modbus-rtu"
[[recipe.exchange]]
slave = 9
function = "read-holding-registers"
address = 1
every_ms = 100
read = [{ name = "speed", type = "word", to = "WordInputReg[1]" }]

[[port]]
name = "line"
bus = "modbus-rtu"
recipe = "line"
"#;
    const OF_8: [u8; 7] = [8, 3, 2, 0, 7, 0x25, 0x87];
    let folder = tempfile::tempdir().unwrap();
    let (file, line) = (folder.path().join("line.toml"), folder.path().join("line"));
    std::fs::write(&file, MASTER).unwrap();
    let bind = format!("--bind=line=pty:{}", line.display());
    let gateway = HostSim::start(BINARY.run("gateway", &file).arg("-v").arg(&bind));
    slave(&line, &OF_8);
    let words = ["slave 9 asked ", "a right frame of slave 8 is heard: 08 03 02 00 07 25 87"];
    logs(&gateway, &words);
    gateway.end();
    slave(&line, &OF_8);
    finds(&doctor(&file, &[bind.clone(), "--ask".into()]), "peer_other", &words);
    // Nobody is asked otherwise, and nobody is blamed.
    let findings = doctor(&file, &[bind]);
    assert!(findings.iter().all(|finding| finding["place"] != "port"), "{findings:#?}");
}

#[test]
fn a_fault_that_is_over_is_told_as_over() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("force");
    let bind = format!("--bind=force=pty:{}", line.display());
    let gateway = HostSim::start(BINARY.run("gateway", &example("force-sensor.toml")).arg("-v").arg(bind));
    logs(&gateway, &["port force: 0 bytes in "]);
    let _feeder = Feeder::start(&line, &force(&HEAD, &TAIL, f32::to_le_bytes));
    logs(&gateway, &["port force: over: no bytes"]);
    let told = gateway.log("port force: 0 bytes in ");
    assert_eq!(told.len(), 1, "{told:#?}");
    gateway.end();
}

#[test]
fn a_trace_has_bytes_as_decode_takes_them() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("force");
    let file = example("force-sensor.toml");
    let bind = format!("--bind=force=pty:{}", line.display());
    let gateway = HostSim::start(BINARY.run("gateway", &file).arg("-vv").arg(bind));
    let _feeder = Feeder::start(&line, &force(&HEAD, &TAIL, f32::to_le_bytes));
    logs(&gateway, &["port 0: 48 AA 00 00 A0 3F"]);
    let traced = gateway.log("port 0: 48 AA 00 00 A0 3F").remove(0);
    let bytes = traced.rsplit_once("port 0: ").unwrap().1;
    let mut decode = BINARY.command();
    decode
        .arg("decode")
        .arg(&file)
        .args(["--recipe", "force-sensor", "--part", "input"])
        .args(bytes.split(' '));
    let output = decode.output().unwrap();
    assert!(output.status.success(), "{bytes}: {}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).contains("1.25"));
    gateway.end();
}
