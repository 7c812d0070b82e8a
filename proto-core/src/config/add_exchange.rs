//! Adds the exchanges of a recipe to a configuration.
//!
//! In: what a program wrote ([`ExchangeBuilder`]). Out: entries in the configuration's lists. Packs coils into bytes,
//! and counts registers and coils. Space was checked at the beginning of the recipe.

use super::device::register_bits;
use super::error::{ConfigError, ConfigErrorKind as Kind, ExchangeKey, Place};
use super::exchange::{Exchange, FrameSpec, Transaction, has_values};
use super::exchange_builder::{ExchangeBuilder, ExchangeFrame, TransactionDraft};
use super::fields::{Fields, Var};
use super::view::ConfigMut;
use super::{Delimiter, ExchangeError, FieldSpec, OutcomeTo, Span};
use crate::device::{Bits, ByteOrder, Encoding, Kind as EncodingKind, Overflow};
use crate::modbus::rtu::{Operation, Table};
use crate::recipe::model::MAX_DELIMITER;
use crate::sysvar::{Direction, ParseError};

/// Numbers of the next frame of the input part and of the output part.
#[derive(Clone, Copy)]
pub(super) struct FrameNumbers {
    pub(super) input: u8,
    pub(super) output: u8,
}

impl FrameNumbers {
    fn next(&mut self, part: Direction) -> u8 {
        let number = match part {
            Direction::Input => &mut self.input,
            Direction::Output => &mut self.output,
        };
        let next = number.saturating_add(1);
        core::mem::replace(number, next)
    }
}

impl ConfigMut<'_> {
    /// Adds the exchanges of a recipe; `frames` counts the frames of its parts.
    pub(super) fn add_exchanges(
        &mut self,
        recipe: u8,
        asks: &[ExchangeBuilder<'_>],
        mut frames: FrameNumbers,
    ) -> Result<Span, ConfigError> {
        let start = self.exchanges.len();
        for (nth, ask) in asks.iter().enumerate() {
            let at = |key| Place::Exchange { recipe, exchange: nth as u8, key };
            let (transaction, pending) = self.transaction(recipe, ask, &at, &mut frames)?;
            let variable = |key| move |error| ConfigError { place: at(key), kind: Kind::Variable(error) };
            let mut exchange = Exchange { transaction, pending, ..ask.exchange };
            if let Some((var, bit)) = ask.rising {
                exchange.when.rising = Some((var.read().map_err(variable(ExchangeKey::Rising))?, bit));
            }
            exchange.outcome = outcome(&ask.outcome).map_err(variable(ExchangeKey::Outcome))?;
            let _ = self.exchanges.push(exchange.repeated(ask.retries));
        }
        Ok(Span::between(start, self.exchanges.len()))
    }

    fn transaction(
        &mut self,
        recipe: u8,
        ask: &ExchangeBuilder<'_>,
        at: &impl Fn(ExchangeKey) -> Place,
        frames: &mut FrameNumbers,
    ) -> Result<(Transaction, Option<u8>), ConfigError> {
        let refused = |kind| ConfigError { place: at(ExchangeKey::Registers), kind };
        match &ask.transaction {
            TransactionDraft::Rtu { operation, written, read } => {
                let is_of_coils = matches!(operation.place().0, Table::Coils | Table::DiscreteInputs);
                let mut add = |fields: &Option<Fields<'_>>, part: Direction| match fields {
                    Some(fields) => {
                        let at = (recipe, part, frames.next(part));
                        self.data(at, fields, is_of_coils).map_err(|error| error.placed(refused))
                    }
                    None => Ok((Span::default(), 0)),
                };
                let (written, write_count) = add(written, Direction::Output)?;
                let (read, read_count) = add(read, Direction::Input)?;
                let mask = register_bits(written.of(self.fields));
                let operation = with_counts(*operation, read_count, write_count, mask);
                Ok((Transaction::Rtu { operation, written, read }, None))
            }
            &TransactionDraft::Served { table, address, fields } => {
                let part = match fields {
                    Fields::Inputs(_) => Direction::Input,
                    Fields::Outputs(_) => Direction::Output,
                    Fields::Specs(specs) if specs.iter().any(FieldSpec::is_input) => Direction::Input,
                    _ => Direction::Output,
                };
                let is_of_coils = matches!(table, Table::Coils | Table::DiscreteInputs);
                let at = (recipe, part, frames.next(part));
                let (span, count) =
                    self.data(at, &fields, is_of_coils).map_err(|error| error.placed(refused))?;
                let operation = Operation::of_block(table, part, address, count);
                let none = Span::default();
                let (written, read) = if part == Direction::Input { (span, none) } else { (none, span) };
                Ok((Transaction::Served { operation, written, read }, None))
            }
            &TransactionDraft::Packed { operation, is_served, written, read } => {
                let (of_written, of_read) = match is_served {
                    true => (Direction::Input, Direction::Output),
                    false => (Direction::Output, Direction::Input),
                };
                let mut add = |fields: &[FieldSpec], part| match fields {
                    [] => Ok(Span::default()),
                    _ => self.fields_of_part(recipe, part, frames.next(part), &fields.into()),
                };
                let (written, read) = (add(written, of_written)?, add(read, of_read)?);
                let transaction = match is_served {
                    true => Transaction::Served { operation, written, read },
                    false => Transaction::Rtu { operation, written, read },
                };
                Ok((transaction, None))
            }
            TransactionDraft::Frames([request, reply, refusal]) => {
                let all = [
                    (request, Direction::Output, ExchangeKey::Request),
                    (reply, Direction::Input, ExchangeKey::Reply),
                    (&ask.pending, Direction::Input, ExchangeKey::Pending),
                    (refusal, Direction::Input, ExchangeKey::Refusal),
                ];
                let mut added = [None; 4];
                for (added, (frame, part, key)) in added.iter_mut().zip(all) {
                    let Some(frame) = frame else { continue };
                    let index = self.add_frame((recipe, part), frame, at(key), frames)?;
                    let is_counted = matches!(key, ExchangeKey::Request | ExchangeKey::Reply);
                    let span = self.frames.get(usize::from(index)).map(|frame| frame.fields);
                    if is_counted || span.is_some_and(|span| has_values(span.of(self.fields))) {
                        frames.next(part);
                    }
                    *added = Some(index);
                }
                let [request, reply, pending, refusal] = added;
                Ok((Transaction::Frames { request, reply, refusal }, pending))
            }
        }
    }

    fn add_frame(
        &mut self,
        (recipe, part): (u8, Direction),
        from: &ExchangeFrame<'_>,
        place: Place,
        frames: &FrameNumbers,
    ) -> Result<u8, ConfigError> {
        let bytes = |bytes: &[u8]| {
            let kind = Kind::TooLong { len: bytes.len(), longest: MAX_DELIMITER };
            Delimiter::from_slice(bytes).map_err(|_| ConfigError { place, kind })
        };
        let (head, tail) = (bytes(from.head)?, bytes(from.tail)?);
        let number = match part {
            Direction::Input => frames.input,
            Direction::Output => frames.output,
        };
        let fields = self.fields_of_part(recipe, part, number, &from.fields)?;
        let index = self.frames.len() as u8;
        let _ = self.frames.push(FrameSpec { id: from.id, remote: from.remote, head, tail, fields });
        Ok(index)
    }

    /// Adds the fields of registers or coils, and returns the count of these.
    fn data(
        &mut self,
        (recipe, part, number): (u8, Direction, u8),
        from: &Fields<'_>,
        is_of_coils: bool,
    ) -> Result<(Span, u16), RefusedExchange> {
        let span = self.fields_of_part(recipe, part, number, from).map_err(RefusedExchange::Placed)?;
        let start = usize::from(span.start);
        if matches!(from, Fields::Specs(_)) && is_of_coils {
            // Packed already, as in the configuration.
            let fields = self.fields.get(start..).unwrap_or(&[]);
            return Ok((span, bits_of(fields)));
        }
        if is_of_coils {
            let (len, count) = pack(self.fields.get_mut(start..).unwrap_or(&mut []))?;
            self.fields.truncate(start.saturating_add(len));
            return Ok((Span { len: len as u16, ..span }, count));
        }
        let fields = self.fields.get_mut(start..).unwrap_or(&mut []);
        if !matches!(from, Fields::Specs(_)) {
            fields.iter_mut().for_each(into_register);
        }
        // Fields of varying length are refused later.
        let bytes = fields.iter().map(FieldSpec::longest).fold(0, usize::saturating_add);
        Ok((span, (bytes / 2) as u16))
    }
}

/// An error, with or without its place.
enum RefusedExchange {
    Placed(ConfigError),
    Kind(Kind),
}

impl RefusedExchange {
    fn placed(self, at: impl FnOnce(Kind) -> ConfigError) -> ConfigError {
        match self {
            Self::Placed(error) => error,
            Self::Kind(kind) => at(kind),
        }
    }
}

fn outcome(from: &[Option<Var<'_>>; 3]) -> Result<OutcomeTo, ParseError> {
    let read = |var: &Option<Var<'_>>| var.map(|var| var.read()).transpose();
    let [to, code_to, count_to] = from;
    Ok(OutcomeTo { to: read(to)?, code_to: read(code_to)?, count_to: read(count_to)? })
}

fn with_counts(operation: Operation, read: u16, written: u16, mask: u16) -> Operation {
    let (_, address, _) = operation.place();
    let write_address = match operation {
        Operation::ReadWriteRegisters { write_address, .. } => write_address,
        _ => address,
    };
    let (read, written) = ((address, read), (write_address, written));
    Operation::of_function(operation.function(), read, written, mask).unwrap_or(operation)
}

/// Changes the default byte order to that of registers.
fn into_register(field: &mut FieldSpec) {
    let big = |encoding: Encoding| {
        let is_number = !matches!(encoding.kind, EncodingKind::Decimal(_) | EncodingKind::Hex(_));
        let is_usual = encoding.order == ByteOrder::Little && encoding.size().is_some_and(|size| size > 1);
        if is_number && is_usual { encoding.big_endian() } else { encoding }
    };
    *field = match *field {
        FieldSpec::UserInput { ty, to } if ty.size() > 1 => {
            let encoding = Encoding::scalar(ty).big_endian();
            FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to }
        }
        FieldSpec::UserOutput { ty, from } if ty.size() > 1 => {
            let encoding = Encoding::scalar(ty).big_endian();
            FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from }
        }
        FieldSpec::DeviceInput { encoding, overflow, to } => {
            FieldSpec::DeviceInput { encoding: big(encoding), overflow, to }
        }
        FieldSpec::DeviceOutput { encoding, overflow, from } => {
            FieldSpec::DeviceOutput { encoding: big(encoding), overflow, from }
        }
        FieldSpec::Fixed { encoding, value } => FieldSpec::Fixed { encoding: big(encoding), value },
        other => other,
    };
}

/// Number of coils of packed fields: up to the last bit used in the last byte that has a field, or the whole byte.
fn bits_of(fields: &[FieldSpec]) -> u16 {
    let bytes = fields.iter().map(FieldSpec::longest).fold(0, usize::saturating_add);
    let all = bytes.saturating_mul(8);
    let is_coil = |field: &&FieldSpec| !field.is_of_field_before();
    let highest = fields.iter().rev().filter(is_coil).map_while(bit_of).max();
    let last = highest.map_or(0, |highest| 7_usize.saturating_sub(usize::from(highest)));
    all.saturating_sub(last) as u16
}

/// The bit of a byte that the field is.
fn bit_of(field: &FieldSpec) -> Option<u8> {
    match field.element()?.encoding()?.kind {
        EncodingKind::Bits(Bits { bytes: 1, first, count: 1, .. }) => Some(first),
        _ => None,
    }
}

/// Packs coils, the first in the lowest bit; returns the numbers of resulting fields and of coils.
fn pack(fields: &mut [FieldSpec]) -> Result<(usize, u16), RefusedExchange> {
    let (mut kept, mut count, mut bytes) = (0_usize, 0_usize, 0_usize);
    for nth in 0..fields.len() {
        let Some(&field) = fields.get(nth) else { break };
        if let FieldSpec::Padding { len, .. } = field {
            count = count.saturating_add(usize::from(len));
            continue;
        }
        if field.is_of_field_before() {
            put(fields, &mut kept, field);
            continue;
        }
        let (byte, first) = (count / 8, (count % 8) as u8);
        put_padding(fields, &mut kept, &mut bytes, byte);
        let shared = bytes > byte;
        let packed = as_coil(field, first, shared)
            .ok_or(RefusedExchange::Kind(Kind::Exchange(ExchangeError::NotCoils)))?;
        // Every field or padding results in at most one, so there are never more fields than before.
        put(fields, &mut kept, packed);
        (bytes, count) = (byte.saturating_add(1), count.saturating_add(1));
    }
    put_padding(fields, &mut kept, &mut bytes, count.div_ceil(8));
    Ok((kept, u16::try_from(count).unwrap_or(u16::MAX)))
}

fn put(fields: &mut [FieldSpec], kept: &mut usize, field: FieldSpec) {
    if let Some(place) = fields.get_mut(*kept) {
        *place = field;
        *kept = kept.saturating_add(1);
    }
}

/// Adds padding for bytes without coils; at most 255, which the check of the count refuses.
fn put_padding(fields: &mut [FieldSpec], kept: &mut usize, bytes: &mut usize, up_to: usize) {
    let missing = up_to.saturating_sub(*bytes);
    if missing > 0 {
        let len = u8::try_from(missing).unwrap_or(u8::MAX);
        put(fields, kept, FieldSpec::Padding { len, fill: 0 });
        *bytes = up_to;
    }
}

fn as_coil(field: FieldSpec, first: u8, shared: bool) -> Option<FieldSpec> {
    let coil = |encoding: Encoding| {
        let bits = Bits { bytes: 1, first: 0, count: 1, signed: false };
        let is_coil = encoding.kind == EncodingKind::Bits(bits);
        let kind = EncodingKind::Bits(Bits { first, ..bits });
        is_coil.then_some(Encoding { kind, order: ByteOrder::Little, shared })
    };
    Some(match field {
        FieldSpec::DeviceInput { encoding, overflow, to } => {
            FieldSpec::DeviceInput { encoding: coil(encoding)?, overflow, to }
        }
        FieldSpec::DeviceOutput { encoding, overflow, from } => {
            FieldSpec::DeviceOutput { encoding: coil(encoding)?, overflow, from }
        }
        FieldSpec::Fixed { encoding, value } => FieldSpec::Fixed { encoding: coil(encoding)?, value },
        _ => return None,
    })
}
