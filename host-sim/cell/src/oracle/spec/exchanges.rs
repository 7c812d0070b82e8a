//! Exchanges with slaves and devices: requests and replies on a Modbus RTU line by proto-core/docs/wire/modbus-rtu.md,
//! others by docs/configuration.md section 4.
//!
//! Written from these pages, independent of the engine's exchanges.

use proto_core::config::{
    Echo, Exchange, FieldSpec, GatewayConfig, OutputBinding, Port, Recipe, Rs485, Transaction,
};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::SysVar;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;

use super::PortSpec;
use super::frames::{FramesSpec, Seen, frame_of};
use crate::oracle::device;
use crate::oracle::frame::{Frame, device_frame};
use crate::oracle::varying::{can_be_the_same, look};
use crate::rtu::is_right;

/// The exchanges of a port.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct ExchangesSpec {
    pub rows: Vec<RowSpec>,
    /// After this long without a byte, the transmission is complete.
    pub silence: Duration,
    /// The time that all rows take, once each, if no device replies.
    pub all_costs: Duration,
    /// Whether the port receives its own bytes.
    pub echo: Echo,
    /// A slave that was not heard for this long counts as started.
    pub absent: Duration,
    /// The input frames of the port that come without a request.
    pub unasked: Vec<usize>,
}

/// One exchange.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct RowSpec {
    /// Index among the port's exchanges.
    pub nth: usize,
    /// Address of the slave, with 0 for a broadcast; or number of the device.
    pub slave: u8,
    /// The device's own frames; `None` on a Modbus line.
    pub frames: Option<FramesSpec>,
    pub function: u8,
    /// The first register or coil that is read or, in a row that only writes, written.
    pub address: u16,
    pub count: u16,
    /// The first register or coil that is written.
    pub written: Option<u16>,
    /// The bits of a register that are written.
    pub mask: u16,
    pub every: Option<Duration>,
    pub at_start: bool,
    pub on_change: bool,
    pub rising: Option<(SysVar, u8)>,
    pub kind: Kind,
    pub timeout: Duration,
    /// Maximum number of repetitions of a state, and of an event.
    pub retries: u8,
    pub event_retries: u8,
    /// How long after the rise of its bit the request may be sent.
    pub trigger: Duration,
    /// How long after a request its reply may arrive.
    pub late: Duration,
    /// The exchanges of the same slave, including this one, whose replies could be mistaken for its own.
    pub alike: Vec<usize>,
    pub pause: Duration,
    /// The input frame of the port in the data of the reply.
    pub reply: Option<usize>,
    /// The frame in the data of the request, or a request with the device's own frame.
    pub request: Option<Frame>,
    /// Bytes before the data.
    pub head: Vec<u8>,
}

/// Why an exchange is requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::oracle) enum Kind {
    /// A bit rises.
    Event,
    /// The slave starts, and the exchange may make it do something.
    Start,
    /// A value is read, or is kept as the controller has it.
    State,
}

impl ExchangesSpec {
    /// The device whose CANopen node reports with this frame that it has booted: data 0, with id 0x700 + node, for a
    /// node that is accessed with SDO.
    pub(in crate::oracle) fn booted(&self, id: CanId, data: &[u8]) -> Option<u8> {
        let (CanId::Standard(id @ 0x701..=0x77F), [0]) = (id, data) else { return None };
        let asked = Some(CanId::Standard(0x600 + (id - 0x700)));
        let of_node = self.rows.iter().find(|row| row.request.as_ref().is_some_and(|own| own.id == asked));
        of_node.map(|row| row.slave)
    }

    /// The exchanges of a recipe, whose replies come after its other input frames; `None` without any.
    pub(in crate::oracle) fn new(
        config: &GatewayConfig,
        recipe: &Recipe,
        (port, line, silence): (&Port, Option<&Rs485>, Duration),
        inputs: &mut Vec<Frame>,
    ) -> Option<Self> {
        let mut rows: Vec<RowSpec> = Vec::new();
        let mut all_costs = Duration::ZERO;
        let mut unasked: Vec<usize> = (0..inputs.len()).collect();
        for exchange in config.view().exchanges_of(recipe) {
            let mut row = RowSpec::new(rows.len(), exchange, port.timeout);
            match exchange.transaction {
                Transaction::Rtu { operation, written, read } => {
                    let data = |fields: &[FieldSpec]| {
                        (!fields.is_empty()).then(|| device_frame(&[], &[], None, fields))
                    };
                    row.request = data(written.of(&config.fields));
                    if let Some(reply) = data(read.of(&config.fields)) {
                        row.reply = Some(inputs.len());
                        inputs.push(reply);
                    }
                    row.begin(&operation);
                }
                Transaction::Frames { request, reply, refusal } => {
                    let frame = |nth: Option<u8>| frame_of(config, nth?);
                    let request = frame(request);
                    let remote =
                        request.as_ref().filter(|(spec, _)| spec.remote).and_then(|(spec, _)| spec.id);
                    let is_asked = request.is_some();
                    row.request = request.filter(|(spec, _)| !spec.remote).map(|(_, request)| request);
                    let refusal = frame(refusal).map(|(_, refusal)| refusal);
                    let reply = frame(reply).map(|(_, reply)| reply);
                    if let Some(reply) = &reply {
                        row.reply = Some(inputs.len());
                        if !is_asked {
                            unasked.push(inputs.len());
                        }
                        inputs.push(reply.clone());
                    }
                    row.frames = Some(FramesSpec { is_asked, remote, reply, refusal });
                }
                Transaction::Served { .. } => return None,
            }
            let bytes = row.request_len() + row.reply_len();
            let on_line = line.map_or(ON_A_BUS, |line| line.time_on_line(bytes));
            all_costs = all_costs + on_line + row.timeout + row.pause + silence;
            rows.push(row);
        }
        let is_alike = |one: &RowSpec, other: &RowSpec| {
            let is_same = one.nth == other.nth || one.is_answered_like(other);
            one.slave == other.slave && one.is_answered() && other.is_answered() && is_same
        };
        let alike: Vec<Vec<usize>> = rows
            .iter()
            .map(|row| rows.iter().filter(|other| is_alike(row, other)).map(|other| other.nth).collect())
            .collect();
        rows.iter_mut().zip(alike).for_each(|(row, alike)| row.alike = alike);
        let echo = line.map_or(Echo::No, |line| line.echo);
        let absent = port.absent;
        (!rows.is_empty()).then_some(Self { rows, silence, all_costs, echo, absent, unasked })
    }

    /// The shortest timeout of the exchanges with a slave.
    pub(in crate::oracle) fn shortest(&self, slave: u8) -> Duration {
        self.rows_of(slave).map(|(_, row)| row.timeout).min().unwrap_or_default()
    }

    /// The exchange to which a request belongs. `id` is the id of a CAN frame; `is_remote`: it is a remote frame.
    pub(in crate::oracle) fn row_of(
        &self,
        (id, is_remote): (Option<CanId>, bool),
        request: &[u8],
    ) -> Option<usize> {
        self.rows.iter().position(|row| match &row.frames {
            None => {
                let is_this = request.starts_with(&row.head) && request.len() == row.request_len();
                is_this && is_right(request)
            }
            Some(frames) if is_remote => id.is_some() && frames.remote == id,
            Some(_) => row
                .request
                .as_ref()
                .is_some_and(|own| own.id == id && look(own, request) == device::Look::Frame(request.len())),
        })
    }

    /// Interprets bytes of a line as an unsolicited frame.
    pub(in crate::oracle) fn see_unasked(&self, port: &PortSpec, bytes: &[u8]) -> Seen {
        self.unasked.iter().fold(Seen::No, |seen, &nth| {
            seen.or(Seen::of(look(&port.inputs[nth], bytes), |len| Seen::Unasked(len, nth)))
        })
    }

    /// The exchanges with a slave, by index.
    pub(in crate::oracle) fn rows_of(&self, slave: u8) -> impl Iterator<Item = (usize, &RowSpec)> {
        self.rows.iter().enumerate().filter(move |(_, row)| row.slave == slave)
    }
}

impl RowSpec {
    fn new(nth: usize, exchange: &Exchange, port_timeout: Duration) -> Self {
        let when = &exchange.when;
        let reads = matches!(exchange.transaction, Transaction::Rtu { written, .. } if written.len == 0);
        let kind = match (when.rising, when.every.is_some() || when.change) {
            (Some(_), _) => Kind::Event,
            (None, false) if when.start && !reads => Kind::Start,
            _ => Kind::State,
        };
        Self {
            kind,
            event_retries: exchange.event_retries,
            trigger: exchange.trigger.unwrap_or(port_timeout.min(Duration::from_secs(1))),
            late: exchange.late.unwrap_or(exchange.timeout.saturating_mul(3).max(Duration::from_secs(1))),
            alike: Vec::new(),
            nth,
            slave: exchange.peer,
            frames: None,
            function: 0,
            address: 0,
            count: 0,
            written: None,
            mask: u16::MAX,
            every: exchange.when.every,
            at_start: exchange.when.start,
            on_change: exchange.when.change,
            rising: exchange.when.rising,
            timeout: exchange.timeout,
            retries: exchange.retries,
            pause: exchange.pause,
            reply: None,
            request: None,
            head: Vec::new(),
        }
    }

    /// Whether a reply is expected.
    pub(in crate::oracle) fn is_answered(&self) -> bool {
        match &self.frames {
            Some(frames) => frames.is_asked && frames.reply.is_some(),
            None => self.slave != 0,
        }
    }

    /// Whether nothing in a valid reply distinguishes it from a reply to the other exchange.
    fn is_answered_like(&self, other: &Self) -> bool {
        match (&self.frames, &other.frames) {
            (Some(one), Some(other)) => match (&one.reply, &other.reply) {
                (Some(one), Some(other)) => can_be_the_same(one, other),
                _ => false,
            },
            _ => {
                let is_same = self.function == other.function && self.reply_data() == other.reply_data();
                let place = |row: &Self| (row.address, row.count, row.mask);
                let is_there = place(self) == place(other);
                is_same && (self.reply_data().is_some() || is_there)
            }
        }
    }

    /// How long at least nothing is sent after a request without a reply.
    pub(in crate::oracle) fn rest(&self, turnaround: Duration) -> Duration {
        if self.frames.is_some() { self.pause.max(turnaround) } else { self.pause + AFTER_BROADCAST }
    }

    /// Whether the request carries values or orders for the device.
    pub(in crate::oracle) fn is_written(&self) -> bool {
        self.written.is_some() || self.request.is_some()
    }

    /// Whether the request can be sent at any time, because none of its values can be unknown.
    pub(in crate::oracle) fn is_always_ready(&self) -> bool {
        let request = self.request.iter().flat_map(|request| &request.fields);
        request.filter_map(FieldSpec::source).all(|source| {
            matches!(
                source,
                OutputBinding::Constant(_) | OutputBinding::Counter | OutputBinding::CounterTo { .. }
            )
        })
    }

    fn begin(&mut self, operation: &Operation) {
        let (function, words, write) = match *operation {
            Operation::ReadCoils { address, count } => (1, vec![address, count], None),
            Operation::ReadDiscreteInputs { address, count } => (2, vec![address, count], None),
            Operation::ReadHoldingRegisters { address, count } => (3, vec![address, count], None),
            Operation::ReadInputRegisters { address, count } => (4, vec![address, count], None),
            Operation::WriteCoil { address } => (5, vec![address], Some((address, 1))),
            Operation::WriteRegister { address } => (6, vec![address], Some((address, 1))),
            Operation::MaskWriteRegister { address, mask } => {
                self.mask = mask;
                (22, vec![address], Some((address, 1)))
            }
            Operation::WriteCoils { address, count } => (15, vec![address, count], Some((address, count))),
            Operation::WriteRegisters { address, count } => {
                (16, vec![address, count], Some((address, count)))
            }
            Operation::ReadWriteRegisters { read_address, read_count, write_address, write_count } => {
                let words = vec![read_address, read_count, write_address, write_count];
                (23, words, Some((write_address, write_count)))
            }
        };
        self.function = function;
        self.address = words[0];
        self.count = words.get(1).copied().unwrap_or(1);
        self.written = write.map(|(address, _)| address);
        self.head = vec![self.slave, function];
        self.head.extend(words.iter().flat_map(|word| word.to_be_bytes()));
        match (function, write) {
            (15, Some((_, count))) => self.head.push(count.div_ceil(8) as u8),
            (22, _) => self.head.extend((!self.mask).to_be_bytes()),
            (16 | 23, Some((_, count))) => self.head.push((2 * count) as u8),
            _ => {}
        }
    }

    pub(in crate::oracle) fn is_coils(&self) -> bool {
        matches!(self.function, 5 | 15)
    }

    /// Number of data bytes in the request.
    fn data_len(&self) -> usize {
        match self.function {
            1..=4 => 0,
            5 | 6 | 22 => 2,
            _ => usize::from(self.head.last().copied().unwrap_or(0)),
        }
    }

    pub(in crate::oracle) fn request_len(&self) -> usize {
        if self.frames.is_some() {
            return self.request.as_ref().map_or(0, Frame::len);
        }
        self.head.len() + self.data_len() + 2
    }

    /// Number of data bytes in the reply; `None` if it repeats the beginning of the request.
    fn reply_data(&self) -> Option<usize> {
        match self.function {
            1 | 2 => Some(usize::from(self.count.div_ceil(8))),
            3 | 4 | 23 => Some(2 * usize::from(self.count)),
            _ => None,
        }
    }

    /// How many bytes of the request are repeated in a reply without data.
    fn repeated(&self) -> usize {
        if self.function == 22 { 8 } else { 6 }
    }

    fn reply_len(&self) -> usize {
        if let Some(frames) = &self.frames {
            return frames.reply.as_ref().map_or(0, Frame::len);
        }
        self.reply_data().map_or(self.repeated() + 2, |len| len + 5)
    }

    /// The data of a request as its fields have it: a single coil in the lowest bit. For a device's own frame, the
    /// whole frame.
    pub(in crate::oracle) fn data_of(&self, request: &[u8]) -> Vec<u8> {
        if self.frames.is_some() {
            return request.to_vec();
        }
        let data = &request[self.head.len()..self.request_len() - 2];
        if self.function == 5 { vec![u8::from(data[0] == 0xFF)] } else { data.to_vec() }
    }

    /// The data for registers or coils with these values, or for bytes.
    pub(in crate::oracle) fn data_from(&self, values: &[u16]) -> Vec<u8> {
        if self.frames.is_some() {
            return values.iter().map(|&byte| byte as u8).collect();
        }
        if !self.is_coils() {
            return values.iter().flat_map(|value| value.to_be_bytes()).collect();
        }
        let byte = |bits: &[u16]| bits.iter().rev().fold(0, |byte, bit| byte << 1 | u8::from(*bit != 0));
        values.chunks(8).map(byte).collect()
    }

    /// The registers or coils that a slave accepts from this data; for a device's own frame, the bytes.
    pub(in crate::oracle) fn values_of(&self, data: &[u8]) -> Vec<u16> {
        if self.frames.is_some() {
            return data.iter().copied().map(u16::from).collect();
        }
        if !self.is_coils() {
            return data.chunks(2).map(|word| u16::from_be_bytes([word[0], word[1]])).collect();
        }
        let count = usize::from(self.count);
        (0..count).map(|nth| u16::from(data[nth / 8] >> (nth % 8) & 1)).collect()
    }

    /// The system variables in the request.
    pub(in crate::oracle) fn shown(&self) -> impl Iterator<Item = SysVar> {
        self.request.iter().flat_map(|request| request.shown.iter().copied())
    }

    /// As [`Self::see`], for a late reply if `request` was the newest one. Bytes with a wrong checksum are no reply.
    pub(in crate::oracle) fn see_late(&self, request: Option<&[u8]>, bytes: &[u8]) -> Seen {
        match (&self.frames, request) {
            (Some(_), _) => self.see(&[], bytes),
            (None, None) => Seen::No,
            (None, Some(request)) => match self.see(request, bytes) {
                Seen::Wrong(_) => Seen::No,
                seen => seen,
            },
        }
    }

    /// Whether a frame on a bus is the abort of this SDO request, if the file defines no other refusal.
    pub(in crate::oracle) fn is_abort(&self, request: &[u8], id: CanId, frame: &[u8]) -> bool {
        let Some(FramesSpec { reply: Some(reply), refusal: None, .. }) = &self.frames else { return false };
        let is_sdo = match (self.request.as_ref().and_then(|own| own.id), reply.id) {
            (Some(CanId::Standard(asked @ 0x601..=0x67F)), Some(CanId::Standard(own))) => asked == own + 0x80,
            _ => false,
        };
        let is_whole = frame.len() == 8 && request.len() == 8;
        is_sdo && Some(id) == reply.id && is_whole && frame[0] == 0x80 && frame[1..4] == request[1..4]
    }

    /// Interprets the bytes received after this request.
    pub(in crate::oracle) fn see(&self, request: &[u8], bytes: &[u8]) -> Seen {
        if let Some(frames) = &self.frames {
            return frames.see(bytes);
        }
        let refusal = [self.slave, self.function | 0x80];
        if bytes.len() >= 2 && bytes[..2] == refusal {
            return match bytes.get(..5) {
                None => Seen::Begins { is_ours: true },
                Some(frame) if is_right(frame) => Seen::Refusal(5),
                Some(_) => Seen::Wrong(5),
            };
        }
        let head = match self.reply_data() {
            Some(len) => vec![self.slave, self.function, len as u8],
            // The reply to a write of one register or coil contains its value.
            None => request[..self.repeated()].to_vec(),
        };
        let seen = bytes.len().min(head.len());
        if bytes[..seen] != head[..seen] {
            return Seen::No;
        }
        match bytes.get(..self.reply_len()) {
            None => Seen::Begins { is_ours: true },
            Some(frame) if is_right(frame) => Seen::Reply(frame.len()),
            Some(frame) => Seen::Wrong(frame.len()),
        }
    }
}

/// After a request to all slaves, nothing is sent for this long.
const AFTER_BROADCAST: Duration = Duration::from_millis(100);
/// More than a request and its reply take on a bus.
const ON_A_BUS: Duration = Duration::from_millis(20);
