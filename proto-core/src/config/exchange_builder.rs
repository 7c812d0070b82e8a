//! Exchanges as a program writes them.
//!
//! In: addresses, numbers and slices of the caller. Out: the same, borrowed and small; every default
//! is that of the file (docs/configuration.md). [`Recipe::user`](super::Recipe::user) takes them with
//! [`RecipeBuilder::exchanges`](super::RecipeBuilder::exchanges).

use super::FieldSpec;
use super::exchange::{Exchange, OutcomeTo, Restarted, Transaction, Triggers};
use super::fields::{Fields, InputField, OutputField, Var};
use crate::device::Encoding;
use crate::modbus::rtu::{Operation, Table};
use crate::time::Duration;
use crate::wire::can::CanId;
use crate::wire::scalar::ScalarType;

/// An exchange of a recipe, or a block of a slave, under construction.
///
/// The numbers of registers and coils follow from the fields. In registers the fields are big-endian,
/// unless their encoding has another order than the usual little-endian one. The fields of coils have
/// the type [`Coil`], and padding skips so many coils.
///
/// ```
/// use proto_core::config::{ExchangeBuilder, Coil, GatewayConfig, InputField, OutputField, Port, Recipe};
/// use proto_core::time::Duration;
/// use proto_core::wire::scalar::ScalarType::Word;
///
/// let config: GatewayConfig<1, 1, 4, 0, 0, 2> = GatewayConfig::builder()
///     .controller("192.168.12.138")
///     .recipe(Recipe::user("line").exchanges(&[
///         // Slave 9: two registers from 0x07D0, every 100 ms.
///         ExchangeBuilder::read_input_registers(
///             9,
///             0x07D0,
///             &[InputField::variable(Word, "WordInputReg[1]"), InputField::padding(2)],
///         )
///         .every(Duration::from_millis(100)),
///         // Slave 5: two coils from 8, when one of them changes.
///         ExchangeBuilder::write_coils(
///             5,
///             8,
///             &[
///                 OutputField::variable(Coil, "WordOutputReg[1]"),
///                 OutputField::variable(Coil, "WordOutputReg[2]"),
///             ],
///         )
///         .on_change(),
///     ]))
///     .port(Port::modbus_rtu("line", "line").baud(19_200).timeout(Duration::from_secs(1)))
///     .build()?;
/// assert_eq!(config.exchanges.len(), 2);
/// # Ok::<(), proto_core::config::ConfigError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExchangeBuilder<'a> {
    /// As in the configuration, still without what the fields below decide.
    pub(super) exchange: Exchange,
    pub(super) transaction: TransactionDraft<'a>,
    pub(super) retries: Option<u8>,
    pub(super) rising: Option<(Var<'a>, u8)>,
    pub(super) outcome: [Option<Var<'a>>; 3],
    pub(super) pending: Option<ExchangeFrame<'a>>,
}

/// Operations have counts of 0 here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum TransactionDraft<'a> {
    Rtu {
        operation: Operation,
        written: Option<Fields<'a>>,
        read: Option<Fields<'a>>,
    },
    Served {
        table: Table,
        address: u16,
        fields: Fields<'a>,
    },
    /// As in the configuration, with counts.
    Packed {
        operation: Operation,
        is_served: bool,
        written: &'a [FieldSpec],
        read: &'a [FieldSpec],
    },
    /// A request, a reply and a refusal.
    Frames([Option<ExchangeFrame<'a>>; 3]),
}

/// A frame of an exchange.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExchangeFrame<'a> {
    pub(super) id: Option<CanId>,
    pub(super) remote: bool,
    pub(super) head: &'a [u8],
    pub(super) tail: &'a [u8],
    pub(super) fields: Fields<'a>,
}

impl<'a> ExchangeFrame<'a> {
    /// A frame on a line: head, tail, at most 8 bytes each, and the fields.
    pub fn stream(head: &'a [u8], tail: &'a [u8], fields: impl Into<Fields<'a>>) -> Self {
        Self { id: None, remote: false, head, tail, fields: fields.into() }
    }

    /// A frame on a CAN bus, at most 8 bytes.
    pub fn can(id: CanId, fields: impl Into<Fields<'a>>) -> Self {
        Self { id: Some(id), remote: false, head: &[], tail: &[], fields: fields.into() }
    }

    /// A remote request on a CAN bus, which has no data.
    pub const fn remote(id: CanId) -> Self {
        Self { id: Some(id), remote: true, head: &[], tail: &[], fields: Fields::Specs(&[]) }
    }
}

/// The type of a field that is one coil.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Coil;

impl From<Coil> for Encoding {
    fn from(_: Coil) -> Self {
        Self::bit(ScalarType::Byte, 0)
    }
}

impl<'a> ExchangeBuilder<'a> {
    /// FC 1: reads coils of a slave, 1..=247.
    pub fn read_coils(slave: u8, address: u16, coils: &'a [InputField<'a>]) -> Self {
        Self::read(slave, Operation::ReadCoils { address, count: 0 }, coils)
    }

    /// FC 2: reads discrete inputs.
    pub fn read_discrete_inputs(slave: u8, address: u16, inputs: &'a [InputField<'a>]) -> Self {
        Self::read(slave, Operation::ReadDiscreteInputs { address, count: 0 }, inputs)
    }

    /// FC 3: reads holding registers.
    pub fn read_holding_registers(slave: u8, address: u16, fields: &'a [InputField<'a>]) -> Self {
        Self::read(slave, Operation::ReadHoldingRegisters { address, count: 0 }, fields)
    }

    /// FC 4: reads input registers.
    pub fn read_input_registers(slave: u8, address: u16, fields: &'a [InputField<'a>]) -> Self {
        Self::read(slave, Operation::ReadInputRegisters { address, count: 0 }, fields)
    }

    /// FC 5: writes one coil; slave 0 is all of them.
    pub fn write_coil(slave: u8, address: u16, coil: &'a [OutputField<'a>; 1]) -> Self {
        Self::write(slave, Operation::WriteCoil { address }, coil)
    }

    /// FC 6: writes one register; slave 0 is all of them.
    pub fn write_register(slave: u8, address: u16, fields: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::WriteRegister { address }, fields)
    }

    /// FC 15: writes coils; slave 0 is all of them. Skipped coils are written as 0.
    pub fn write_coils(slave: u8, address: u16, coils: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::WriteCoils { address, count: 0 }, coils)
    }

    /// FC 16: writes holding registers; slave 0 is all of them.
    pub fn write_registers(slave: u8, address: u16, fields: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::WriteRegisters { address, count: 0 }, fields)
    }

    /// FC 22: writes bits of one holding register; slave 0 is all of them. The slave keeps the bits of no field.
    pub fn mask_write_register(slave: u8, address: u16, bits: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::MaskWriteRegister { address, mask: 0 }, bits)
    }

    /// FC 23: writes holding registers, then reads some.
    pub fn read_write_registers(
        slave: u8,
        (read_address, read): (u16, &'a [InputField<'a>]),
        (write_address, written): (u16, &'a [OutputField<'a>]),
    ) -> Self {
        let (read_count, write_count) = (0, 0);
        let operation =
            Operation::ReadWriteRegisters { read_address, read_count, write_address, write_count };
        Self::new(
            slave,
            TransactionDraft::Rtu { operation, written: Some(written.into()), read: Some(read.into()) },
        )
    }

    /// A block of the gateway as a slave with this address, 1..=247: input fields are written by the
    /// master, output fields are read by it.
    pub fn served(own: u8, table: Table, address: u16, fields: impl Into<Fields<'a>>) -> Self {
        Self::new(own, TransactionDraft::Served { table, address, fields: fields.into() })
    }

    /// Registers or coils as the configuration has them: with the counts of `operation`, and coils packed into bytes. Of
    /// the gateway as a slave if `is_served`.
    pub const fn packed(
        peer: u8,
        operation: Operation,
        is_served: bool,
        (written, read): (&'a [FieldSpec], &'a [FieldSpec]),
    ) -> Self {
        Self::new(peer, TransactionDraft::Packed { operation, is_served, written, read })
    }

    /// A request of a device's own; of device 0, unless [`Self::peer`] says otherwise.
    pub fn request(request: ExchangeFrame<'a>) -> Self {
        Self::frames(Some(request), None, None, None)
    }

    /// A frame that may come at any time.
    pub fn unasked(frame: ExchangeFrame<'a>) -> Self {
        Self::frames(None, Some(frame), None, None)
    }

    /// Frames of a device's own: a request, its reply, a pending answer and a refusal.
    pub fn frames(
        request: Option<ExchangeFrame<'a>>,
        reply: Option<ExchangeFrame<'a>>,
        pending: Option<ExchangeFrame<'a>>,
        refusal: Option<ExchangeFrame<'a>>,
    ) -> Self {
        Self { pending, ..Self::new(0, TransactionDraft::Frames([request, reply, refusal])) }
    }

    fn read(slave: u8, operation: Operation, fields: &'a [InputField<'a>]) -> Self {
        Self::new(slave, TransactionDraft::Rtu { operation, written: None, read: Some(fields.into()) })
    }

    fn write(slave: u8, operation: Operation, fields: &'a [OutputField<'a>]) -> Self {
        Self::new(slave, TransactionDraft::Rtu { operation, written: Some(fields.into()), read: None })
    }

    const fn new(peer: u8, transaction: TransactionDraft<'a>) -> Self {
        let none = Transaction::Frames { request: None, reply: None, refusal: None };
        let exchange = Exchange::new(peer, none, Triggers::NEVER);
        Self { exchange, transaction, retries: None, rising: None, outcome: [None; 3], pending: None }
    }

    /// Takes everything but the frames from an exchange, and the repetitions as [`Self::retries`] does.
    pub fn settings(self, exchange: Exchange, retries: Option<u8>) -> Self {
        let OutcomeTo { to, code_to, count_to } = exchange.outcome;
        let outcome = [to, code_to, count_to].map(|var| var.map(Var::Var));
        Self { exchange, retries, outcome, rising: None, ..self }
    }

    /// What answers the request. No effect on Modbus, whose replies are known.
    pub fn reply(mut self, frame: ExchangeFrame<'a>) -> Self {
        if let TransactionDraft::Frames([_, reply, _]) = &mut self.transaction {
            *reply = Some(frame);
        }
        self
    }

    /// What the device sends while it is at it: its answer is awaited anew. No effect on Modbus.
    pub fn pending(mut self, frame: ExchangeFrame<'a>) -> Self {
        if matches!(self.transaction, TransactionDraft::Frames(_)) {
            self.pending = Some(frame);
        }
        self
    }

    /// What the device sends if it refuses the request. No effect on Modbus.
    pub fn refusal(mut self, frame: ExchangeFrame<'a>) -> Self {
        if let TransactionDraft::Frames([_, _, refusal]) = &mut self.transaction {
            *refusal = Some(frame);
        }
        self
    }

    /// The device has restarted when this field of the reply, counted from 0 without padding and texts, becomes `value`:
    /// what is asked at its start is asked again.
    pub const fn restarted(mut self, field: u8, value: f64) -> Self {
        self.exchange.restarted = Some(Restarted { field, value });
        self
    }

    /// The device of an exchange with frames of its own; exchanges of one device share its presence.
    pub const fn peer(mut self, peer: u8) -> Self {
        self.exchange.peer = peer;
        self
    }

    /// Asked with this period, up to an hour.
    pub const fn every(mut self, period: Duration) -> Self {
        self.exchange.when.every = Some(period);
        self
    }

    /// Asked at the start, and again when the device has started anew.
    pub const fn at_start(mut self) -> Self {
        self.exchange.when.start = true;
        self
    }

    /// Asked when a value of the request has changed.
    pub const fn on_change(mut self) -> Self {
        self.exchange.when.change = true;
        self
    }

    /// Asked when this bit, 0..=7, of a bit variable goes from 0 to 1.
    pub fn on_rising(mut self, var: impl Into<Var<'a>>, bit: u8) -> Self {
        self.rising = Some((var.into(), bit));
        self
    }

    /// How long the reply may take, from the end of the request to its own end; 100 ms by default.
    pub const fn timeout(mut self, timeout: Duration) -> Self {
        self.exchange.timeout = timeout;
        self
    }

    /// How often a request without a good reply is repeated at once. By default once; an event, or what is only asked
    /// at the start, is not: the device may carry it out twice.
    pub const fn retries(mut self, retries: u8) -> Self {
        self.retries = Some(retries);
        self
    }

    /// How long after an event it may be sent, up to 10 s; by default the timeout of the port, at most 1 s.
    pub const fn trigger(mut self, trigger: Duration) -> Self {
        self.exchange.trigger = Some(trigger);
        self
    }

    /// How long after its request a reply may come; by default three timeouts, at least 1 s. Until then nothing is asked
    /// of the device whose reply could be taken for it.
    pub const fn late(mut self, late: Duration) -> Self {
        self.exchange.late = Some(late);
        self
    }

    /// It stops its device: it goes first, cancels the device's events, and is repeated until it is confirmed.
    pub const fn stops(mut self) -> Self {
        self.exchange.stop = true;
        self
    }

    /// Sent after the good answer of this exchange of the recipe, counted from 0.
    pub const fn follows(mut self, exchange: u8) -> Self {
        self.exchange.follow = Some(exchange);
        self
    }

    /// When the values of the reply are overdue; [`Port::NEVER`](super::Port::NEVER) for a reply that comes only when
    /// something happens. By default the timeout of the port.
    pub const fn overdue(mut self, overdue: Duration) -> Self {
        self.exchange.overdue = Some(overdue);
        self
    }

    /// The variable that tells the robot what became of an event, as the number of an
    /// [`Outcome`](crate::engine::Outcome).
    pub fn outcome(mut self, to: impl Into<Var<'a>>) -> Self {
        self.outcome[0] = Some(to.into());
        self
    }

    /// The variable that gets the code with which the device refused the newest event, or 0.
    pub fn outcome_code(mut self, to: impl Into<Var<'a>>) -> Self {
        self.outcome[1] = Some(to.into());
        self
    }

    /// The variable that counts the events that have ended, wrapping.
    pub fn outcome_count(mut self, to: impl Into<Var<'a>>) -> Self {
        self.outcome[2] = Some(to.into());
        self
    }

    /// How long the line rests after it, up to 10 s; not at all by default.
    pub const fn pause(mut self, pause: Duration) -> Self {
        self.exchange.pause = pause;
        self
    }

    /// Whether its frames are on a CAN bus.
    pub(super) fn is_can(&self) -> bool {
        self.all_frames().any(|frame| frame.id.is_some())
    }

    /// The frames of a device's own.
    pub(super) fn all_frames(&self) -> impl Iterator<Item = &ExchangeFrame<'a>> {
        let frames = match &self.transaction {
            TransactionDraft::Frames(frames) => &frames[..],
            _ => &[],
        };
        frames.iter().chain([&self.pending]).flatten()
    }

    /// All lists of fields.
    pub(super) fn fields(&self) -> impl Iterator<Item = Fields<'a>> {
        let own = match self.transaction {
            TransactionDraft::Rtu { written, read, .. } => [written, read],
            TransactionDraft::Served { fields, .. } => [Some(fields), None],
            TransactionDraft::Packed { written, read, .. } => [written, read].map(|specs| Some(specs.into())),
            TransactionDraft::Frames(_) => [None; 2],
        };
        own.into_iter().flatten().chain(self.all_frames().map(|frame| frame.fields))
    }
}
