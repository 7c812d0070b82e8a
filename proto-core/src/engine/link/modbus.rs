//! The Modbus link: coalesced writes of field values, polls of values that ports show, one transaction in flight
//! (docs/engine.md section 5).

use heapless::Vec;

use super::connection::Connection;
use super::flight::Flight;
use crate::engine::OUTPUT_BUFFER;
use crate::engine::counters::{LinkCounters, bump};
use crate::engine::io::Transport;
use crate::engine::latency::Since;
use crate::engine::values::store::Store;
use crate::image::{BitSet, GroupId, InputSet};
use crate::link::{LinkTimings, Supervisor};
use crate::modbus::adu::MAX_ADU;
use crate::modbus::client::{Client, ClientEvent};
use crate::modbus::pdu::{MAX_WRITE_COILS, MAX_WRITE_REGISTERS, Request, Response};
use crate::modbus::{Coils, Registers};
use crate::schedule::Grid;
use crate::sysvar::{BIT_INPUT_COUNT, ModbusPlace, SysVar};
use crate::time::{Duration, Instant};
use crate::wire::scalar::Scalar;

/// Maximum number of blocks of neighbouring coils or registers, each polled in one request.
pub(crate) const MAX_POLL_BLOCKS: usize = 16;
/// Maximum number of polled variables.
const MAX_POLLED: usize = 64;
/// Maximum number of unneeded coils or registers that are read to join two blocks.
const JOIN_GAP: u16 = 16;
/// A request without a reply is given up after this.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
/// A safe value that the controller refused is written again after this.
const REFUSED_PAUSE: Duration = Duration::from_millis(500);
/// After this many timeouts in a row the connection is reopened.
const TIMEOUTS_IN_A_ROW: u8 = 3;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Coils,
    Registers,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    pub kind: Kind,
    pub first: u16,
    pub count: u16,
    pub group: GroupId,
    pub grid: Grid,
}

#[derive(Debug, Clone, Copy)]
enum Asked {
    Write {
        safe: InputSet,
        /// Since when the oldest value has waited.
        born: Since,
    },
    Poll {
        block: usize,
    },
}

#[derive(Debug, Clone, Copy)]
struct InFlight {
    asked: Asked,
    until: Instant,
}

/// The next write if some bits have owners.
enum Turn {
    Whole(SysVar),
    /// Consecutive bits of a variable, as a mask.
    Bits(SysVar, u8),
}

/// The result of [`ModbusLink::beside_bits`]: bits were sent, or whole variables are next.
enum Beside {
    Bits(Option<usize>),
    Whole(InputSet),
}

/// Which goes first if both a write and a poll are due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum First {
    Write,
    Poll,
}

#[derive(Debug, Clone)]
pub(crate) struct ModbusLink {
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    port: u16,
    client: Client,
    /// Variables written through this link.
    pub writes: InputSet,
    polled: Vec<SysVar, MAX_POLLED>,
    blocks: Vec<Block, MAX_POLL_BLOCKS>,
    in_flight: Option<InFlight>,
    /// The bits with owners in the transaction in flight that have their safe value.
    safe_bits: Option<(SysVar, u8)>,
    /// Since when a value from a field frame has waited to be handed over.
    pub offered: Since,
    /// The transport has not taken the newest request yet.
    unsent: bool,
    flight: Flight<2>,
    timeouts_in_a_row: u8,
    first: First,
    /// The next write starts at this variable, so that none waits forever.
    cursor: usize,
    /// Like `cursor`, for the bits of that variable.
    bit_cursor: u8,
    /// Safe values that the controller refused; they are written again at `ask_again_at`.
    refused: InputSet,
    refused_bits: BitSet,
    ask_again_at: Instant,
}

impl ModbusLink {
    pub(crate) fn polls(&self, group: GroupId) -> bool {
        self.blocks.iter().any(|block| block.group == group)
    }

    pub(crate) fn new(port: u16, unit: u8, writes: InputSet) -> Self {
        Self {
            supervisor: Supervisor::new(&LinkTimings::TCP),
            counters: LinkCounters::default(),
            port,
            client: Client::new(unit),
            writes,
            polled: Vec::new(),
            blocks: Vec::new(),
            in_flight: None,
            safe_bits: None,
            offered: Since::NONE,
            unsent: false,
            flight: Flight::new(),
            timeouts_in_a_row: 0,
            first: First::Write,
            cursor: 0,
            bit_cursor: 0,
            refused: InputSet::EMPTY,
            refused_bits: BitSet::EMPTY,
            ask_again_at: Instant::NEVER,
        }
    }

    pub(crate) fn transport(&self) -> Transport {
        Transport::Tcp { port: self.port }
    }

    /// Polls a variable every `period`; `None` if there are too many. Variables must be added in the order of their
    /// Modbus addresses, so that blocks join.
    pub(crate) fn poll_var(
        &mut self,
        var: SysVar,
        period: Duration,
        new_group: impl FnOnce() -> Option<GroupId>,
    ) -> Option<GroupId> {
        let (kind, first, count) = match var.modbus()? {
            ModbusPlace::Coils { first, count } => (Kind::Coils, first, count),
            ModbusPlace::Register { address } => (Kind::Registers, address, 1),
            ModbusPlace::Scaled { .. } => return None,
        };
        self.polled.push(var).ok()?;
        let end = first.saturating_add(count);
        let near = self.blocks.iter_mut().find(|block| {
            let block_end = block.first.saturating_add(block.count);
            block.kind == kind && first >= block.first && first <= block_end.saturating_add(JOIN_GAP)
        });
        if let Some(block) = near {
            let block_end = block.first.saturating_add(block.count);
            block.count = block_end.max(end).saturating_sub(block.first);
            if period < block.grid.period() {
                block.grid = Grid::starting_at(Instant::ZERO, period);
            }
            return Some(block.group);
        }
        let group = new_group()?;
        let grid = Grid::starting_at(Instant::ZERO, period);
        self.blocks.push(Block { kind, first, count, group, grid }).ok()?;
        Some(group)
    }

    /// The next request that may be sent.
    pub(crate) fn next_request(&mut self, store: &mut Store, out: &mut [u8]) -> Option<usize> {
        let now = store.now;
        if !self.supervisor.is_up() || self.in_flight.is_some() || self.unsent {
            return None;
        }
        let poll = self.due_block(now);
        let pending = store.outbox.dirty().and(&self.writes);
        if pending.is_empty() {
            self.offered = Since::NONE;
        }
        match poll {
            Some(block) if pending.is_empty() || self.first == First::Poll => self.poll(block, out, now),
            None if pending.is_empty() => None,
            _ => self.write(store, out),
        }
    }

    /// Notes a request of `len` bytes that is handed over, and returns `len`.
    fn asked(&mut self, len: usize, asked: Asked, next: First, now: Instant) -> Option<usize> {
        self.first = next;
        bump(&mut self.counters.sent);
        let until = now + ANSWER_TIMEOUT;
        self.in_flight = Some(InFlight { asked, until });
        self.unsent = true;
        self.flight.sent(len, until, Since::NONE);
        Some(len)
    }

    /// The transport has taken a request that is still unanswered, so nothing else can be sent: returns
    /// [`Instant::NEVER`], because no deadline has changed. `None` if something may be sent; nothing has changed then.
    pub(crate) fn sent_before_answer(&mut self) -> Option<Instant> {
        self.in_flight.as_ref()?;
        self.unsent = false;
        Some(Instant::NEVER)
    }

    /// Whether [`Self::next_request`] may return one; the link is up.
    pub(crate) fn may_ask(&mut self, waiting: &InputSet, now: Instant) -> bool {
        if self.in_flight.is_some() || self.unsent {
            return false;
        }
        if !waiting.and(&self.writes).is_empty() {
            return true;
        }
        self.offered = Since::NONE;
        self.blocks.iter().any(|block| block.grid.next() <= now)
    }

    /// When the transaction in flight is given up; [`Instant::NEVER`] if there is none.
    pub(crate) fn answer_deadline(&self) -> Instant {
        self.in_flight.map_or(Instant::NEVER, |asked| asked.until)
    }

    /// Gives up the transaction in flight. Whether a write was executed is unknown; only safe values are written again.
    fn abort(&mut self, store: &mut Store) {
        self.client.abort();
        if let Some(InFlight { asked: Asked::Write { safe, .. }, .. }) = self.in_flight.take() {
            store.again(&safe);
            if let Some((var, bits)) = self.safe_bits.take() {
                store.bits_again(BitSet::of(var, bits));
            }
        }
    }

    /// The controller has the safe bits of the write that it has answered.
    fn confirm_bits(&mut self, store: &mut Store) {
        if let Some((var, bits)) = self.safe_bits.take() {
            store.confirm_bits(var, bits & store.bits.safe.byte(var));
        }
    }

    /// Invalid Modbus arrived: closes the connection.
    fn violated(&mut self, store: &mut Store) {
        bump(&mut self.counters.malformed);
        self.supervisor.give_up(store.now);
        self.lost(store);
    }

    /// The controller has refused a request.
    fn refused(&mut self, asked: &Asked, now: Instant) {
        bump(&mut self.counters.refused);
        if let Asked::Write { safe, .. } = asked
            && !safe.is_empty()
        {
            self.refused = self.refused.or(safe);
            self.ask_again_at = self.ask_again_at.min(now + REFUSED_PAUSE);
        }
        if let Some((var, bits)) = self.safe_bits.take() {
            self.refused_bits = self.refused_bits.or(BitSet::of(var, bits));
            self.ask_again_at = self.ask_again_at.min(now + REFUSED_PAUSE);
        }
    }

    fn write_refused_again(&mut self, store: &mut Store) {
        store.again(&self.refused);
        store.bits_again(self.refused_bits);
        self.refused = InputSet::EMPTY;
        self.refused_bits = BitSet::EMPTY;
        self.ask_again_at = Instant::NEVER;
    }

    /// The block whose poll has been due longest.
    fn due_block(&self, now: Instant) -> Option<usize> {
        let due = self.blocks.iter().enumerate().filter(|(_, block)| block.grid.next() <= now);
        due.min_by_key(|(_, block)| block.grid.next()).map(|(nth, _)| nth)
    }

    fn poll(&mut self, nth: usize, out: &mut [u8], now: Instant) -> Option<usize> {
        let block = self.blocks.get_mut(nth)?;
        // Polls missed while a transaction was in flight are skipped.
        block.grid.due(now);
        let (address, count) = (block.first, block.count);
        let request = match block.kind {
            Kind::Coils => Request::ReadCoils { address, count },
            Kind::Registers => Request::ReadHolding { address, count },
        };
        let len = self.client.start(request, out).ok()?;
        self.asked(len, Asked::Poll { block: nth }, First::Write, now)
    }

    /// One request for the first pending variable and those that follow it without a gap.
    fn write(&mut self, store: &mut Store, out: &mut [u8]) -> Option<usize> {
        // Computed again, because a set passed as an argument does not stay in registers.
        let mut pending = store.outbox.dirty().and(&self.writes);
        if store.bits.is_used {
            match self.beside_bits(store, out) {
                Beside::Bits(sent) => return sent,
                Beside::Whole(whole) => pending = whole,
            }
        }
        let first = pending.first_from(self.cursor)?;
        let sent = self.write_whole(first, &pending, store, out);
        if store.bits.is_used {
            self.offer_the_rest(store);
        }
        sent
    }

    /// If bits have owners: sends some of them, or returns the whole variables whose turn it is.
    fn beside_bits(&mut self, store: &mut Store, out: &mut [u8]) -> Beside {
        let pending = store.outbox.dirty().and(&self.writes);
        match self.bits_turn(&pending, store) {
            Some(Turn::Bits(var, mask)) => Beside::Bits(self.write_bits(var, mask, store, out)),
            Some(Turn::Whole(var)) => {
                self.bit_cursor = 0;
                self.cursor = var.ordinal();
                Beside::Whole(pending.minus(&store.bits.bytes))
            }
            None => Beside::Bits(None),
        }
    }

    /// Values that were not part of the request count as offered with it.
    fn offer_the_rest(&mut self, store: &Store) {
        if !store.outbox.dirty().and(&self.writes).is_empty()
            && let Some(InFlight { asked: Asked::Write { born, .. }, .. }) = self.in_flight
        {
            self.offered = born;
        }
    }

    /// One request for a variable and those that follow it without a gap.
    fn write_whole(
        &mut self,
        first: SysVar,
        pending: &InputSet,
        store: &mut Store,
        out: &mut [u8],
    ) -> Option<usize> {
        let place = first.place();
        let (address, kind, each, most) = match place.modbus? {
            ModbusPlace::Coils { first, count: 0 | 1 } => (first, Kind::Coils, 1, MAX_WRITE_COILS),
            ModbusPlace::Coils { first, count } => {
                (first, Kind::Coils, count, MAX_WRITE_COILS.checked_div(count).unwrap_or(1))
            }
            ModbusPlace::Register { address } => (address, Kind::Registers, 1, MAX_WRITE_REGISTERS),
            ModbusPlace::Scaled { .. } => return None,
        };
        // Variables of one row of the table have consecutive Modbus addresses, as in the image.
        let most = usize::from(most).min(place.left_in_row);
        let count = pending.run_len(first).min(most);
        let vars = InputSet::run(first, count);
        self.cursor = first.ordinal().saturating_add(count);
        // Registers are packed after the longest request, where no buffer has to be cleared for them.
        let (out, room) = out.split_at_mut_checked(MAX_ADU)?;
        let mut bits;
        let request = match kind {
            Kind::Coils => {
                bits = [0; BIT_INPUT_COUNT];
                for (place, var) in bits.iter_mut().zip(vars.iter()) {
                    *place = store.outbox.bit_value(var);
                }
                Request::WriteCoils {
                    address,
                    coils: Coils::new(bits.get(..count)?, each.saturating_mul(count as u16))?,
                }
            }
            Kind::Registers => {
                let start = place.image_offset;
                let words = store.image.bytes().get(start..start.saturating_add(count.saturating_mul(2)))?;
                let registers = Registers::from_little_endian(words, room)?;
                Request::WriteRegisters { address, registers }
            }
        };
        let len = self.client.start(request, out).ok()?;
        let born = self.offered;
        born.record(store.now, &mut store.latency.handed_over);
        let safe = store.safe.and(&vars);
        match kind {
            Kind::Coils => store.taken(&vars),
            // Words do not queue.
            Kind::Registers => store.outbox.taken(&vars),
        }
        if pending.minus(&vars).is_empty() {
            self.offered = Since::NONE;
        }
        self.asked(len, Asked::Write { safe, born }, First::Poll, store.now)
    }

    /// The next write if bits have owners: the first variable from the cursor on, or the first run of waiting bits
    /// there.
    fn bits_turn(&self, pending: &InputSet, store: &Store) -> Option<Turn> {
        let turn = |var: SysVar, from: u8| {
            if !store.bits.bytes.contains(var) {
                return Some(Turn::Whole(var));
            }
            let behind = u8::MAX.checked_shl(from.into()).unwrap_or(0);
            let waiting = store.bits.dirty.byte(var) & behind;
            let first = waiting.trailing_zeros();
            let len = waiting.checked_shr(first)?.trailing_ones();
            let run = u8::MAX.checked_shr(8_u32.checked_sub(len)?)?;
            Some(Turn::Bits(var, run.checked_shl(first)?))
        };
        let from = |var: SysVar| if var.ordinal() == self.cursor { self.bit_cursor } else { 0 };
        let behind = pending.iter().filter(|var| var.ordinal() >= self.cursor);
        let next = behind.filter_map(|var| turn(var, from(var))).next();
        next.or_else(|| pending.iter().find_map(|var| turn(var, 0)))
    }

    /// One request for a run of bits that have owners.
    fn write_bits(&mut self, var: SysVar, mask: u8, store: &mut Store, out: &mut [u8]) -> Option<usize> {
        let (first, _) = place_of(var)?;
        let (from, count) = (mask.trailing_zeros(), mask.count_ones());
        let packed = [store.bits.next_bits(var).checked_shr(from)?];
        let address = first.saturating_add(from as u16);
        let coils = Coils::new(&packed, count as u16)?;
        let len = self.client.start(Request::WriteCoils { address, coils }, out.get_mut(..MAX_ADU)?).ok()?;
        self.cursor = var.ordinal();
        self.bit_cursor = from.saturating_add(count) as u8;
        let born = self.offered;
        born.record(store.now, &mut store.latency.handed_over);
        let safe = store.bits.safe.byte(var) & mask;
        store.bits_taken(BitSet::of(var, mask));
        if store.outbox.dirty().and(&self.writes).is_empty() {
            self.offered = Since::NONE;
        }
        self.safe_bits = (safe != 0).then_some((var, safe));
        self.asked(len, Asked::Write { safe: InputSet::EMPTY, born }, First::Poll, store.now)
    }
}

impl Connection for ModbusLink {
    fn opened(&mut self, store: &mut Store) {
        self.timeouts_in_a_row = 0;
        self.flight.clear();
        store.link_up(&self.writes);
    }

    fn lost(&mut self, store: &mut Store) {
        self.abort(store);
        self.offered = Since::NONE;
        self.unsent = false;
        self.flight.clear();
        self.write_refused_again(store);
        self.client.reset();
        store.link_lost(&self.writes);
    }

    fn received<'b>(&mut self, bytes: &'b [u8], store: &mut Store) -> &'b [u8] {
        let now = store.now;
        let mut rest = bytes;
        while let Some(event) = self.client.receive(&mut rest) {
            let response = match event {
                ClientEvent::Response(response) => Some(response),
                ClientEvent::Exception(_) => None,
                ClientEvent::Violation(_) => {
                    self.violated(store);
                    return &[];
                }
            };
            let Some(InFlight { asked, until }) = self.in_flight.take() else {
                bump(&mut self.counters.malformed);
                continue;
            };
            let micros = Since::at(until).earlier_by(ANSWER_TIMEOUT).micros_until(now);
            self.counters.answered(micros);
            store.latency.modbus.record_micros(micros);
            self.timeouts_in_a_row = 0;
            self.flight.answered();
            match (asked, response) {
                (Asked::Write { safe, born }, Some(_)) => {
                    born.record(now, &mut store.latency.arrived);
                    store.confirm(&safe);
                    if self.safe_bits.is_some() {
                        self.confirm_bits(store);
                    }
                }
                (Asked::Poll { block }, Some(response)) => {
                    if let Some(block) = self.blocks.get(block) {
                        take_poll(block, &self.polled, response, store);
                    }
                }
                (asked, None) => self.refused(&asked, now),
            }
        }
        &[]
    }

    fn sent(&mut self) {
        self.unsent = false;
    }

    fn acked(&mut self, left: u32, _store: &mut Store) {
        self.flight.acked(left, |_| ());
    }

    fn advance(&mut self, store: &mut Store) {
        let now = store.now;
        if now >= self.ask_again_at {
            self.write_refused_again(store);
        }
        if now < self.answer_deadline() {
            return;
        }
        bump(&mut self.counters.timeouts);
        self.abort(store);
        self.timeouts_in_a_row = self.timeouts_in_a_row.saturating_add(1);
        // A request that has not arrived by now would be executed after it was given up.
        let is_under_way = self.unsent || !self.flight.is_empty();
        if is_under_way {
            bump(&mut self.counters.unacknowledged);
        }
        if is_under_way || self.timeouts_in_a_row >= TIMEOUTS_IN_A_ROW {
            self.supervisor.give_up(now);
            self.lost(store);
        }
    }

    fn deadline(&self) -> Instant {
        if self.in_flight.is_some() {
            return self.answer_deadline().min(self.ask_again_at);
        }
        if !self.supervisor.is_up() {
            return Instant::NEVER;
        }
        if self.unsent {
            return self.ask_again_at;
        }
        let polls = self.blocks.iter().map(|block| block.grid.next()).min().unwrap_or(Instant::NEVER);
        polls.min(self.ask_again_at)
    }
}

/// The longest request and its registers fit.
const _: () = assert!(MAX_ADU + 2 * MAX_WRITE_REGISTERS as usize <= OUTPUT_BUFFER);

fn place_of(var: SysVar) -> Option<(u16, Kind)> {
    match var.modbus()? {
        ModbusPlace::Coils { first, .. } => Some((first, Kind::Coils)),
        ModbusPlace::Register { address } => Some((address, Kind::Registers)),
        ModbusPlace::Scaled { .. } => None,
    }
}

/// Writes the reply to a poll into the image.
pub(crate) fn take_poll(block: &Block, polled: &[SysVar], response: Response<'_>, store: &mut Store) {
    if store.bits.is_used {
        take_values_beside_bits(block, polled, response, store);
    } else {
        take_values(block, polled, response, |var, value| {
            // Cannot fail: the table has the variable's type, and bits beyond it were not read.
            let _ = store.image.set(var, value);
        });
    }
    store.image.stamp(block.group, store.now);
    store.unconfirm_by_witnesses();
}

/// [`take_values`] if bits have owners.
fn take_values_beside_bits(block: &Block, polled: &[SysVar], response: Response<'_>, store: &mut Store) {
    take_values(block, polled, response, |var, value| match value {
        Scalar::Byte(shown) if store.bits.bytes.contains(var) => store.show_bits(var, shown),
        value => _ = store.image.set(var, value),
    });
}

fn take_values(
    block: &Block,
    polled: &[SysVar],
    response: Response<'_>,
    mut take: impl FnMut(SysVar, Scalar),
) {
    for &var in polled {
        let value = match (var.modbus(), response) {
            (Some(ModbusPlace::Coils { first, count }), Response::Coils(coils)) => {
                (block.kind == Kind::Coils).then(|| bits_at(coils, first, count, block)).flatten()
            }
            (Some(ModbusPlace::Register { address }), Response::Registers(registers)) => {
                let nth = address.checked_sub(block.first).filter(|_| block.kind == Kind::Registers);
                nth.and_then(|nth| registers.register(nth)).map(Scalar::Word)
            }
            _ => None,
        };
        if let Some(value) = value {
            take(var, value);
        }
    }
}

fn bits_at(coils: Coils<'_>, first: u16, count: u16, block: &Block) -> Option<Scalar> {
    let start = first.checked_sub(block.first)?;
    let mut bits = 0_u8;
    for nth in 0..count.min(8) {
        bits |= u8::from(coils.coil(start.saturating_add(nth))?).checked_shl(u32::from(nth))?;
    }
    Some(Scalar::Byte(bits))
}
