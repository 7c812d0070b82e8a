//! A CAN port on a serial line: the board acts as slcan adapter, and the slcan client is the bus
//! (proto-core/docs/wire/slcan.md).

use embedded_io_async::{Read, Write};
use heapless::Vec;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::slcan::{Channel, MAX_LINE};

use super::can_port::{BusOff, CanEvent, CanPort};
use crate::clock::now;

/// Replies and frames queued for the line.
const MAX_WAITING: usize = 512;
const CHUNK: usize = 64;

/// The adapter.
#[derive(Debug)]
pub struct SlcanPort<D> {
    line: D,
    channel: Channel,
    bitrate: u32,
    input: Vec<u8, CHUNK>,
    output: Vec<u8, MAX_WAITING>,
    /// A frame was sent and not yet reported.
    is_sending: bool,
}

impl<D: Read + Write> SlcanPort<D> {
    /// An adapter with a closed channel, on a bus of `bitrate` bit/s.
    pub fn new(line: D, bitrate: u32) -> Self {
        let channel = Channel::new(bitrate);
        Self { line, channel, bitrate, input: Vec::new(), output: Vec::new(), is_sending: false }
    }

    fn take_frame(&mut self) -> Option<CanFrame> {
        let mut rest = self.input.as_slice();
        let mut frame = None;
        // No line is processed without room for its answer.
        while frame.is_none()
            && self.output.capacity().saturating_sub(self.output.len()) > MAX_ANSWER
            && let Some(reaction) = self.channel.receive(&mut rest)
        {
            let _ = self.output.extend_from_slice(reaction.answer);
            frame = reaction.frame;
        }
        let taken = self.input.len().saturating_sub(rest.len());
        remove(&mut self.input, taken);
        frame
    }

    /// Writes all pending output. Written bytes are removed at once, so nothing is sent twice.
    async fn write_out(&mut self) {
        while !self.output.is_empty() {
            match self.line.write(&self.output).await {
                Ok(len) if len > 0 => remove(&mut self.output, len),
                // Drop the output after a failure, because there is nobody to report it to.
                _ => self.output.clear(),
            }
        }
    }
}

impl<D: Read + Write> CanPort for SlcanPort<D> {
    type Frame = CanFrame;

    async fn receive(&mut self) -> CanEvent<CanFrame> {
        if core::mem::take(&mut self.is_sending) {
            return CanEvent::Sent;
        }
        loop {
            let frame = self.take_frame();
            if let Some(frame) = frame {
                return CanEvent::Frame(frame);
            }
            self.write_out().await;
            if self.input.is_empty() {
                let mut chunk = [0; CHUNK];
                if let Ok(len) = self.line.read(&mut chunk).await {
                    // Does not fail: `input` is empty, and its capacity is that of the chunk.
                    let _ = self.input.extend_from_slice(chunk.get(..len).unwrap_or(&[]));
                }
            }
        }
    }

    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusOff> {
        if let Some(line) = self.channel.deliver(frame, now().as_micros() / 1_000) {
            if self.output.extend_from_slice(&line).is_err() {
                self.write_out().await;
                let _ = self.output.extend_from_slice(&line);
            }
            self.write_out().await;
        }
        self.is_sending = true;
        Ok(())
    }

    /// Does nothing: there is no bus-off, and pending output is written when the line accepts it.
    fn recover(&mut self) {}

    /// Does nothing: all frames of the client are received.
    fn set_filters(&mut self, _: &[CanId]) {}

    fn bitrate(&self) -> u32 {
        self.bitrate
    }
}

fn remove<const N: usize>(bytes: &mut Vec<u8, N>, count: usize) {
    let count = count.min(bytes.len());
    bytes.rotate_left(count);
    bytes.truncate(bytes.len().saturating_sub(count));
}

/// Longest answer to one line.
const MAX_ANSWER: usize = 8;

const _: () = assert!(MAX_WAITING > MAX_LINE + MAX_ANSWER);

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::convert::Infallible;

    use super::*;
    use embassy_futures::block_on;

    /// A line that brings what it was given in chunks, and keeps what was written.
    struct Script {
        chunks: VecDeque<std::vec::Vec<u8>>,
        written: std::vec::Vec<u8>,
    }

    impl embedded_io_async::ErrorType for Script {
        type Error = Infallible;
    }

    impl Read for Script {
        async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
            match self.chunks.pop_front() {
                Some(chunk) => {
                    buf[..chunk.len()].copy_from_slice(&chunk);
                    Ok(chunk.len())
                }
                None => core::future::pending().await,
            }
        }
    }

    impl Write for Script {
        async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
            let len = buf.len().min(3);
            self.written.extend(&buf[..len]);
            Ok(len)
        }

        async fn flush(&mut self) -> Result<(), Infallible> {
            Ok(())
        }
    }

    fn port(bytes: &[u8], size: usize) -> SlcanPort<Script> {
        let chunks = bytes.chunks(size).map(<[u8]>::to_vec).collect();
        SlcanPort::new(Script { chunks, written: std::vec::Vec::new() }, 500_000)
    }

    #[test]
    fn a_client_opens_sends_and_hears_however_its_bytes_are_cut() {
        let session = b"C\rS6\r\rO\rO\rt0013010203\rt0021FF\r";
        for size in 1..=session.len() {
            let mut port = port(session, size);
            for (id, data) in [(1, &[1, 2, 3][..]), (2, &[0xFF][..])] {
                let CanEvent::Frame(frame) = block_on(port.receive()) else { panic!("no frame") };
                assert_eq!(Some(frame), CanFrame::new(CanId::Standard(id), data), "chunks of {size}");
            }
            let frame = CanFrame::new(CanId::Standard(2), &[0x7D]).unwrap();
            assert_eq!(block_on(port.send(&frame)), Ok(()));
            let written = std::string::String::from_utf8(port.line.written).unwrap();
            assert_eq!(written, "\r\r\r\rz\rz\rt00217D\r", "chunks of {size}");
        }
    }

    #[test]
    fn before_it_is_opened_nothing_is_heard() {
        let mut port = port(b"", 1);
        let frame = CanFrame::new(CanId::Standard(2), &[0x7D]).unwrap();
        assert_eq!(block_on(port.send(&frame)), Ok(()));
        assert!(port.line.written.is_empty());
    }
}
