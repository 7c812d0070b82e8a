//! Pieces of frames, and then silence, from devices of every kind of framing.

use super::*;

/// A port that is never overdue, with a recipe whose input part is this.
fn line(input: &str) -> Bench {
    let mut bench = Bench::new(&format!(
        "controller = {{ address = \"127.0.0.1\" }}
        [[recipe]]
        name = \"r\"
        kind = \"stream\"
        mode = \"user\"
        [recipe.input]
        {input}
        [[port]]
        name = \"rs485-1\"
        bus = \"rs485\"
        timeout_ms = \"never\"
        recipe = \"r\""
    ));
    bench.pass(1_000);
    bench
}

const FIXED: &str = "head = [0x48, 0xAA]
    tail = [0x0D]
    fields = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }, { name = \"b\", type = \"float\" }]";
const CHECKED: &str = "head = [0x48, 0xAA]
    checksum = { kind = \"crc16-modbus\" }
    fields = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }, { name = \"b\", type = \"byte\" }]
    endian = \"big\"";
const LINES: &str = "framing = \"tail\"
    tail = [0x0D, 0x0A]
    fields = [{ name = \"code\", type = \"text\", to = \"WordInputReg[1..8]\" }]";
const COUNTED: &str = "head = [0x02]
    fields = [
      { length = true, type = \"byte\" },
      { name = \"code\", type = \"text\", to = \"WordInputReg[1..8]\" },
    ]";

#[test]
fn a_piece_and_silence_is_told_whatever_ends_a_frame() {
    let cases = [
        (FIXED, &[0x48, 0xAA, 1, 0, 0][..], "5 of 9 bytes 2 s ago, then silence: 48 AA 01 00 00"),
        (CHECKED, &[0x48, 0xAA, 1], "3 of 7 bytes 2 s ago, then silence: 48 AA 01"),
        (LINES, b"A7", "2 of 2 to 130 bytes 2 s ago, then silence: 41 37"),
        (COUNTED, &[2, 5, b'A'], "3 of 2 to 130 bytes 2 s ago, then silence: 02 05 41"),
    ];
    for (input, piece, words) in cases {
        let mut bench = line(input);
        bench.bytes(piece);
        bench.pass(2_100);
        let counters = *bench.engine.status(bench.now).ports().next().unwrap().counters;
        assert_eq!(counters.discarded_bytes as usize, piece.len(), "{input}");
        bench.says(Cause::BrokenOff, &[words]);
        bench.pass(10_000);
        bench.says(Cause::BrokenOff, &["12 s ago", "idle_gap_ms"]);
        bench.pass(50_000);
        assert_eq!(bench.of_ports(), []);
    }
}

#[test]
fn a_whole_frame_ends_it() {
    let mut bench = line(LINES);
    bench.bytes(b"A7");
    bench.pass(1_000);
    bench.says(Cause::BrokenOff, &["which end with 0D 0A"]);
    bench.bytes(b"78\r\n");
    bench.pass(100);
    bench.says(Cause::BrokenOff, &["4 bytes came behind a silence within a frame 0 s ago: 37 38 0D 0A"]);
    bench.bytes(b"A778\r\n");
    bench.pass(100);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn pieces_among_whole_frames_are_noise() {
    let mut bench = line(FIXED);
    let frame = [0x48, 0xAA, 1, 0, 0, 0, 0, 0, 0x0D];
    for _ in 0..30 {
        bench.bytes(&frame);
        bench.pass(100);
        bench.bytes(&frame[..5]);
        bench.pass(100);
    }
    bench.says(Cause::Noise, &["right frames and", "damaged ones"]);
}

#[test]
fn a_device_that_worked_and_was_switched_off_is_silent() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&force(&HEAD, &TAIL, f32::to_le_bytes));
    bench.bytes(&HEAD);
    bench.pass(7_000);
    bench.says(Cause::NoBytes, &["0 bytes in 7 s"]);
}
