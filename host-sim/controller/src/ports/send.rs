//! The sending side of a port: output frames on the grid, and frames of a program.

use proto_core::recipe::EncodeError;
use proto_core::recipe::model::{MAX_STREAM_FRAME, Mode};
use proto_core::schedule::Grid;
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use proto_core::wire::scalar::{Scalar, ScalarType};

use super::recipe::{self, PartLayouts};
use super::{Medium, RecipePort, Transmitter};
use std::net::SocketAddr;

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum PortData {
    Bytes(Vec<u8>),
    Can(CanFrame),
    Datagram { peer: SocketAddr, bytes: Vec<u8> },
}

/// What a port did with a program's frame (D28).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Handed {
    /// It sends the frame.
    Over,
    /// It is not connected, and dropped the frame.
    NotReady,
}

impl RecipePort {
    /// Whether the last frame of a program has not been sent yet.
    pub(crate) fn is_busy(&self) -> bool {
        self.transmitter != Transmitter::Idle
    }

    /// Queues a program's frame, which was sent once [`Self::is_busy`] is false again.
    ///
    /// # Errors
    /// What is wrong with the recipe, the id or the values, even if the port is not connected.
    pub(crate) fn send(&mut self, id: Option<i64>, values: &[f64]) -> Result<Handed, String> {
        let name = &self.name;
        let Some((Mode::User, parts)) = &self.recipe else {
            return Err(format!("{name} has no user-defined recipe"));
        };
        let outgoing = match (parts, id) {
            (PartLayouts::Stream { output: Some(layout), .. }, None) => {
                let values = typed(name, values, layout.fields().map(|placed| placed.field.ty()))?;
                let mut out = vec![0; layout.frame_len()];
                layout.encode_values(&values, &mut out).map_err(|error| refused(name, error))?;
                PortData::Bytes(out)
            }
            (PartLayouts::Can { output: Some(layout), .. }, id) => {
                let index = match id {
                    Some(id) => recipe::frame_of(layout, id)
                        .ok_or_else(|| format!("{name}: id {id} is not in the recipe's output part"))?,
                    None if layout.frame_count() == 1 => 0,
                    None => return Err(format!("{name}: the output part has several ids; give one")),
                };
                let part = layout.frame(index).ok_or_else(|| format!("{name}: no such frame"))?;
                let values = typed(name, values, part.fields().map(|placed| placed.field.ty()))?;
                PortData::Can(part.encode_values(&values).map_err(|error| refused(name, error))?)
            }
            (PartLayouts::Stream { output: Some(_), .. }, Some(_)) => {
                return Err(format!("{name} carries a stream recipe: comm_send takes no frame id"));
            }
            _ => return Err(format!("{name}: the recipe has no output part")),
        };
        if !self.up {
            return Ok(Handed::NotReady);
        }
        self.transmitter = Transmitter::Waiting(outgoing);
        Ok(Handed::Over)
    }

    pub(crate) fn deadline(&self) -> Option<Instant> {
        let grid = self.grid.as_ref().map(Grid::next);
        let waiting = match self.transmitter {
            Transmitter::CycleDue | Transmitter::Waiting(_) => Some(self.quiet_at()),
            Transmitter::Idle | Transmitter::Sending => None,
        };
        [grid, waiting].into_iter().flatten().min()
    }

    pub(crate) fn poll(&mut self, now: Instant, image: &[u8; IMAGE_BYTES]) -> Vec<PortData> {
        if let Some(missed) = self.grid.as_mut().and_then(|grid| grid.due(now)) {
            self.counters.skipped_cycles += missed;
            match self.transmitter {
                Transmitter::Idle => self.transmitter = Transmitter::CycleDue,
                _ => self.counters.skipped_cycles += 1,
            }
        }
        if now < self.quiet_at() {
            return Vec::new();
        }
        match std::mem::replace(&mut self.transmitter, Transmitter::Idle) {
            Transmitter::CycleDue => {
                self.forget_silent(now);
                let frames = self.cycle_frames(image);
                // Datagrams are sent at once; otherwise the driver reports the end.
                if !frames.is_empty() && !matches!(self.medium, Medium::UdpServer(_) | Medium::UdpClient) {
                    self.transmitter = Transmitter::Sending;
                }
                self.count_out(&frames);
                frames
            }
            Transmitter::Waiting(frame) => {
                self.transmitter = Transmitter::Sending;
                let frames = vec![frame];
                self.count_out(&frames);
                frames
            }
            other => {
                self.transmitter = other;
                Vec::new()
            }
        }
    }

    /// The frames of the output part with the present values.
    fn cycle_frames(&self, image: &[u8; IMAGE_BYTES]) -> Vec<PortData> {
        match &self.recipe {
            Some((_, PartLayouts::Stream { output: Some(layout), .. })) => {
                let mut out = [0; MAX_STREAM_FRAME];
                let len = layout.encode(image, &mut out).unwrap_or(0);
                let bytes = out.get(..len).unwrap_or(&[]);
                match &self.medium {
                    Medium::UdpServer(clients) => clients
                        .iter()
                        .map(|peer| PortData::Datagram { peer, bytes: bytes.to_vec() })
                        .collect(),
                    _ => vec![PortData::Bytes(bytes.to_vec())],
                }
            }
            Some((_, PartLayouts::Can { output: Some(layout), .. })) => {
                layout.frames().map(|frame| PortData::Can(frame.encode(image))).collect()
            }
            _ => Vec::new(),
        }
    }

    fn count_out(&mut self, frames: &[PortData]) {
        self.counters.frames_out += frames.len() as u64;
        for frame in frames {
            self.counters.bytes_out += match frame {
                PortData::Bytes(bytes) | PortData::Datagram { bytes, .. } => bytes.len(),
                PortData::Can(frame) => frame.data().len(),
            } as u64;
        }
    }

    /// When sending is allowed: on a half-duplex line, after the turnaround.
    fn quiet_at(&self) -> Instant {
        match self.medium {
            Medium::Rs485 { turnaround, .. } if self.counters.bytes_in > 0 => self.newest_byte + turnaround,
            _ => Instant::ZERO,
        }
    }
}

fn refused(name: &str, error: EncodeError) -> String {
    format!("{name}: {error}")
}

/// Converts a program's numbers to the types of the fields.
fn typed(
    name: &str,
    values: &[f64],
    types: impl Iterator<Item = ScalarType> + Clone,
) -> Result<Vec<Scalar>, String> {
    let count = types.clone().count();
    if values.len() != count {
        return Err(format!("{name}: the frame has {count} fields, {} values were given", values.len()));
    }
    let convert = |(ty, &value)| Scalar::from_f64(ty, value).map_err(|error| format!("{name}: {error}"));
    types.zip(values).map(convert).collect()
}
