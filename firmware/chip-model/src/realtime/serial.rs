//! An RS-485 line whose other end is a socket. Received bytes appear on the line in the format that the chip's
//! UART is set to; sent bytes go out when the line has transmitted them.
//!
//! The line has four wires, since a socket has two directions: what both sides send at once is not lost. The
//! tests in virtual time check the timing of driver-enable.

use std::collections::VecDeque;

use rustix::event::PollFd;

use super::socket::{Client, Listener};
use crate::device::*;
use crate::models::usart::Usart;

/// How far ahead characters are scheduled: more than one slice of the chip's run.
const AHEAD: Picos = 2 * MILLI;
/// Bytes that wait for the line; more stay in the socket.
const WAITING: usize = 4096;

/// The line's other end.
#[derive(Debug)]
pub(super) struct Serial {
    listener: Listener,
    clients: Vec<Client>,
    waiting: VecDeque<u8>,
    /// End of the last scheduled character.
    free_at: Picos,
    /// Bytes to the chip.
    pub(super) bytes_in: u64,
    /// Bytes from the chip.
    pub(super) bytes_out: u64,
}

impl Serial {
    /// A line whose clients connect to `listener`.
    pub(super) fn new(listener: Listener) -> Self {
        Self {
            listener,
            clients: Vec::new(),
            waiting: VecDeque::new(),
            free_at: 0,
            bytes_in: 0,
            bytes_out: 0,
        }
    }

    /// Moves bytes both ways.
    pub(super) fn exchange(&mut self, usart: &mut Usart, clocks: Clocks, now: Picos) {
        self.clients.extend(std::iter::from_fn(|| self.listener.accept()));
        let sent =
            usart.line.take_sent().filter(|character| character.is_driven).map(|character| character.byte);
        let sent: Vec<u8> = sent.collect();
        self.bytes_out += sent.len() as u64;
        for client in &mut self.clients {
            client.write(&sent);
            let room = WAITING.saturating_sub(self.waiting.len());
            self.waiting.extend(client.read(room));
        }
        self.clients.retain(|client| !client.is_gone());
        if !usart.is_on() {
            // The UART receives nothing while it is disabled.
            self.waiting.clear();
            return;
        }
        usart.line.has_four_wires = true;
        let format = usart.format(clocks);
        while self.free_at < now + AHEAD
            && let Some(byte) = self.waiting.pop_front()
        {
            self.free_at = usart.line.send(self.free_at.max(now), &[byte], format);
            self.bytes_in += 1;
        }
    }

    /// Whether bytes wait for the line.
    pub(super) fn is_busy(&self) -> bool {
        !self.waiting.is_empty()
    }

    pub(super) fn poll<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        fds.push(self.listener.poll());
        fds.extend(self.clients.iter().map(|client| client.poll(self.waiting.len() < WAITING)));
    }
}
