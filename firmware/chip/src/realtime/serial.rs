//! An RS-485 line whose other end is a socket: bytes that come in are on the line at the speed and in the format
//! that the chip's UART is set to; what the chip sent goes out when the line has carried it.
//!
//! The line has four wires, as a socket has two directions: what both send at a time is not lost. (That
//! driver-enable is where it has to be is shown by the tests in virtual time.)

use std::collections::VecDeque;

use rustix::event::PollFd;

use super::socket::{Client, Listener};
use crate::device::*;
use crate::models::usart::Usart;

/// How far the line is filled ahead: more than the chip runs at a time.
const AHEAD: Picos = 2 * MILLI;
/// Bytes that wait for the line; further ones stay in the socket.
const WAITING: usize = 4096;

/// The line's other end.
#[derive(Debug)]
pub(super) struct Serial {
    listener: Listener,
    clients: Vec<Client>,
    waiting: VecDeque<u8>,
    /// When the line has carried all that was put on it.
    free: Picos,
    /// Bytes that the chip was sent.
    pub(super) bytes_in: u64,
    /// Bytes that it has sent.
    pub(super) bytes_out: u64,
}

impl Serial {
    /// With a place to connect to.
    pub(super) fn new(listener: Listener) -> Self {
        Self { listener, clients: Vec::new(), waiting: VecDeque::new(), free: 0, bytes_in: 0, bytes_out: 0 }
    }

    /// Carries bytes both ways.
    pub(super) fn exchange(&mut self, usart: &mut Usart, clocks: Clocks, now: Picos) {
        self.clients.extend(std::iter::from_fn(|| self.listener.accept()));
        let heard = usart.line.take_sent().filter(|sent| sent.is_driven).map(|sent| sent.byte);
        let heard: Vec<u8> = heard.collect();
        self.bytes_out += heard.len() as u64;
        for client in &mut self.clients {
            client.write(&heard);
            let room = WAITING.saturating_sub(self.waiting.len());
            self.waiting.extend(client.read(room));
        }
        self.clients.retain(|client| !client.is_gone());
        if !usart.is_on() {
            // Nobody hears it.
            self.waiting.clear();
            return;
        }
        usart.line.has_four_wires = true;
        let format = usart.format(clocks);
        while self.free < now + AHEAD
            && let Some(byte) = self.waiting.pop_front()
        {
            self.free = usart.line.send(self.free.max(now), &[byte], format);
            self.bytes_in += 1;
        }
    }

    /// Bytes wait for the line.
    pub(super) fn is_busy(&self) -> bool {
        !self.waiting.is_empty()
    }

    pub(super) fn poll<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        fds.push(self.listener.poll());
        fds.extend(self.clients.iter().map(|client| client.poll(self.waiting.len() < WAITING)));
    }
}
