//! The calls of the engine in an MCAP file, which may be damaged.
//!
//! In: a file of a recording ([`crate::recording`]). Out: each call with its number. Chunks are parsed here: the
//! library's reader does not check that the records in a chunk end where it does.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Read;

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, parse_record};

use crate::recording::ENGINE;

/// Receives a call and its number.
pub(crate) type Take<'t, E> = dyn FnMut(u32, &[u8]) -> Result<Then, E> + 't;

/// Whether to read on after a call.
pub(crate) enum Then {
    GoOn,
    Stop,
}

/// How the file ended.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum RecordingEnd {
    Whole,
    /// Within a record, or at something unreadable.
    Cut,
    /// The visitor returned `Stop`.
    Stopped,
}

/// Visits each call with its number.
pub(crate) fn each<E>(mut file: File, take: &mut Take<'_, E>) -> Result<RecordingEnd, E> {
    let Ok(len) = file.metadata().map(|found| found.len()) else { return Ok(RecordingEnd::Cut) };
    // The file of a killed process has no end. A damaged file may contain a length that exceeds the memory.
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_emit_chunks(true)
        .with_record_length_limit(usize::try_from(len).unwrap_or(usize::MAX));
    let mut reader = LinearReader::new_with_options(options);
    let mut channels = Channels::default();
    loop {
        match reader.next_event() {
            None => return Ok(RecordingEnd::Whole),
            Some(Err(_)) => return Ok(RecordingEnd::Cut),
            Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                let Ok(read) = file.read(reader.insert(wanted)) else { return Ok(RecordingEnd::Cut) };
                reader.notify_read(read);
            }
            Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                match channels.record(opcode, data, take)? {
                    RecordingEnd::Whole => {}
                    end => return Ok(end),
                }
            }
        }
    }
}

/// The channels of the engine's calls.
#[derive(Default)]
struct Channels(BTreeSet<u16>);

impl Channels {
    /// Reads a record, which may contain others.
    fn record<E>(&mut self, opcode: u8, data: &[u8], take: &mut Take<'_, E>) -> Result<RecordingEnd, E> {
        if !matches!(opcode, op::CHANNEL | op::MESSAGE | op::CHUNK) {
            return Ok(RecordingEnd::Whole);
        }
        match parse_record(opcode, data) {
            Err::<_, McapError>(_) => return Ok(RecordingEnd::Cut),
            Ok(Record::Channel(channel)) => {
                if channel.topic == ENGINE {
                    self.0.insert(channel.id);
                } else {
                    self.0.remove(&channel.id);
                }
            }
            Ok(Record::Message { header, data }) if self.0.contains(&header.channel_id) => {
                if let Then::Stop = take(header.sequence, &data)? {
                    return Ok(RecordingEnd::Stopped);
                }
            }
            // Chunks of a recording are not compressed.
            Ok(Record::Chunk { header, data }) if header.compression.is_empty() => {
                return self.chunk(&data, take);
            }
            Ok(Record::Chunk { .. }) => return Ok(RecordingEnd::Cut),
            Ok(_) => {}
        }
        Ok(RecordingEnd::Whole)
    }

    fn chunk<E>(&mut self, mut rest: &[u8], take: &mut Take<'_, E>) -> Result<RecordingEnd, E> {
        while let Some((opcode, behind)) = rest.split_first() {
            let Some((len, behind)) = behind.split_first_chunk() else { return Ok(RecordingEnd::Cut) };
            let len = usize::try_from(u64::from_le_bytes(*len)).unwrap_or(usize::MAX);
            let Some((data, behind)) = behind.split_at_checked(len) else { return Ok(RecordingEnd::Cut) };
            rest = behind;
            // Chunks are not nested.
            if *opcode == op::CHUNK {
                return Ok(RecordingEnd::Cut);
            }
            match self.record(*opcode, data, take)? {
                RecordingEnd::Whole => {}
                end => return Ok(end),
            }
        }
        Ok(RecordingEnd::Whole)
    }
}
