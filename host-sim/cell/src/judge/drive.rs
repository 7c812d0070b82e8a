//! The drive of `judged-drive.toml`: node 5 of a CANopen bus, with a few objects.

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};

use super::device::{Answer, Machine};
use super::rules::{Rules, Source, word};
use crate::device::Order;
use crate::{Device, Rng, SlaveDone};

pub(super) fn rules() -> Rules {
    let moves = vec![word("WordOutputReg[1]"), Source::Own(0)];
    Rules::new(moves, &["WordInputReg[1]", "WordInputReg[2]"], TIMEOUT).limit("WordOutputReg[1]", 50_000)
}

/// The drive.
#[derive(Debug)]
pub(super) struct Drive {
    machine: Machine,
    next_pdo: Instant,
}

impl Drive {
    pub(super) fn new(rng: Rng, start: Instant) -> Self {
        Self { machine: Machine::new(rng, start, TIMEOUT, true), next_pdo: start + PDO_EVERY }
    }

    fn handle(&mut self, request: [u8; 8], now: Instant) {
        let [command, low, high, sub, a, b, c, d] = request;
        let (first, second) = (u32::from(u16::from_le_bytes([a, b])), u32::from(u16::from_le_bytes([c, d])));
        let order = match (command, u16::from_le_bytes([low, high]), sub) {
            (0x2F, 0x6060, 0) => (Order::Start, vec![first]),
            (0x2B, 0x6040, 0) => (Order::Stop, vec![first]),
            (0x23, 0x607A, 0) => (Order::Move, vec![first, second]),
            (0x2B, 0x6080, 0) => (Order::Keep, vec![first]),
            (0x40, 0x6077, 0) => {
                let [own_low, own_high] = self.machine.value(1).to_le_bytes();
                let reply = vec![0x4B, low, high, sub, own_low, own_high, 0, 0];
                return self.machine.reply(reply, true, now);
            }
            _ => return self.machine.reply(vec![0x80, low, high, sub, 0, 0, 2, 6], true, now),
        };
        let reply = match self.machine.order(order.0, order.1, false) {
            Answer::Good => vec![0x60, low, high, sub, 0, 0, 0, 0],
            Answer::Refused(_) => vec![0x80, low, high, sub, 0x22, 0, 0, 8],
        };
        self.machine.reply(reply, true, now);
    }
}

impl Device<CanFrame> for Drive {
    fn receive(&mut self, now: Instant, frame: &CanFrame) -> Vec<CanFrame> {
        if frame.id() == CanId::Standard(0x605)
            && let Ok(request) = <[u8; 8]>::try_from(frame.data())
            && self.machine.is_on()
        {
            self.handle(request, now);
        }
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        self.machine.deadline().min(self.next_pdo)
    }

    fn poll(&mut self, now: Instant) -> Vec<CanFrame> {
        let (replies, _) = self.machine.poll(now);
        let mut frames: Vec<_> =
            replies.iter().filter_map(|bytes| CanFrame::new(CanId::Standard(0x585), bytes)).collect();
        if now >= self.next_pdo {
            self.next_pdo = now + PDO_EVERY;
            if self.machine.is_on() && !self.machine.is_refusing() {
                let [low, high] = self.machine.renew(0).to_le_bytes();
                frames.extend(CanFrame::new(CanId::Standard(0x185), &[low, high, 0x37, 0]));
            }
        }
        frames
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        self.machine.take_done()
    }
}

const TIMEOUT: Duration = Duration::from_millis(60);
const PDO_EVERY: Duration = Duration::from_millis(50);
