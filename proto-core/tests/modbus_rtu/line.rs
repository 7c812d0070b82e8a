//! A line in virtual time: each byte takes its time, and everyone hears the others.

use proto_core::modbus::rtu::{
    Echo, Exchange, Failure, MAX_ADU, Master, Operation, Output, Reply, Slave, SlaveStatus, Timing, When,
};
use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::time::{Duration, Instant};

pub(crate) const MS: fn(u64) -> Duration = Duration::from_millis;

/// Registers that name their slave and their address until they are written.
#[derive(Debug, Clone)]
pub(crate) struct Bank {
    pub(crate) words: Vec<u16>,
    pub(crate) coils: Vec<bool>,
}

pub(crate) fn original(slave: u8, address: u16) -> u16 {
    u16::from(slave) << 8 | address
}

impl Bank {
    pub(crate) fn new(slave: u8) -> Self {
        Self { words: (0..200).map(|at| original(slave, at)).collect(), coils: vec![false; 200] }
    }
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let at = usize::from(address);
        let coils = self.coils.get(at..at + usize::from(count)).ok_or(Exception::IllegalDataAddress)?;
        coils.iter().enumerate().for_each(|(nth, on)| packed[nth / 8] |= u8::from(*on) << (nth % 8));
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let at = usize::from(address);
        let target = self.coils.get_mut(at..at + usize::from(coils.count()));
        let target = target.ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let at = usize::from(address);
        let values = self.words.get(at..at + words.len()).ok_or(Exception::IllegalDataAddress)?;
        words.iter_mut().zip(values).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        let at = usize::from(address);
        let target = self.words.get_mut(at..at + usize::from(registers.count()));
        let target = target.ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(registers.iter()).for_each(|(word, value)| *word = value);
        Ok(())
    }
}

/// A slave of the line and what is wrong with it.
pub(crate) struct Node {
    pub(crate) address: u8,
    pub(crate) slave: Slave,
    pub(crate) bank: Bank,
    /// From the end of the request's silence to the first byte of the reply.
    pub(crate) delay: Duration,
    pub(crate) alive: bool,
    /// Replies that are still to come with a wrong CRC.
    pub(crate) garble: u32,
    /// Sends this many false bytes in place of a reply.
    pub(crate) babble: usize,
    replies: Vec<(Instant, Vec<u8>)>,
}

/// What the master told, and when.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Told {
    Sent(Vec<u8>),
    Registers(usize, Vec<u16>),
    Coils(usize, Vec<bool>),
    Written(usize),
    Broadcast(usize),
    Failed(usize, Failure),
}

pub(crate) struct Line {
    pub(crate) now: Instant,
    pub(crate) timing: Timing,
    pub(crate) master: Master<64>,
    pub(crate) nodes: Vec<Node>,
    pub(crate) told: Vec<(Instant, Told)>,
    /// What each writing exchange writes; nothing for those that are not here.
    pub(crate) values: Vec<(usize, Vec<u8>)>,
    echo: Echo,
    /// When bytes arrive, and from which node; `None` from the master.
    wire: Vec<(Instant, Option<usize>, Vec<u8>)>,
    /// Until when the line is in use.
    used: Instant,
    pub(crate) collisions: u32,
}

/// Bytes that arrive at once, as from a buffer of the hardware: fewer than a silence has.
const CHUNK: usize = 3;

impl Line {
    pub(crate) fn new(timing: Timing, echo: Echo, addresses: &[u8], table: &[Exchange]) -> Self {
        let node = |&address| Node {
            address,
            slave: Slave::new(timing, echo, address).unwrap(),
            bank: Bank::new(address),
            delay: MS(1),
            alive: true,
            garble: 0,
            babble: 0,
            replies: Vec::new(),
        };
        Self {
            now: Instant::ZERO,
            timing,
            master: Master::new(timing, echo, table, Instant::ZERO).unwrap(),
            nodes: addresses.iter().map(node).collect(),
            told: Vec::new(),
            values: Vec::new(),
            echo,
            wire: Vec::new(),
            used: Instant::ZERO,
            collisions: 0,
        }
    }

    pub(crate) fn node(&mut self, address: u8) -> &mut Node {
        self.nodes.iter_mut().find(|node| node.address == address).unwrap()
    }

    pub(crate) fn status(&self, address: u8) -> SlaveStatus {
        self.master.slaves().find(|slave| slave.address == address).unwrap()
    }

    pub(crate) fn request(&mut self, exchange: usize) {
        assert!(self.master.request(exchange, self.now));
    }

    /// Lets time pass.
    pub(crate) fn run(&mut self, span: Duration) {
        let end = self.now + span;
        loop {
            self.at_this_instant();
            let next = self.next_event();
            if next > end {
                self.now = end;
                return;
            }
            self.now = next.max(self.now + Duration::from_micros(1));
        }
    }

    /// What was told since the last call.
    pub(crate) fn take_told(&mut self) -> Vec<Told> {
        self.told.drain(..).map(|(_, told)| told).collect()
    }

    /// When requests to `slave` were sent.
    pub(crate) fn sent_to(&self, slave: u8) -> Vec<Instant> {
        let to_it = |told: &Told| matches!(told, Told::Sent(frame) if frame[0] == slave);
        self.told.iter().filter(|(_, told)| to_it(told)).map(|(at, _)| *at).collect()
    }

    /// How often `exchange` was answered with data or an acknowledgement.
    pub(crate) fn replies(&self, exchange: usize) -> usize {
        let is_reply = |told: &Told| {
            matches!(told,
                Told::Registers(of, _) | Told::Coils(of, _) | Told::Written(of) if *of == exchange)
        };
        self.told.iter().filter(|(_, told)| is_reply(told)).count()
    }

    fn next_event(&self) -> Instant {
        let nodes = self
            .nodes
            .iter()
            .map(|node| node.replies.iter().map(|(at, _)| *at).fold(node.slave.deadline(), Instant::min));
        let wire = self.wire.iter().map(|(at, ..)| *at);
        nodes.chain(wire).fold(self.master.deadline(), Instant::min)
    }

    fn at_this_instant(&mut self) {
        let now = self.now;
        let (arrived, wire) = self.wire.drain(..).partition(|(at, ..)| *at <= now);
        self.wire = wire;
        for (_, from, bytes) in arrived {
            let hears_itself = self.echo == Echo::Heard;
            if from.is_some() || hears_itself {
                self.master.received(&bytes, now);
            }
            for (nth, node) in self.nodes.iter_mut().enumerate() {
                if from != Some(nth) || hears_itself {
                    node.slave.received(&bytes, now);
                }
            }
        }
        let mut out = [0xA5; MAX_ADU];
        let mut sending = Vec::new();
        for (nth, node) in self.nodes.iter_mut().enumerate() {
            if let Some(len) = node.slave.poll(now, &mut node.bank, &mut out)
                && node.alive
            {
                let mut reply = out[..len].to_vec();
                if node.garble > 0 {
                    node.garble -= 1;
                    *reply.last_mut().unwrap() ^= 0x10;
                }
                if node.babble > 0 {
                    reply = (0..node.babble).map(|at| (at * 37 + 11) as u8).collect();
                }
                node.replies.push((now + node.delay, reply));
            }
            let (due, later) = node.replies.drain(..).partition(|(at, _)| *at <= now);
            node.replies = later;
            let due: Vec<(Instant, Vec<u8>)> = due;
            sending.extend(due.into_iter().map(|(_, reply)| (Some(nth), reply)));
        }
        for (from, bytes) in sending {
            self.transmit(from, &bytes);
        }
        self.poll_master();
    }

    fn poll_master(&mut self) {
        let (now, values) = (self.now, self.values.clone());
        let fill = |exchange: usize, data: &mut [u8]| {
            assert!(data.iter().all(|&byte| byte == 0));
            match values.iter().find(|(of, _)| *of == exchange) {
                Some((_, value)) => data.copy_from_slice(value),
                None if data.is_empty() => {}
                None => return false,
            }
            true
        };
        let mut out = [0xA5; MAX_ADU];
        let mut sent = None;
        while let Some(output) = self.master.poll(now, fill, &mut out) {
            let told = match output {
                Output::Send(len) => {
                    assert!(sent.is_none(), "two requests at once");
                    sent = Some(len);
                    continue;
                }
                Output::Reply { exchange, reply: Reply::Registers(words) } => {
                    Told::Registers(exchange, words.iter().collect())
                }
                Output::Reply { exchange, reply: Reply::Coils(coils) } => {
                    Told::Coils(exchange, coils.iter().collect())
                }
                Output::Reply { exchange, reply: Reply::Written } => Told::Written(exchange),
                Output::Broadcast { exchange } => Told::Broadcast(exchange),
                Output::Failed { exchange, failure } => Told::Failed(exchange, failure),
                other => panic!("{other:?}"),
            };
            self.told.push((now, told));
        }
        if let Some(len) = sent {
            self.told.push((now, Told::Sent(out[..len].to_vec())));
            self.transmit(None, &out[..len]);
        }
    }

    fn transmit(&mut self, from: Option<usize>, bytes: &[u8]) {
        self.collisions += u32::from(self.now < self.used);
        let mut at = self.now;
        for chunk in bytes.chunks(CHUNK) {
            at += self.timing.of(chunk.len());
            self.wire.push((at, from, chunk.to_vec()));
        }
        self.used = self.used.max(at);
    }
}

pub(crate) fn read(slave: u8, address: u16, count: u16, period: u64) -> Exchange {
    Exchange {
        slave,
        operation: Operation::ReadHoldingRegisters { address, count },
        when: When::every(MS(period)),
        timeout: MS(30),
        retries: 0,
    }
}

pub(crate) fn write(slave: u8, address: u16, count: u16, when: When) -> Exchange {
    Exchange {
        slave,
        operation: Operation::WriteRegisters { address, count },
        when,
        timeout: MS(30),
        retries: 1,
    }
}
