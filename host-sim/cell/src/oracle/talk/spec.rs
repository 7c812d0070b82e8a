//! What is asked on a Modbus RTU line: requests and replies by proto-core/docs/wire/modbus-rtu.md.
//!
//! Written from that page, independent of the engine's exchanges.

use proto_core::config::{ConfigView, FieldSpec, GatewayConfig, Port, Recipe, Rs485, Talk};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::SysVar;
use proto_core::time::Duration;

use crate::oracle::spec::{Frame, frame};

/// The conversation of a port.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct TalkSpec {
    pub rows: Vec<RowSpec>,
    /// After this long without a byte, what was sent is complete.
    pub silence: Duration,
    /// Time of all rows if nobody answers, each once.
    pub all_costs: Duration,
}

/// One exchange.
#[derive(Debug, Clone)]
pub(in crate::oracle) struct RowSpec {
    /// 0: all of them.
    pub slave: u8,
    pub function: u8,
    /// What is read or, by a row that only writes, written.
    pub address: u16,
    pub count: u16,
    /// The first register or coil that is written.
    pub written: Option<u16>,
    pub every: Option<Duration>,
    pub on_change: bool,
    pub rising: Option<(SysVar, u8)>,
    pub timeout: Duration,
    pub retries: u8,
    pub pause: Duration,
    /// The input frame of the port that the data of its reply is.
    pub reply: Option<usize>,
    /// The data of its request.
    pub request: Option<Frame>,
    /// Bytes before the data.
    head: Vec<u8>,
}

/// What bytes are while a reply is awaited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::oracle) enum Seen {
    /// Not the beginning of what is awaited.
    No,
    /// Perhaps its beginning.
    Begins,
    Reply(usize),
    Refusal,
    /// It would be the reply, but its CRC is wrong.
    Wrong(usize),
}

impl TalkSpec {
    /// The exchanges of a recipe, whose replies are behind its other input frames; `None` without any.
    pub(in crate::oracle) fn new(
        config: &GatewayConfig,
        recipe: &Recipe,
        (line, silence): (&Rs485, Duration),
        inputs: &mut Vec<Frame>,
    ) -> Option<Self> {
        let mut rows = Vec::new();
        let mut all_costs = Duration::ZERO;
        for exchange in config.view().exchanges_of(recipe) {
            let Talk::Rtu { operation, written, read } = exchange.talk else { return None };
            let data = |fields: &[FieldSpec]| (!fields.is_empty()).then(|| frame(&[], &[], None, fields));
            let mut row = RowSpec {
                slave: exchange.peer,
                function: 0,
                address: 0,
                count: 0,
                written: None,
                every: exchange.when.every,
                on_change: exchange.when.change,
                rising: exchange.when.rising,
                timeout: exchange.timeout,
                retries: exchange.retries,
                pause: exchange.pause,
                reply: None,
                request: data(written.of(&config.fields)),
                head: Vec::new(),
            };
            if let Some(reply) = data(read.of(&config.fields)) {
                row.reply = Some(inputs.len());
                inputs.push(reply);
            }
            row.begin(&operation);
            let bytes = row.request_len() + row.reply_len();
            all_costs = all_costs + line.time_on_line(bytes) + row.timeout + row.pause + silence;
            rows.push(row);
        }
        (!rows.is_empty()).then_some(Self { rows, silence, all_costs })
    }

    /// The exchange of a request.
    pub(super) fn row_of(&self, request: &[u8]) -> Option<usize> {
        self.rows.iter().position(|row| request.starts_with(&row.head) && request.len() == row.request_len())
    }

    /// The exchanges with a slave, by index.
    pub(super) fn rows_of(&self, slave: u8) -> impl Iterator<Item = (usize, &RowSpec)> {
        self.rows.iter().enumerate().filter(move |(_, row)| row.slave == slave)
    }
}

impl RowSpec {
    fn begin(&mut self, operation: &Operation) {
        let (function, words, write) = match *operation {
            Operation::ReadCoils { address, count } => (1, vec![address, count], None),
            Operation::ReadDiscreteInputs { address, count } => (2, vec![address, count], None),
            Operation::ReadHoldingRegisters { address, count } => (3, vec![address, count], None),
            Operation::ReadInputRegisters { address, count } => (4, vec![address, count], None),
            Operation::WriteCoil { address } => (5, vec![address], Some((address, 1))),
            Operation::WriteRegister { address } => (6, vec![address], Some((address, 1))),
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
            (16 | 23, Some((_, count))) => self.head.push((2 * count) as u8),
            _ => {}
        }
    }

    fn is_coils(&self) -> bool {
        matches!(self.function, 5 | 15)
    }

    /// Bytes of data in the request.
    fn data_len(&self) -> usize {
        match self.function {
            1..=4 => 0,
            5 | 6 => 2,
            _ => usize::from(self.head.last().copied().unwrap_or(0)),
        }
    }

    pub(super) fn request_len(&self) -> usize {
        self.head.len() + self.data_len() + 2
    }

    /// Bytes of data in the reply; `None` if it repeats the request's beginning.
    fn reply_data(&self) -> Option<usize> {
        match self.function {
            1 | 2 => Some(usize::from(self.count.div_ceil(8))),
            3 | 4 | 23 => Some(2 * usize::from(self.count)),
            _ => None,
        }
    }

    fn reply_len(&self) -> usize {
        self.reply_data().map_or(8, |len| len + 5)
    }

    /// The data of a request, as its fields have it: one coil in the lowest bit.
    pub(super) fn data_of(&self, request: &[u8]) -> Vec<u8> {
        let data = &request[self.head.len()..self.request_len() - 2];
        if self.function == 5 { vec![u8::from(data[0] == 0xFF)] } else { data.to_vec() }
    }

    /// The data that registers or coils with these values are.
    pub(super) fn data_from(&self, values: &[u16]) -> Vec<u8> {
        if !self.is_coils() {
            return values.iter().flat_map(|value| value.to_be_bytes()).collect();
        }
        let byte = |bits: &[u16]| bits.iter().rev().fold(0, |byte, bit| byte << 1 | u8::from(*bit != 0));
        values.chunks(8).map(byte).collect()
    }

    /// The registers or coils that a slave takes from this data.
    pub(super) fn values_of(&self, data: &[u8]) -> Vec<u16> {
        if !self.is_coils() {
            return data.chunks(2).map(|word| u16::from_be_bytes([word[0], word[1]])).collect();
        }
        let count = usize::from(self.count);
        (0..count).map(|nth| u16::from(data[nth / 8] >> (nth % 8) & 1)).collect()
    }

    pub(super) fn writes_coils(&self) -> bool {
        self.is_coils()
    }

    /// The system variables in its request.
    pub(in crate::oracle) fn shown(&self) -> impl Iterator<Item = SysVar> {
        let fields = self.request.iter().flat_map(|request| &request.fields);
        fields.filter_map(crate::oracle::spec::shown)
    }

    /// What the bytes that came are, if they follow this request.
    pub(super) fn see(&self, request: &[u8], bytes: &[u8]) -> Seen {
        let refusal = [self.slave, self.function | 0x80];
        if bytes.len() >= 2 && bytes[..2] == refusal {
            return match bytes.get(..5) {
                None => Seen::Begins,
                Some(frame) if is_right(frame) => Seen::Refusal,
                Some(_) => Seen::Wrong(5),
            };
        }
        let head = match self.reply_data() {
            Some(len) => vec![self.slave, self.function, len as u8],
            None => request[..6].to_vec(),
        };
        let seen = bytes.len().min(head.len());
        if bytes[..seen] != head[..seen] {
            return Seen::No;
        }
        match bytes.get(..self.reply_len()) {
            None => Seen::Begins,
            Some(frame) if is_right(frame) => Seen::Reply(frame.len()),
            Some(frame) => Seen::Wrong(frame.len()),
        }
    }
}

/// Whether the last two bytes are the CRC of the others, low byte first.
pub(super) fn is_right(frame: &[u8]) -> bool {
    let (bytes, crc) = frame.split_at(frame.len() - 2);
    let remainder = bytes.iter().fold(0xFFFF_u16, |crc, &byte| {
        (0..8).fold(crc ^ u16::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    });
    remainder.to_le_bytes() == crc
}

/// Why the exchanges of a configuration cannot be judged, if they cannot.
pub(in crate::oracle) fn unmodelled(config: &GatewayConfig) -> Option<&'static str> {
    let is_rtu = |talk: &Talk| matches!(talk, Talk::Rtu { .. });
    if !config.exchanges.iter().all(|exchange| is_rtu(&exchange.talk)) {
        return Some(
            "a soak cannot judge exchanges of devices other than Modbus slaves, nor a gateway that is a slave",
        );
    }
    let asks = |port: &&Port| !config.view().exchanges_of(recipe_of(config.view(), port)).is_empty();
    let has_echo = |port: &Port| match &port.bus {
        proto_core::config::Bus::Rs485(line) => line.echo,
        _ => false,
    };
    if config.ports.iter().filter(asks).any(has_echo) {
        return Some("a soak cannot judge a Modbus line that echoes");
    }
    None
}

/// The same, of what only the laid out requests show.
pub(in crate::oracle) fn ambiguous(ports: &[crate::oracle::spec::PortSpec]) -> Option<&'static str> {
    let is_twice = |talk: &TalkSpec| {
        let rows = &talk.rows;
        rows.iter().enumerate().any(|(nth, row)| rows[..nth].iter().any(|other| other.head == row.head))
    };
    let is_odd = ports.iter().filter_map(|port| port.talk.as_ref()).any(is_twice);
    is_odd.then_some("a soak cannot judge two exchanges of a line with the same slave, function and place")
}

fn recipe_of<'c>(config: ConfigView<'c>, port: &Port) -> &'c Recipe {
    &config.recipes[usize::from(port.recipe)]
}
