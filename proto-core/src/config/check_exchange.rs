//! The checks that concern the exchanges of one recipe.

use core::fmt;

use super::error::{ConfigErrorKind as Kind, Place};
use super::exchange::{AskWhen, Exchange, FrameSpec, Talk};
use super::rules::{Check, MAX_TIME, check_pool, check_time, fail};
use super::{ConfigView, DeviceFrame, FieldSpec, Parts, Recipe, Span};
use crate::device::{Carrier, LayoutError};
use crate::modbus::rtu::{BROADCAST, CountError, MAX_ADDRESS, MAX_SLAVES, Operation};
use crate::recipe::model::Mode;
use crate::sysvar::Direction;

/// The longest pause after an exchange.
const MAX_PAUSE: crate::time::Duration = crate::time::Duration::from_secs(10);

/// Why an exchange is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ExchangeError {
    /// The recipe is realtime.
    NeedsUser,
    /// Modbus master, Modbus slave and frames of a device's own are mixed in one recipe.
    Mixed,
    /// A recipe of Modbus has parts.
    PartsBesideModbus,
    /// A frame for a line in a CAN recipe, or one with an id in a stream recipe.
    WrongBus,
    /// The slave's address.
    Slave {
        /// The address.
        address: u8,
    },
    /// A broadcast that reads: nobody would answer.
    BroadcastRead,
    /// More slaves or other peers than one port can have.
    TooManyPeers,
    /// The count of registers or coils.
    Count(CountError),
    /// The fields do not fill their registers or coils.
    Fields {
        /// The bytes of the registers or coils.
        needed: usize,
        /// The bytes of the fields.
        found: usize,
    },
    /// The fields have no fixed length.
    Varying,
    /// An operation that a slave does not serve.
    NotServed,
    /// Registers or coils that another block has.
    Overlap,
    /// Neither request nor reply.
    Nothing,
    /// A refusal without a request and its reply.
    LoneRefusal,
    /// A request that is never sent.
    Never,
    /// A reply that comes unasked has a time at which it is asked.
    Unasked,
    /// A remote request with fields.
    RemoteFields,
}

impl fmt::Display for ExchangeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NeedsUser => f.write_str("exchanges need mode = \"user\""),
            Self::Mixed => {
                f.write_str("a recipe has exchanges of one kind: Modbus master, Modbus slave, or frames")
            }
            Self::PartsBesideModbus => {
                f.write_str("a recipe of Modbus has exchanges only, no input and output part")
            }
            Self::WrongBus => {
                f.write_str("frames of a CAN recipe have an id, those of a stream recipe have none")
            }
            Self::Slave { address } => {
                write!(
                    f,
                    "slave {address} is out of range; allowed: 1..={MAX_ADDRESS}, or 0 to write to all of them"
                )
            }
            Self::BroadcastRead => {
                f.write_str("slave 0 is all of them, which cannot be read; allowed: writes")
            }
            Self::TooManyPeers => {
                write!(f, "one slave or other peer too many; allowed: up to {MAX_SLAVES} on a port")
            }
            Self::Count(error) => error.fmt(f),
            Self::Fields { needed, found } => {
                write!(f, "the fields have {found} bytes, the registers or coils {needed}; pad fills them up")
            }
            Self::Varying => f.write_str("fields in registers have a fixed length; give the text a width"),
            Self::NotServed => {
                f.write_str("a block has holding registers, input registers, coils or discrete inputs")
            }
            Self::Overlap => f.write_str("an earlier block has some of these registers or coils"),
            Self::Nothing => f.write_str("an exchange needs a request, a reply or both"),
            Self::LoneRefusal => f.write_str("a refusal answers a request that has a reply"),
            Self::Never => f.write_str("it would never be asked; set every_ms or on"),
            Self::Unasked => f.write_str("without a request there is nothing to ask; remove every_ms and on"),
            Self::RemoteFields => f.write_str("a remote request has no fields"),
        }
    }
}

/// The exchanges of one recipe under check.
pub(super) struct ExchangeCheck<'a> {
    pub config: ConfigView<'a>,
    pub index: u8,
    pub recipe: &'a Recipe,
}

impl<'a> ExchangeCheck<'a> {
    pub(super) fn check(&self) -> Check {
        check_pool(self.at(0), self.recipe.exchanges, self.config.exchanges.len())?;
        let exchanges = self.config.exchanges_of(self.recipe);
        let (mut peers, mut count) = ([false; 256], 0_usize);
        for (nth, exchange) in (0..).zip(exchanges) {
            self.check_one(nth, exchange).map_err(|error| error.at(self.at(nth)))?;
            if let Some(seen) = peers.get_mut(usize::from(exchange.peer))
                && !core::mem::replace(seen, true)
                && !matches!(exchange.talk, Talk::Rtu { .. } if exchange.peer == BROADCAST)
            {
                count = count.saturating_add(1);
            }
            if count > MAX_SLAVES {
                return fail(self.at(nth), Kind::Exchange(ExchangeError::TooManyPeers));
            }
            let earlier = exchanges.iter().take(usize::from(nth));
            for before in earlier {
                if core::mem::discriminant(&before.talk) != core::mem::discriminant(&exchange.talk) {
                    return fail(self.at(nth), Kind::Exchange(ExchangeError::Mixed));
                }
                if overlap(before, exchange) {
                    return fail(self.at(nth), Kind::Exchange(ExchangeError::Overlap));
                }
            }
            check_time(self.at(nth), exchange.timeout, MAX_TIME)?;
            if let Some(every) = exchange.when.every {
                check_time(self.at(nth), every, MAX_TIME)?;
            }
            if exchange.pause > MAX_PAUSE {
                return fail(self.at(nth), Kind::TimeTooLong { time: exchange.pause, longest: MAX_PAUSE });
            }
            if let Some((var, bit)) = exchange.when.rising {
                super::check_recipe::check_bit(self.at(nth), var, bit)?;
            }
        }
        Ok(())
    }

    fn at(&self, exchange: u8) -> Place {
        Place::Exchange { recipe: self.index, exchange }
    }

    fn check_one(&self, nth: u8, exchange: &Exchange) -> Result<(), Wrong> {
        if self.recipe.mode != Mode::User {
            return Err(ExchangeError::NeedsUser.into());
        }
        let is_alone = matches!(self.recipe.parts, Parts::Stream { input: None, output: None });
        match exchange.talk {
            Talk::Rtu { .. } | Talk::Served { .. } if !is_alone => {
                Err(ExchangeError::PartsBesideModbus.into())
            }
            Talk::Rtu { operation, written, read } => {
                if exchange.peer > MAX_ADDRESS {
                    return Err(ExchangeError::Slave { address: exchange.peer }.into());
                }
                if exchange.peer == BROADCAST && operation.reads() {
                    return Err(ExchangeError::BroadcastRead.into());
                }
                if exchange.when.is_never() {
                    return Err(ExchangeError::Never.into());
                }
                self.check_operation(operation, written, read)
            }
            Talk::Served { operation, written, read } => {
                if exchange.peer == BROADCAST || exchange.peer > MAX_ADDRESS {
                    return Err(ExchangeError::Slave { address: exchange.peer }.into());
                }
                let first = self.config.exchanges_of(self.recipe).first();
                if first.is_some_and(|first| first.peer != exchange.peer) || !exchange.when.is_never() {
                    return Err(ExchangeError::NotServed.into());
                }
                match operation {
                    Operation::ReadWriteRegisters { .. }
                    | Operation::WriteCoil { .. }
                    | Operation::WriteRegister { .. } => Err(ExchangeError::NotServed.into()),
                    _ => self.check_operation(operation, written, read),
                }
            }
            Talk::Frames { request, reply, refusal } => {
                self.check_frames(nth, &exchange.when, [request, reply, refusal])
            }
        }
    }

    /// Counts, and that the fields fill them.
    fn check_operation(&self, operation: Operation, written: Span, read: Span) -> Result<(), Wrong> {
        operation.check().map_err(ExchangeError::Count)?;
        let parts = [
            (Direction::Output, written, operation.written_len()),
            (Direction::Input, read, operation.read_len()),
        ];
        for (part, span, needed) in parts {
            check_pool(self.at(0), span, self.config.fields.len()).map_err(Wrong::Other)?;
            let fields = span.of(self.config.fields);
            if fields.is_empty() && needed == 0 {
                continue;
            }
            let layout = DeviceFrame::new(Carrier::Whole, part, (&[], &[]), fields)?.layout;
            let (shortest, longest) = layout.lengths();
            if shortest != longest {
                return Err(ExchangeError::Varying.into());
            }
            if longest != needed {
                return Err(ExchangeError::Fields { needed, found: longest }.into());
            }
        }
        Ok(())
    }

    fn check_frames(&self, nth: u8, when: &AskWhen, frames: [Option<u8>; 3]) -> Result<(), Wrong> {
        let [request, reply, refusal] = frames;
        match (request, reply, refusal) {
            (None, None, _) => return Err(ExchangeError::Nothing.into()),
            (None, _, Some(_)) | (_, None, Some(_)) => return Err(ExchangeError::LoneRefusal.into()),
            (Some(_), ..) if when.is_never() => return Err(ExchangeError::Never.into()),
            (None, ..) if !when.is_never() => return Err(ExchangeError::Unasked.into()),
            _ => {}
        }
        for (part, index) in [Direction::Output, Direction::Input, Direction::Input].into_iter().zip(frames) {
            let Some(index) = index else { continue };
            let span = Span { start: index.into(), len: 1 };
            check_pool(self.at(nth), span, self.config.frames.len()).map_err(Wrong::Other)?;
            let Some(frame) = self.config.frames.get(usize::from(index)) else { continue };
            check_pool(self.at(nth), frame.fields, self.config.fields.len()).map_err(Wrong::Other)?;
            let is_can = matches!(self.recipe.parts, Parts::Can { .. });
            if frame.id.is_some() != is_can || (frame.remote && !is_can) {
                return Err(ExchangeError::WrongBus.into());
            }
            if let Some(id) = frame.id
                && !id.is_valid()
            {
                return Err(crate::recipe::PartError::InvalidId { frame: 0, id }.into());
            }
            if frame.remote {
                if frame.fields.len > 0 {
                    return Err(ExchangeError::RemoteFields.into());
                }
                continue;
            }
            frame.layout(self.config, part)?;
        }
        Ok(())
    }
}

impl FrameSpec {
    /// The frame's elements and layout.
    ///
    /// # Errors
    /// [`LayoutError`]: its elements are counted without the checksum.
    pub(crate) fn layout(&self, config: ConfigView<'_>, part: Direction) -> Result<DeviceFrame, LayoutError> {
        let fields: &[FieldSpec] = self.fields.of(config.fields);
        let carrier = if self.id.is_some() { Carrier::Can } else { Carrier::Stream };
        DeviceFrame::new(carrier, part, (&self.head, &self.tail), fields)
    }
}

/// Whether two blocks of a slave have a register or coil in common.
fn overlap(one: &Exchange, other: &Exchange) -> bool {
    let (Talk::Served { operation: one, .. }, Talk::Served { operation: other, .. }) =
        (&one.talk, &other.talk)
    else {
        return false;
    };
    let ((table, from, count), (others, at, len)) = (one.place(), other.place());
    let end = |from: u16, count: u16| u32::from(from).saturating_add(u32::from(count));
    table == others && u32::from(from) < end(at, len) && u32::from(at) < end(from, count)
}

/// What is wrong, before its place is known.
enum Wrong {
    Exchange(ExchangeError),
    Layout(LayoutError),
    Part(crate::recipe::PartError),
    Other(super::ConfigError),
}

impl Wrong {
    fn at(self, place: Place) -> super::ConfigError {
        let kind = match self {
            Self::Exchange(error) => Kind::Exchange(error),
            Self::Layout(error) => Kind::Layout(error),
            Self::Part(error) => Kind::Part(error),
            Self::Other(error) => return super::ConfigError { place, kind: error.kind },
        };
        super::ConfigError { place, kind }
    }
}

impl From<ExchangeError> for Wrong {
    fn from(error: ExchangeError) -> Self {
        Self::Exchange(error)
    }
}

impl From<LayoutError> for Wrong {
    fn from(error: LayoutError) -> Self {
        Self::Layout(error)
    }
}

impl From<crate::recipe::PartError> for Wrong {
    fn from(error: crate::recipe::PartError) -> Self {
        Self::Part(error)
    }
}
