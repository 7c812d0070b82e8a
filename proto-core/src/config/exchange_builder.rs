//! Exchanges as written in a program.
//!
//! In: the caller's addresses, numbers and slices. Out: the same, borrowed and small. All defaults are those of files
//! (docs/configuration.md). [`Recipe::user`](super::Recipe::user) takes them with
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
/// The numbers of registers and coils result from the fields. Fields of registers are big-endian unless their encoding
/// has an order other than the default, little-endian. Fields of coils have the type [`Coil`]; padding skips this many
/// coils.
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
    /// The exchange in the configuration's form, without the results of the fields below.
    pub(super) exchange: Exchange,
    pub(super) transaction: TransactionDraft<'a>,
    pub(super) retries: Option<u8>,
    pub(super) rising: Option<(Var<'a>, u8)>,
    pub(super) outcome: [Option<Var<'a>>; 3],
    pub(super) pending: Option<ExchangeFrame<'a>>,
}

/// The frames of an exchange; operations have counts of 0 here.
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
    /// In the configuration's form, with counts.
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

    /// FC 5: writes one coil; slave 0 is a broadcast.
    pub fn write_coil(slave: u8, address: u16, coil: &'a [OutputField<'a>; 1]) -> Self {
        Self::write(slave, Operation::WriteCoil { address }, coil)
    }

    /// FC 6: writes one register; slave 0 is a broadcast.
    pub fn write_register(slave: u8, address: u16, fields: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::WriteRegister { address }, fields)
    }

    /// FC 15: writes coils; slave 0 is a broadcast. Skipped coils are written as 0.
    pub fn write_coils(slave: u8, address: u16, coils: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::WriteCoils { address, count: 0 }, coils)
    }

    /// FC 16: writes holding registers; slave 0 is a broadcast.
    pub fn write_registers(slave: u8, address: u16, fields: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::WriteRegisters { address, count: 0 }, fields)
    }

    /// FC 22: writes bits of one holding register; slave 0 is a broadcast. Bits without a field stay unchanged.
    pub fn mask_write_register(slave: u8, address: u16, bits: &'a [OutputField<'a>]) -> Self {
        Self::write(slave, Operation::MaskWriteRegister { address, mask: 0 }, bits)
    }

    /// FC 23: writes holding registers, then reads holding registers.
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

    /// A block that the gateway serves as a slave with this address, 1..=247: the master writes input fields and reads
    /// output fields.
    pub fn served(own: u8, table: Table, address: u16, fields: impl Into<Fields<'a>>) -> Self {
        Self::new(own, TransactionDraft::Served { table, address, fields: fields.into() })
    }

    /// Registers or coils in the configuration's form, with the counts of `operation`, and coils packed into bytes. If
    /// `is_served`, they are a block of the gateway as a slave.
    pub const fn packed(
        peer: u8,
        operation: Operation,
        is_served: bool,
        (written, read): (&'a [FieldSpec], &'a [FieldSpec]),
    ) -> Self {
        Self::new(peer, TransactionDraft::Packed { operation, is_served, written, read })
    }

    /// A request with a device's own frame, to device 0 unless set by [`Self::peer`].
    pub fn request(request: ExchangeFrame<'a>) -> Self {
        Self::frames(Some(request), None, None, None)
    }

    /// An unsolicited frame, which may arrive at any time.
    pub fn unasked(frame: ExchangeFrame<'a>) -> Self {
        Self::frames(None, Some(frame), None, None)
    }

    /// A device's own frames: a request, its reply, a pending answer and a refusal.
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

    /// Takes everything except the frames from an exchange, and sets the repetitions like [`Self::retries`].
    pub fn settings(self, exchange: Exchange, retries: Option<u8>) -> Self {
        let OutcomeTo { to, code_to, count_to } = exchange.outcome;
        let outcome = [to, code_to, count_to].map(|var| var.map(Var::Var));
        Self { exchange, retries, outcome, rising: None, ..self }
    }

    /// Sets the reply. No effect on Modbus, which defines it.
    pub fn reply(mut self, frame: ExchangeFrame<'a>) -> Self {
        if let TransactionDraft::Frames([_, reply, _]) = &mut self.transaction {
            *reply = Some(frame);
        }
        self
    }

    /// Sets the frame that a device sends while the request is in progress; it restarts the timeout. No effect on
    /// Modbus.
    pub fn pending(mut self, frame: ExchangeFrame<'a>) -> Self {
        if matches!(self.transaction, TransactionDraft::Frames(_)) {
            self.pending = Some(frame);
        }
        self
    }

    /// Sets the frame that refuses the request. No effect on Modbus.
    pub fn refusal(mut self, frame: ExchangeFrame<'a>) -> Self {
        if let TransactionDraft::Frames([_, _, refusal]) = &mut self.transaction {
            *refusal = Some(frame);
        }
        self
    }

    /// Sets the sign of a restart: this field of the reply, counted from 0 without padding and texts, becomes `value`.
    /// Requests at the start are then sent again.
    pub const fn restarted(mut self, field: u8, value: f64) -> Self {
        self.exchange.restarted = Some(Restarted { field, value });
        self
    }

    /// Sets the device, for exchanges with its own frames; exchanges of one device share its availability.
    pub const fn peer(mut self, peer: u8) -> Self {
        self.exchange.peer = peer;
        self
    }

    /// Sends the request with this period, up to an hour.
    pub const fn every(mut self, period: Duration) -> Self {
        self.exchange.when.every = Some(period);
        self
    }

    /// Sends the request at the start, and again when the device has restarted.
    pub const fn at_start(mut self) -> Self {
        self.exchange.when.start = true;
        self
    }

    /// Sends the request when one of its values has changed.
    pub const fn on_change(mut self) -> Self {
        self.exchange.when.change = true;
        self
    }

    /// Sends the request when this bit, 0..=7, of a bit variable changes from 0 to 1.
    pub fn on_rising(mut self, var: impl Into<Var<'a>>, bit: u8) -> Self {
        self.rising = Some((var.into(), bit));
        self
    }

    /// Sets the maximum time from the end of the request to the end of the reply; 100 ms by default.
    pub const fn timeout(mut self, timeout: Duration) -> Self {
        self.exchange.timeout = timeout;
        self
    }

    /// Sets how often a request without a good reply is repeated immediately. The default is once, and not at all for
    /// events and requests sent only at the start, which the device may execute twice.
    pub const fn retries(mut self, retries: u8) -> Self {
        self.retries = Some(retries);
        self
    }

    /// Sets how long after an event it may be sent, up to 10 s; by default the timeout of the port, at most 1 s.
    pub const fn trigger(mut self, trigger: Duration) -> Self {
        self.exchange.trigger = Some(trigger);
        self
    }

    /// Sets how long after its request a late reply may arrive; by default three timeouts, at least 1 s. Until then,
    /// requests to the device wait if their replies could be confused with it.
    pub const fn late(mut self, late: Duration) -> Self {
        self.exchange.late = Some(late);
        self
    }

    /// Makes the exchange stop its device: it is sent first, cancels the device's events, and is repeated until
    /// confirmed.
    pub const fn stops(mut self) -> Self {
        self.exchange.stop = true;
        self
    }

    /// Sends the request after the good reply of this exchange of the recipe, counted from 0.
    pub const fn follows(mut self, exchange: u8) -> Self {
        self.exchange.follow = Some(exchange);
        self
    }

    /// Sets when the values of the reply are overdue; by default the timeout of the port.
    /// [`Port::NEVER`](super::Port::NEVER) for a reply that is sent only on events.
    pub const fn overdue(mut self, overdue: Duration) -> Self {
        self.exchange.overdue = Some(overdue);
        self
    }

    /// Sets the variable that reports the outcome of an event to the robot, as the number of an
    /// [`Outcome`](crate::engine::Outcome).
    pub fn outcome(mut self, to: impl Into<Var<'a>>) -> Self {
        self.outcome[0] = Some(to.into());
        self
    }

    /// Sets the variable for the code with which the device refused the newest event, or 0.
    pub fn outcome_code(mut self, to: impl Into<Var<'a>>) -> Self {
        self.outcome[1] = Some(to.into());
        self
    }

    /// Sets the variable that counts the events that have ended, wrapping.
    pub fn outcome_count(mut self, to: impl Into<Var<'a>>) -> Self {
        self.outcome[2] = Some(to.into());
        self
    }

    /// Sets the pause on the line after the exchange, up to 10 s; none by default.
    pub const fn pause(mut self, pause: Duration) -> Self {
        self.exchange.pause = pause;
        self
    }

    /// Whether its frames are on a CAN bus.
    pub(super) fn is_can(&self) -> bool {
        self.all_frames().any(|frame| frame.id.is_some())
    }

    pub(super) fn all_frames(&self) -> impl Iterator<Item = &ExchangeFrame<'a>> {
        let frames = match &self.transaction {
            TransactionDraft::Frames(frames) => &frames[..],
            _ => &[],
        };
        frames.iter().chain([&self.pending]).flatten()
    }

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
