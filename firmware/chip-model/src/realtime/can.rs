//! A CAN bus whose other nodes are slcan clients (proto-core/docs/wire/slcan.md). Their frames take their time on
//! the bus, one after the other. The chip's frames are acknowledged while a client's channel is open to send.

use std::collections::VecDeque;

use embedded_can::Frame as _;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::slcan::{Channel, ChannelState};
use rustix::event::PollFd;

use super::socket::{Client, Listener};
use crate::device::*;
use crate::models::can_bus::{Attempt, BusFault, Frame};
use crate::models::fdcan::Fdcan;

/// How far ahead frames are scheduled: more than one slice of the chip's run.
const AHEAD: Picos = 2 * MILLI;
/// Frames that wait for the bus; more stay in the sockets.
const WAITING: usize = 64;
/// Bytes per read.
const CHUNK: usize = 512;

/// The bus' other nodes.
#[derive(Debug)]
pub(super) struct Can {
    listener: Listener,
    nodes: Vec<Node>,
    joined: u64,
    waiting: VecDeque<(u64, CanFrame)>,
    /// Frames on the bus: sender, frame, end.
    crossing: VecDeque<(u64, CanFrame, Picos)>,
    free_at: Picos,
    /// Frames to the chip.
    pub(super) frames_in: u64,
    /// Frames from the chip.
    pub(super) frames_out: u64,
}

#[derive(Debug)]
struct Node {
    number: u64,
    client: Client,
    channel: Option<Channel>,
    unread: Vec<u8>,
}

impl Can {
    /// A bus whose clients connect to `listener`.
    pub(super) fn new(listener: Listener) -> Self {
        Self {
            listener,
            nodes: Vec::new(),
            joined: 0,
            waiting: VecDeque::new(),
            crossing: VecDeque::new(),
            free_at: 0,
            frames_in: 0,
            frames_out: 0,
        }
    }

    /// Moves frames both ways.
    pub(super) fn exchange(&mut self, can: &mut Fdcan, clocks: Clocks, now: Picos) {
        while let Some(client) = self.listener.accept() {
            self.joined += 1;
            self.nodes.push(Node { number: self.joined, client, channel: None, unread: Vec::new() });
        }
        let bit = can.bit(clocks);
        let bitrate = bit.map_or(0, |bit| (SECOND / bit) as u32);
        for node in &mut self.nodes {
            node.read(bitrate, &mut self.waiting);
        }
        for (at, frame) in can.bus.sent.drain(..) {
            self.frames_out += 1;
            let frame = to_core(&frame);
            self.nodes.iter_mut().for_each(|node| node.deliver(&frame, at));
        }
        while let Some((from, frame, at)) = self.crossing.pop_front_if(|(.., at)| *at <= now) {
            let others = self.nodes.iter_mut().filter(|node| node.number != from);
            others.for_each(|node| node.deliver(&frame, at));
        }
        while self.free_at < now + AHEAD
            && let Some(bit) = bit
            && let Some((from, frame)) = self.waiting.pop_front()
        {
            let sent = from_core(&frame);
            self.free_at = self.free_at.max(now) + sent.bits(Attempt::Acknowledged) * bit;
            can.bus.send(self.free_at, sent);
            self.frames_in += 1;
            self.crossing.push_back((from, frame, self.free_at));
        }
        self.nodes.retain(|node| !node.client.is_gone());
        let can_acknowledge = self.nodes.iter().any(Node::is_open);
        can.bus.fault = if can_acknowledge { BusFault::None } else { BusFault::NoAcknowledge };
    }

    /// Frames wait for the bus.
    pub(super) fn is_busy(&self) -> bool {
        !self.waiting.is_empty() || !self.crossing.is_empty()
    }

    pub(super) fn poll<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        fds.push(self.listener.poll());
        let has_room = self.waiting.len() < WAITING;
        fds.extend(self.nodes.iter().map(|node| node.client.poll(has_room && node.unread.is_empty())));
    }
}

impl Node {
    fn is_open(&self) -> bool {
        self.channel.as_ref().is_some_and(|channel| channel.state() == ChannelState::Open)
    }

    fn read(&mut self, bitrate: u32, waiting: &mut VecDeque<(u64, CanFrame)>) {
        self.client.flush();
        if self.unread.is_empty() && waiting.len() < WAITING {
            self.unread = self.client.read(CHUNK);
        }
        if self.unread.is_empty() {
            return;
        }
        let channel = self.channel.get_or_insert_with(|| Channel::new(bitrate));
        let mut rest = self.unread.as_slice();
        while waiting.len() < WAITING
            && let Some(reaction) = channel.receive(&mut rest)
        {
            self.client.write(reaction.answer);
            waiting.extend(reaction.frame.map(|frame| (self.number, frame)));
        }
        self.unread = rest.to_vec();
    }

    fn deliver(&mut self, frame: &CanFrame, at: Picos) {
        let Some(channel) = &mut self.channel else { return };
        match channel.deliver(frame, at / MILLI) {
            Some(line) if self.client.has_room() => self.client.write(&line),
            Some(_) => channel.note_overrun(),
            None => {}
        }
    }
}

fn to_core(frame: &Frame) -> CanFrame {
    let id = if frame.is_extended { CanId::Extended(frame.id) } else { CanId::Standard(frame.id as u16) };
    let made = if frame.is_remote {
        CanFrame::remote(id, usize::from(frame.len.min(8)))
    } else {
        CanFrame::new(id, frame.bytes())
    };
    made.expect("the model makes no other frames")
}

fn from_core(frame: &CanFrame) -> Frame {
    let (id, is_extended) = match CanFrame::id(frame) {
        CanId::Standard(id) => (id.into(), false),
        CanId::Extended(id) => (id, true),
    };
    let mut data = [0; 8];
    data[..frame.data().len()].copy_from_slice(frame.data());
    Frame { id, is_extended, is_remote: frame.is_remote_frame(), len: frame.dlc() as u8, data }
}
