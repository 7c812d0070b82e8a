//! Simulated slaves of a Modbus RTU line: all slaves that a port polls, in one device.
//!
//! In: the exchanges of a port and a seed. Out: replies, most of them right and in time. Each slave changes its
//! behaviour every few seconds: prompt, slow, late, refusing, dead, or with replies that are damaged, lost or under
//! another slave's address. No reply takes three times the timeout: after that, no master could tell it from a reply to
//! the next request (proto-core/docs/wire/modbus-rtu.md section 4).

use std::collections::BTreeMap;

use proto_core::config::{Bus, GatewayConfig, Port, Transaction};
use proto_core::modbus::rtu::{BROADCAST, Echo, MAX_ADU, Operation, Slave, Table, Timing};
use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::time::{Duration, Instant};

use super::behaviour::{Behaves, Behaviour, Change};
use crate::rtu::sealed;
use crate::{Device, Done, Rng, SlaveDone};

/// The slaves of a line.
#[derive(Debug)]
pub(super) struct Slaves {
    rng: Rng,
    slaves: Vec<OneSlave>,
    /// Replies that will be sent, and when.
    leaving: Vec<(Instant, Vec<u8>)>,
    done: Vec<SlaveDone>,
}

#[derive(Debug)]
struct OneSlave {
    address: u8,
    timing: Timing,
    slave: Slave,
    bank: Bank,
    behaves: Behaves,
    /// The shortest timeout of the slave's exchanges.
    timeout: Duration,
}

/// The registers and coils that the port reads or writes; requests for others are refused.
#[derive(Debug, Default)]
struct Bank {
    coils: BTreeMap<u16, u16>,
    discrete: BTreeMap<u16, u16>,
    holding: BTreeMap<u16, u16>,
    input: BTreeMap<u16, u16>,
    /// Registers and coils that only the master changes.
    written: Vec<(bool, u16)>,
    /// Bits of registers that another master changes.
    others: BTreeMap<u16, u16>,
    refuses: bool,
    read: std::cell::Cell<Option<(u16, u16)>>,
    wrote: Option<Done>,
}

impl Slaves {
    /// The slaves of a port; `None` if the port is not a Modbus master.
    pub(super) fn new(config: &GatewayConfig, port: &Port, start: Instant, rng: Rng) -> Option<Self> {
        let recipe = config.recipes.get(usize::from(port.recipe))?;
        let Bus::Rs485(line) = &port.bus else { return None };
        let bits = 10 + u8::from(line.parity != proto_core::config::Parity::None) + (line.stop_bits - 1);
        let timing = Timing::new(line.baud, bits);
        let mut slaves: Vec<OneSlave> = Vec::new();
        let mut to_all = Vec::new();
        for exchange in config.view().exchanges_of(recipe) {
            let Transaction::Rtu { operation, .. } = exchange.transaction else { return None };
            if exchange.peer == BROADCAST {
                to_all.push(operation);
                continue;
            }
            let nth = slaves.iter().position(|slave| slave.address == exchange.peer).unwrap_or(slaves.len());
            if nth == slaves.len() {
                slaves.push(OneSlave {
                    address: exchange.peer,
                    timing,
                    slave: Slave::new(timing, Echo::Absent, exchange.peer)?,
                    bank: Bank::default(),
                    behaves: Behaves::new(start),
                    timeout: exchange.timeout,
                });
            }
            let slave = &mut slaves[nth];
            slave.timeout = slave.timeout.min(exchange.timeout);
            slave.bank.add(&operation);
        }
        for slave in &mut slaves {
            to_all.iter().for_each(|operation| slave.bank.add(operation));
        }
        (!slaves.is_empty()).then_some(Self { rng, slaves, leaving: Vec::new(), done: Vec::new() })
    }

    /// Lets a slave execute a request and reply.
    fn answer(&mut self, nth: usize, now: Instant) {
        let rng = &mut self.rng;
        let others: Vec<u8> = self.slaves.iter().map(|slave| slave.address).collect();
        let slave = &mut self.slaves[nth];
        let address = slave.address;
        slave.bank.change(rng);
        slave.bank.refuses = slave.behaves.like == Behaviour::Refusing && rng.below(2) == 0;
        let mut out = [0; MAX_ADU];
        let len = slave.slave.poll(now, &mut slave.bank, &mut out);
        let wrote = slave.bank.wrote.take();
        let place = match &wrote {
            Some(Done::Wrote { address, values, .. }) => Some((*address, values.len() as u16)),
            _ => slave.bank.read.take(),
        };
        self.done.extend(wrote.map(|what| SlaveDone { slave: address, what }));
        let Some(len) = len else { return };
        let mut reply = out[..len].to_vec();
        let (first, count) = place.unwrap_or_default();
        let what = Done::Answered { address: first, count, reply: reply.clone() };
        self.done.push(SlaveDone { slave: address, what });
        let delay = slave.behaves.delay(slave.timeout, rng);
        let happens = rng.below(2) == 0;
        match slave.behaves.like {
            Behaviour::Damaged if happens => {
                let at = rng.below(len as u64) as usize;
                reply[at] ^= 1 << rng.below(8);
            }
            Behaviour::Short if happens => reply.truncate(rng.between(1, len as u64 - 1) as usize),
            Behaviour::Losing if happens => return,
            Behaviour::Mistaken if happens => {
                let other = others[rng.below(others.len() as u64) as usize];
                reply = sealed(&[&[other], &reply[1..len - 2]].concat());
                if other == address {
                    // An address that no slave has.
                    reply[0] = 0xFE;
                }
            }
            Behaviour::Noisy if happens => {
                let more = rng.between(1, 6) as usize;
                reply = [rng.bytes(more), reply].concat();
            }
            _ => {}
        }
        self.leaving.push((now + delay, reply));
    }
}

impl Device<Vec<u8>> for Slaves {
    fn receive(&mut self, now: Instant, bytes: &Vec<u8>) -> Vec<Vec<u8>> {
        for nth in 0..self.slaves.len() {
            let slave = &mut self.slaves[nth];
            let change = slave.behaves.update(now, &mut self.rng);
            if let Some(change) = change {
                slave.change(change);
            }
            if change == Some(Change::Forgets) {
                self.done.push(SlaveDone { slave: slave.address, what: Done::Forgot });
            }
            if slave.behaves.like != Behaviour::Dead {
                slave.slave.received(bytes, now);
            }
        }
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        let asked = self.slaves.iter().map(|slave| slave.slave.deadline());
        let leaving = self.leaving.iter().map(|(at, _)| *at);
        asked.chain(leaving).min().unwrap_or(Instant::NEVER)
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        for nth in 0..self.slaves.len() {
            if self.slaves[nth].slave.deadline() <= now {
                self.answer(nth, now);
            }
        }
        let mut leave = Vec::new();
        while let Some(nth) = self.leaving.iter().position(|(at, _)| *at <= now) {
            leave.push(self.leaving.remove(nth).1);
        }
        leave
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        std::mem::take(&mut self.done)
    }
}

impl OneSlave {
    /// Applies a new behaviour to the slave's state.
    fn change(&mut self, change: Change) {
        if change == Change::Alive {
            return;
        }
        if let Some(slave) = Slave::new(self.timing, Echo::Absent, self.address) {
            self.slave = slave;
        }
        if change == Change::Forgets {
            self.bank.forget();
        }
    }
}

impl Bank {
    fn add(&mut self, operation: &Operation) {
        let (table, first, count) = operation.place();
        let is_written = operation.written_len() > 0;
        for address in first..first.saturating_add(count) {
            let (places, is_coil) = match table {
                Table::Coils => (&mut self.coils, true),
                Table::DiscreteInputs => (&mut self.discrete, true),
                Table::HoldingRegisters => (&mut self.holding, false),
                Table::InputRegisters => (&mut self.input, false),
            };
            places.entry(address).or_default();
            if let Operation::MaskWriteRegister { mask, .. } = operation {
                *self.others.entry(address).or_insert(u16::MAX) &= !mask;
            } else if is_written && !is_coil {
                self.others.insert(address, 0);
            }
            if is_written && !self.written.contains(&(is_coil, address)) {
                self.written.push((is_coil, address));
            }
        }
    }

    /// Changes some of the values that the slave measures, and some bits that another master writes.
    fn change(&mut self, rng: &mut Rng) {
        for (address, bits) in self.others.iter().filter(|(_, bits)| **bits != 0) {
            let value = self.holding.entry(*address).or_default();
            *value = *value & !bits | rng.below(65_536) as u16 & bits;
        }
        let Self { coils, discrete, holding, input, written, .. } = self;
        for (places, is_coil) in [(coils, true), (discrete, true), (holding, false), (input, false)] {
            for (address, value) in places {
                if written.contains(&(is_coil, *address)) || rng.below(3) > 0 {
                    continue;
                }
                *value = match (is_coil, rng.below(40)) {
                    (true, 0..8) => 1 - *value,
                    (true, _) => *value,
                    // Mostly small, so most numbers of two registers fit their variables.
                    (false, 0) => rng.below(65_536) as u16,
                    (false, 1..15) => 0,
                    (false, _) => rng.below(20_000) as u16,
                };
            }
        }
    }

    fn forget(&mut self) {
        for (is_coil, address) in &self.written {
            let places = if *is_coil { &mut self.coils } else { &mut self.holding };
            places.insert(*address, 0);
        }
    }

    fn get(&self, places: &BTreeMap<u16, u16>, address: u16, count: usize) -> Result<Vec<u16>, Exception> {
        self.read.set(Some((address, count as u16)));
        if self.refuses {
            return Err(Exception::DeviceBusy);
        }
        let values = (0..count).map(|nth| places.get(&address.wrapping_add(nth as u16)).copied());
        values.collect::<Option<Vec<u16>>>().ok_or(Exception::IllegalDataAddress)
    }

    fn bits(
        &self,
        places: &BTreeMap<u16, u16>,
        address: u16,
        count: u16,
        packed: &mut [u8],
    ) -> Result<(), Exception> {
        for (nth, value) in self.get(places, address, count.into())?.into_iter().enumerate() {
            packed[nth / 8] |= u8::from(value != 0) << (nth % 8);
        }
        Ok(())
    }

    fn words(
        &self,
        places: &BTreeMap<u16, u16>,
        address: u16,
        words: &mut [[u8; 2]],
    ) -> Result<(), Exception> {
        let values = self.get(places, address, words.len())?;
        words.iter_mut().zip(values).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn put(&mut self, coils: bool, address: u16, values: Vec<u16>) -> Result<(), Exception> {
        self.read.set(Some((address, values.len() as u16)));
        if self.refuses {
            return Err(Exception::DeviceBusy);
        }
        let places = if coils { &mut self.coils } else { &mut self.holding };
        let all = address..address.saturating_add(values.len() as u16);
        if !all.clone().all(|at| places.contains_key(&at)) {
            return Err(Exception::IllegalDataAddress);
        }
        places.extend(all.zip(values.iter().copied()));
        self.wrote = Some(Done::Wrote { coils, address, values });
        Ok(())
    }
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        self.bits(&self.coils, address, count, packed)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        self.put(true, address, coils.iter().map(u16::from).collect())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        self.words(&self.holding, address, words)
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        self.put(false, address, registers.iter().collect())
    }

    fn mask_holding(&mut self, address: u16, keep: u16, value: u16) -> Result<(), Exception> {
        let [register] = self.get(&self.holding, address, 1)?[..] else {
            return Err(Exception::DeviceFailure);
        };
        self.put(false, address, vec![register & keep | value])
    }

    fn read_discrete(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        // Without a count, the caller only checks whether the function is supported.
        if count == 0 { Ok(()) } else { self.bits(&self.discrete, address, count, packed) }
    }

    fn read_input(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        if words.is_empty() { Ok(()) } else { self.words(&self.input, address, words) }
    }
}
