//! Recordings for `replay`, whole and damaged: MCAP files and plain ones. Whatever is read of one is replayed in
//! the same way when it is written out plain (docs/capture.md).

use std::io::Cursor;
use std::path::Path;

use mcap::WriteOptions;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use proto_core::config::GatewayConfig;
use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::record::{Entry, MAGIC, totals};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use recipe_capture::recording::{ENGINE, ENGINE_ENCODING};
use recipe_capture::replay::{ReplayError, Report, Stopped, replay};
use recipe_config::board;
use recipe_config::file::{Text, parse_gateway};
use recipe_fuzz::source::Source;

const FILES: [&str; 3] = [
    include_str!("../../configs/rs485-system.toml"),
    include_str!("../../configs/can-hand.toml"),
    include_str!("../../configs/modbus-line.toml"),
];

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let kind = input.u8();
    let folder = tempfile::tempdir().expect("there is a place for files");
    let file = folder.path().join("any");
    if kind.is_multiple_of(8) {
        let bytes = [&MAGIC[..usize::from(kind & 8) / 2], input.rest()].concat();
        std::fs::write(&file, bytes).expect("it can be written");
        return check(&file);
    }
    let calls = record(&mut input);
    let (mut bytes, expected) = if kind & 1 == 0 {
        ([&MAGIC[..], &calls.concat()].concat(), None)
    } else {
        let gap = (kind & 2 != 0).then(|| input.below(calls.len()));
        (mcap_of(&calls, gap, kind & 4 != 0), gap)
    };
    std::fs::write(&file, &bytes).expect("it can be written");
    let last = calls.len() - 1;
    match (replay(&file, None), expected) {
        // What was before the first call is not known, and what is behind the last one.
        (Err(ReplayError::NoStart(_)), Some(0)) => {}
        (Ok(report), Some(gap)) if (1..last).contains(&gap) => {
            assert!(matches!(report.stopped, Some(Stopped::Gap { missing: 1, .. })), "{report:?}");
            assert_eq!(report.inputs, gap as u64 - 1);
        }
        (Ok(report), gap) if gap.is_none_or(|gap| gap == last) => {
            assert_eq!((report.inputs, &report.stopped), (last as u64 - 1, &None), "{report:?}");
        }
        other => panic!("{other:?}"),
    }
    if input.is_empty() {
        return check(&file);
    }
    while !input.is_empty() {
        let at = usize::from(input.u16()) % bytes.len();
        match input.u8() {
            0 => bytes.truncate(at.max(1)),
            1 => drop(bytes.drain(at..(at + input.below(200)).min(bytes.len() - 1).max(at))),
            changed => bytes[at] ^= changed,
        }
    }
    std::fs::write(&file, &bytes).expect("it can be written");
    check(&file);
}

/// Something is found in it or not, and the same in what is written of it.
fn check(file: &Path) {
    let mut plain = Vec::new();
    let told = |result: Result<Report, ReplayError>| match result {
        Ok(report) => {
            let stopped = report.stopped.filter(|stopped| matches!(stopped, Stopped::Differs(_)));
            Ok((report.starts, report.inputs, report.outputs, report.span, stopped))
        }
        Err(error) => {
            let line = error.to_string();
            assert!(!line.chars().any(char::is_control), "{line:?}");
            Err(std::mem::discriminant(&error))
        }
    };
    let first = told(replay(file, Some(&mut Cursor::new(&mut plain))));
    let again = file.with_extension("plain");
    if plain.len() > MAGIC.len() && plain.starts_with(&MAGIC) {
        std::fs::write(&again, &plain).expect("it can be written");
        assert_eq!(told(replay(&again, None)), first);
    }
}

/// The calls of a run: its start, inputs with what they led to, the counters at the end.
fn record(input: &mut Source<'_>) -> Vec<Vec<u8>> {
    let text = Text { name: "cell.toml", toml: input.one_of(&FILES) };
    let config: Box<GatewayConfig> = parse_gateway(text, &[]).expect("an example");
    let image = board::encoded(&config).expect("there is room");
    let mut engine = Box::new(Engine::<8, 4, 512>::new(&*config).expect("an example"));
    let mut calls = vec![encoded(&[Entry::Start { image: &image }])];
    let mut now = Instant::from_millis(1_000);
    for _ in 0..input.below(12) {
        now += Duration::from_millis(u64::from(input.u8()));
        let port = PortId(input.u8() % 2);
        let link = LinkId(input.u8() % 5);
        let kind = input.u8();
        let data = input.run();
        let what = match kind % 8 {
            0 => Input::Tick,
            1 => Input::PortUp { port },
            2 => Input::PortDown { port },
            3 => Input::PortBytes { port, bytes: data },
            4 => match CanFrame::new(CanId::Standard(0x502), &data[..data.len().min(8)]) {
                Some(frame) => Input::PortCan { port, frame },
                None => Input::Tick,
            },
            5 => Input::LinkUp { link },
            6 => Input::LinkBytes { link, bytes: data },
            _ => Input::LinkDown { link },
        };
        calls.push(call(&mut engine, now, what));
    }
    calls.push(encoded(&[Entry::Totals(&totals(&*engine))]));
    calls
}

fn call(engine: &mut Engine<8, 4, 512>, now: Instant, input: Input<'_>) -> Vec<u8> {
    let mut bytes = encoded(&[Entry::Input { at: now, input }]);
    let mut buf = [0; OUTPUT_BUFFER];
    engine.handle(now, input);
    loop {
        let output = engine.poll_output(now, &mut buf);
        bytes.extend(encoded(&[Entry::Output(output)]));
        if let Output::Sleep { .. } = output {
            return bytes;
        }
    }
}

fn encoded(entries: &[Entry<'_>]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for entry in entries {
        entry.encode(|piece| bytes.extend_from_slice(piece));
    }
    bytes
}

/// A file with each call as a message; one that is missing leaves a gap in their numbers.
fn mcap_of(calls: &[Vec<u8>], gap: Option<usize>, is_cut: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = WriteOptions::new().compression(None).chunk_size(Some(512)).disable_seeking(true);
    let mut writer = options.create(NoSeek::new(&mut bytes)).expect("memory can be written");
    let channel = writer.add_channel(0, ENGINE, ENGINE_ENCODING, &Default::default()).expect("one channel");
    for (nth, call) in calls.iter().enumerate().filter(|(nth, _)| gap != Some(*nth)) {
        let header =
            MessageHeader { channel_id: channel, sequence: nth as u32, log_time: 0, publish_time: 0 };
        writer.write_to_known_channel(&header, call).expect("memory can be written");
    }
    writer.finish().expect("memory can be written");
    drop(writer);
    // As a killed process leaves it: without the end.
    if is_cut {
        bytes.truncate(bytes.len() - 8);
    }
    bytes
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let frame = [5, 0, 0, 3, 5, 0xFF, 0xFF, 1, 0xEE, 0xEE];
    let can = [4, 0, 0, 4, 4, 1, 2, 0x10, 0x27];
    let up = [1, 0, 0, 1, 0];
    let link = [9, 0, 2, 5, 0];
    let mut seeds = Vec::new();
    for kind in [1, 2, 3, 4, 5, 7] {
        for file in 0..3 {
            let mut seed = vec![kind, file, 9];
            for _ in 0..2 {
                seed.extend([&up[..], &frame, &can, &link].concat());
            }
            seed.extend(up);
            if kind & 3 == 3 {
                seed.push(4);
            }
            seeds.push(seed.clone());
            for damage in [[40, 0, 1, 9], [200, 1, 7, 0], [90, 2, 0, 0], [17, 0, 0x80, 0]] {
                seeds.push([&seed[..], &damage].concat());
            }
        }
    }
    for bytes in [&b"\x00"[..], b"\x08\x01\x02", b"\x00\x89MCAP0\r\n", b"\x08\x1A\xFF\xFF\xFF\xFF\x0F"] {
        seeds.push(bytes.to_vec());
    }
    // A record that says to be longer than any memory.
    seeds.push([&b"\x00\x89MCAP0\r\n\x01"[..], &[0xFF; 8], &[0; 16]].concat());
    seeds.push([&b"\x00\x89MCAP0\r\n\x06"[..], &[0xFF, 0xFF, 0xFF, 0xFF, 0x0F, 0, 0, 0], &[0; 16]].concat());
    seeds
}
