//! `capture`: frames as a file for Wireshark.
//!
//! A gateway on a host sends the capture itself. For a board it is made here from the frames in its stream.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use proto_core::config::{GatewayConfig, MAX_PORTS};
use proto_core::engine::Engine;
use proto_core::time::Instant;
use recipe_capture::pcapng::Scope;
use recipe_capture::{CaptureFile, Cell, Epoch, Record, Target, Watch, What, replaceable};

use crate::answer::Answer;
use crate::changing::stored;
use crate::client::{Client, EventStream};
use crate::failure::Failure;
use crate::frames::FramesDocument;
use crate::trace::{has_port, is_plain, path};

/// Writes the traffic of one port or of all ports to a file, until Ctrl-C or for some time. Replaces an existing
/// capture, but no other file.
///
/// # Errors
/// If the request is refused, the gateway is not reached, the stream ends, or the file cannot be written.
pub fn capture(
    client: &Client,
    file: &Path,
    port: Option<&str>,
    time: Option<Duration>,
) -> Result<Answer, Failure> {
    if let Some(port) = port {
        has_port(client, port)?;
    }
    let stop = time.map_or_else(|| client.stop().clone(), |time| client.stop().after(time));
    let listening = client.until(stop);
    let name = file.display();
    // A port name that does not fit in a path would select all frames; the capture is then made here.
    let route = match port {
        None => Some("capture.pcapng".to_owned()),
        Some(port) if is_plain(port) => Some(format!("capture.pcapng?port={port}")),
        Some(_) => None,
    };
    let events = match &route {
        Some(route) => listening.stream_if_there(route)?,
        None => None,
    };
    let written = match events {
        Some(events) => from_host(events, file)?,
        None => from_frames(&listening, file, port)?,
    };
    let text = format!("{name}: {written}\n");
    Ok(Answer::new(serde_json::json!({ "file": name.to_string() }), text))
}

/// Writes the blocks of a capture as they arrive; returns a description.
fn from_host(mut events: EventStream<'_>, path: &Path) -> Result<String, Failure> {
    let refused = |error: std::io::Error| Failure::wrong(format!("{}: {error}", path.display()));
    replaceable(path).map_err(refused)?;
    let mut file = File::create(path).map_err(refused)?;
    let mut len = 0_u64;
    // Bytes of an incomplete block are kept for the next round: the file always ends with a whole block.
    let mut waiting = Vec::new();
    while let Some(bytes) = events.bytes()? {
        waiting.extend(bytes);
        let whole = whole_blocks(&waiting)
            .ok_or_else(|| Failure::refused(format!("{}: what comes is no capture", path.display())))?;
        file.write_all(&waiting[..whole]).map_err(refused)?;
        len += whole as u64;
        waiting.drain(..whole);
    }
    Ok(format!("{len} bytes"))
}

/// The length of the whole blocks of pcapng at the front; `None` if the bytes are something else.
fn whole_blocks(bytes: &[u8]) -> Option<usize> {
    let mut at = 0;
    while let Some(header) = bytes.get(at..at + 8) {
        // The gateway writes lengths in little-endian order.
        let len = u32::from_le_bytes([header[4], header[5], header[6], header[7]]) as usize;
        if len < 12 || !len.is_multiple_of(4) || len > MAX_BLOCK {
            return None;
        }
        if bytes.len() - at < len {
            break;
        }
        at += len;
    }
    Some(at)
}

/// Maximum length of a block, longer than any block of a gateway.
const MAX_BLOCK: usize = 1 << 20;

/// Makes a capture of the frames in the stream.
fn from_frames(client: &Client, place: &Path, port: Option<&str>) -> Result<String, Failure> {
    let config =
        stored(client, None)?.read().map_err(|why| client.refused(format!("its configuration: {why}")))?;
    let mut events = client.stream(&path(port))?;
    let watch = Watch::new();
    let scope = Scope { port: port.map(str::to_owned), links: false };
    let refused = |error: std::io::Error| Failure::wrong(format!("{}: {error}", place.display()));
    let capture = CaptureFile::start(&watch, scope, Target::Path(PathBuf::from(place))).map_err(refused)?;
    let (mut began, mut count, mut lost) = (false, 0_u64, 0_u64);
    let ended = loop {
        let event = match events.next() {
            Ok(Some(event)) => event,
            Ok(None) => break Ok(()),
            Err(failure) => break Err(failure),
        };
        if event.name != "frames" {
            continue;
        }
        let Ok(document) = serde_json::from_str::<FramesDocument>(&event.data) else {
            break Err(client.refused("an event `frames` has another form"));
        };
        if !began && let Some(first) = document.frames.first() {
            began = true;
            let cell = match cell(&config, first.time_us) {
                Ok(cell) => cell,
                Err(why) => break Err(client.refused(why)),
            };
            let at = Instant::from_micros(first.time_us);
            watch.give(Record { at, lost: 0, what: What::Began(Arc::new(cell)) });
        }
        lost += document.lost;
        let mut missing = u32::try_from(document.lost).unwrap_or(u32::MAX);
        for shown in &document.frames {
            let known = config.view().field_ports().find(|(_, known, _)| *known.name == *shown.port);
            let Some((index, ..)) = known else { continue };
            let Some(frame) = shown.frame(proto_core::engine::PortId(index)) else { continue };
            let at = Instant::from_micros(shown.time_us);
            watch.give(Record { at, lost: std::mem::take(&mut missing), what: What::Frame(frame) });
            count += 1;
        }
    };
    watch.close();
    capture.finish();
    ended?;
    let lost = if lost > 0 { format!(", {lost} lost") } else { String::new() };
    Ok(format!("{count} frames{lost}"))
}

/// The ports of a gateway whose clock is at `time_us` now.
fn cell(config: &GatewayConfig, time_us: u64) -> Result<Cell, String> {
    let engine = Box::new(Engine::<MAX_PORTS>::new(config).map_err(|error| error.to_string())?);
    let epoch = Epoch { at: Instant::from_micros(time_us), wall: SystemTime::now() };
    // A capture has no names of frames.
    Ok(Cell::new(config, &*engine, epoch, Arc::default()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_blocks_are_written() {
        let block = |len: u32| {
            let mut bytes = vec![0x0A, 0x0D, 0x0D, 0x0A];
            bytes.extend(len.to_le_bytes());
            bytes.resize(len as usize, 7);
            bytes
        };
        let two = [block(28), block(12)].concat();
        for cut in 0..=two.len() {
            let whole = if cut < 28 {
                0
            } else if cut < 40 {
                28
            } else {
                40
            };
            assert_eq!(whole_blocks(&two[..cut]), Some(whole), "{cut}");
        }
        let len = |len: u32| [[1, 0, 0, 0], len.to_le_bytes()].concat();
        for wrong in [0, 8, 13, u32::MAX] {
            assert_eq!(whole_blocks(&len(wrong)), None, "{wrong}");
        }
    }
}
