//! The receiving side of a port: bytes, datagrams and CAN frames to registers or to a program.

use std::collections::VecDeque;
use std::net::SocketAddr;

use proto_core::recipe::model::Mode;
use proto_core::recipe::{CanReject, datagram};
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar;

use super::recipe::PartLayouts;
use super::{Medium, RecipePort, Transmitter};
use crate::counters::RecipePortCounters;
use crate::registers::Registers;

/// A frame of a user recipe, for a program.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Received {
    pub(crate) id: Option<CanId>,
    pub(crate) values: Vec<Scalar>,
}

impl RecipePort {
    /// Handles bytes of the stream, or one datagram.
    pub(crate) fn receive(
        &mut self,
        now: Instant,
        bytes: &[u8],
        registers: &mut Registers,
        listening: Listening,
    ) {
        self.counters.bytes_in += bytes.len() as u64;
        if self.transmitter == Transmitter::Sending && matches!(self.medium, Medium::Rs485 { .. }) {
            self.counters.bytes_while_sending += bytes.len() as u64;
        }
        let Some((mode, PartLayouts::Stream { input: Some(layout), .. })) = &self.recipe else {
            self.counters.unexpected_bytes += bytes.len() as u64;
            return;
        };
        let gap = match self.medium {
            Medium::Rs485 { idle_gap, .. } => idle_gap,
            _ => IDLE_GAP,
        };
        let silence = now.saturating_since(self.newest_byte);
        self.newest_byte = now;
        let mut sink =
            Sink { mode: *mode, listening, registers, inbox: &mut self.inbox, counters: &mut self.counters };
        match self.medium {
            Medium::UdpServer(_) | Medium::UdpClient => match datagram(layout, bytes) {
                Ok(payload) => sink.take(
                    None,
                    |image| layout.apply(payload, image).map(|applied| applied.masked),
                    || layout.check(payload).map(|()| layout.values(payload).collect()),
                ),
                Err(_) => self.counters.wrong_datagrams += 1,
            },
            _ => {
                if silence >= gap {
                    self.deframer.discard();
                }
                let mut rest = bytes;
                while let Some(payload) = self.deframer.next_frame(layout, &mut rest) {
                    sink.take(
                        None,
                        |image| layout.apply(payload, image).map(|applied| applied.masked),
                        || layout.check(payload).map(|()| layout.values(payload).collect()),
                    );
                }
            }
        }
    }

    pub(crate) fn client_sent(&mut self, now: Instant, peer: SocketAddr) {
        self.forget_silent(now);
        if let Medium::UdpServer(clients) = &mut self.medium
            && clients.add(now, peer)
        {
            self.counters.clients_displaced += 1;
        }
    }

    /// Removes silent clients, if they should send because the recipe has an input part (D30).
    pub(crate) fn forget_silent(&mut self, now: Instant) {
        if let Medium::UdpServer(clients) = &mut self.medium
            && self.recipe.as_ref().is_some_and(|(_, parts)| parts.has_input())
        {
            self.counters.clients_silent += clients.forget_silent(now) as u64;
        }
    }

    /// `peer` cannot be reached any more.
    pub(crate) fn unreachable(&mut self, peer: SocketAddr) {
        if let Medium::UdpServer(clients) = &mut self.medium
            && clients.unreachable(peer)
        {
            self.counters.clients_gone += 1;
        }
    }

    /// Handles a frame from the CAN bus.
    pub(crate) fn receive_can(&mut self, frame: &CanFrame, registers: &mut Registers, listening: Listening) {
        self.counters.bytes_in += frame.data().len() as u64;
        let Some((mode, PartLayouts::Can { input: Some(layout), .. })) = &self.recipe else {
            self.counters.unknown_ids += 1;
            return;
        };
        let accepted = match layout.accept(frame) {
            Ok(index) => layout.frame(index),
            Err(CanReject::Remote { .. }) => {
                self.counters.remote_frames += 1;
                return;
            }
            Err(CanReject::WrongLength { .. }) => {
                self.counters.wrong_lengths += 1;
                return;
            }
            Err(_) => {
                self.counters.unknown_ids += 1;
                return;
            }
        };
        let Some(part) = accepted else { return };
        let mut sink =
            Sink { mode: *mode, listening, registers, inbox: &mut self.inbox, counters: &mut self.counters };
        sink.take(
            Some(part.id()),
            |image| part.apply(frame.data(), image).map(|applied| applied.masked),
            || part.check(frame.data()).map(|()| part.values(frame.data()).collect()),
        );
    }

    pub(crate) fn next_received(&mut self) -> Option<Received> {
        self.inbox.pop_front()
    }

    /// Drops frames that wait for a program that has ended.
    pub(crate) fn forget_received(&mut self) {
        self.inbox.clear();
    }

    /// Whether a program can receive from this port.
    pub(crate) fn check_receive(&self) -> Result<(), String> {
        match &self.recipe {
            Some((
                Mode::User,
                PartLayouts::Stream { input: Some(_), .. } | PartLayouts::Can { input: Some(_), .. },
            )) => Ok(()),
            _ => Err(format!("{} has no user-defined recipe with an input part", self.name)),
        }
    }
}

/// Whether a program runs that may receive frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Listening {
    Yes,
    No,
}

/// The destination of accepted frames.
struct Sink<'a> {
    mode: Mode,
    listening: Listening,
    registers: &'a mut Registers,
    inbox: &'a mut VecDeque<Received>,
    counters: &'a mut RecipePortCounters,
}

impl Sink<'_> {
    fn take<E>(
        &mut self,
        id: Option<CanId>,
        apply: impl FnOnce(&mut [u8; IMAGE_BYTES]) -> Result<u16, E>,
        values: impl FnOnce() -> Result<Vec<Scalar>, E>,
    ) {
        self.counters.frames_in += 1;
        match self.mode {
            Mode::Realtime => match self.registers.write_inputs(apply) {
                Ok(masked) => self.counters.masked_fields += u64::from(masked),
                Err(_) => self.counters.rejected_values += 1,
            },
            Mode::User => match values() {
                Err(_) => self.counters.rejected_values += 1,
                Ok(_) if self.listening == Listening::No => self.counters.frames_without_program += 1,
                Ok(values) => {
                    if self.inbox.len() >= MAX_INBOX {
                        self.inbox.pop_front();
                        self.counters.inbox_overflows += 1;
                    }
                    self.inbox.push_back(Received { id, values });
                }
            },
        }
    }
}

/// Maximum number of frames that wait for a program; a further frame displaces the oldest.
pub const MAX_INBOX: usize = 64;
/// Silence on TCP after which a partial frame is discarded (D19).
const IDLE_GAP: Duration = Duration::from_millis(50);
