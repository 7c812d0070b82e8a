//! One file of a recording.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions, Writer};
use serde_json::Value;

use super::{ENGINE, ENGINE_ENCODING};

/// Bytes of a chunk. A partial chunk is lost when the process is killed.
pub(super) const CHUNK: u64 = 256 << 10;

/// One file. Whatever happens, it is readable up to the last [`RecordingPart::flush`].
pub(super) struct RecordingPart {
    writer: Writer<NoSeek<Counted>>,
    /// Number of written bytes.
    written: Arc<AtomicU64>,
    file: File,
    /// Bytes up to the last flush.
    whole: u64,
    /// Bytes of messages since the last flush.
    pending: u64,
    channels: BTreeMap<String, (u16, u32)>,
}

struct Counted {
    file: File,
    written: Arc<AtomicU64>,
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let len = self.file.write(bytes)?;
        self.written.fetch_add(len as u64, Relaxed);
        Ok(len)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl RecordingPart {
    pub(super) fn create(path: &Path, run: &str, part: u32) -> io::Result<Self> {
        let file = File::create_new(path)?;
        let written = Arc::new(AtomicU64::new(0));
        let counted = Counted { file: file.try_clone()?, written: Arc::clone(&written) };
        // A chunk is written as a whole, so a killed process leaves no chunk without its length.
        let options = WriteOptions::new()
            .compression(None)
            .profile("")
            .library("recipe gateway")
            .chunk_size(Some(CHUNK))
            .disable_seeking(true);
        let mut writer = options.create(NoSeek::new(counted)).map_err(io_error)?;
        let entries = [("run", run.to_owned()), ("part", part.to_string())];
        let metadata = entries.map(|(key, value)| (key.to_owned(), value)).into_iter().collect();
        writer.write_metadata(&Metadata { name: "recipe-gateway".into(), metadata }).map_err(io_error)?;
        let whole = written.load(Relaxed);
        Ok(Self { writer, written, file, whole, pending: 0, channels: BTreeMap::new() })
    }

    /// Bytes of the file, including bytes that were not flushed.
    pub(super) fn len(&self) -> u64 {
        self.whole.max(self.written.load(Relaxed)) + self.pending
    }

    /// Writes one call of the engine.
    pub(super) fn engine(&mut self, time: u64, sequence: u32, bytes: &[u8]) -> io::Result<()> {
        let channel = match self.channels.get(ENGINE) {
            Some(&(channel, _)) => channel,
            None => {
                let none = BTreeMap::new();
                let channel = self.writer.add_channel(0, ENGINE, ENGINE_ENCODING, &none).map_err(io_error)?;
                self.channels.insert(ENGINE.to_owned(), (channel, 0));
                channel
            }
        };
        self.write(channel, sequence, time, bytes)
    }

    /// Writes the values of a frame.
    pub(super) fn message(
        &mut self,
        topic: &str,
        title: &str,
        schema: &Value,
        time: u64,
        values: &Value,
    ) -> io::Result<()> {
        let (channel, sequence) = match self.channels.get_mut(topic) {
            Some((channel, sequence)) => {
                *sequence = sequence.wrapping_add(1);
                (*channel, *sequence)
            }
            None => {
                let text = schema.to_string();
                let schema =
                    self.writer.add_schema(title, "jsonschema", text.as_bytes()).map_err(io_error)?;
                let none = BTreeMap::new();
                let channel = self.writer.add_channel(schema, topic, "json", &none).map_err(io_error)?;
                self.channels.insert(topic.to_owned(), (channel, 0));
                (channel, 0)
            }
        };
        self.write(channel, sequence, time, values.to_string().as_bytes())
    }

    fn write(&mut self, channel_id: u16, sequence: u32, time: u64, bytes: &[u8]) -> io::Result<()> {
        let before = self.written.load(Relaxed);
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        let result = self.writer.write_to_known_channel(&header, bytes).map_err(io_error);
        if result.is_ok() && self.written.load(Relaxed) != before {
            // A whole chunk was written before this message.
            (self.whole, self.pending) = (self.written.load(Relaxed), 0);
        }
        self.pending += bytes.len() as u64 + MESSAGE_OVERHEAD;
        self.kept(result)
    }

    /// Ends the chunk: everything written so far becomes readable.
    pub(super) fn flush(&mut self) -> io::Result<()> {
        if self.pending == 0 {
            return Ok(());
        }
        let result = self.writer.flush().map_err(io_error);
        self.kept(result)?;
        (self.whole, self.pending) = (self.written.load(Relaxed), 0);
        Ok(())
    }

    pub(super) fn finish(mut self) -> io::Result<()> {
        let result = self.writer.finish().map(|_| ()).map_err(io_error);
        self.kept(result)?;
        self.file.sync_data()
    }

    /// After a failure, truncates the file to its last whole chunk.
    fn kept(&self, result: io::Result<()>) -> io::Result<()> {
        result.inspect_err(|_| {
            let _ = self.file.set_len(self.whole);
        })
    }
}

/// Record, header and index of a message.
const MESSAGE_OVERHEAD: u64 = 9 + 22 + 16;

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other.to_string()),
    }
}
