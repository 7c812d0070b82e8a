//! Checks of the exchanges of one recipe.

use super::check_limits::check_number_read;
use super::device::register_bits;
use super::error::{ConfigErrorKind as Kind, ExchangeError, ExchangeKey as Key, Place};
use super::exchange::{Exchange, FrameSpec, Transaction};
use super::rules::{Check, LONGEST_TRIGGER, MAX_TIME, check_pool, check_time, check_trigger, fail};
use super::{
    ConfigView, Constants, DeviceFrame, FieldSpec, InputBinding, Parts, Port, PortHealth, Recipe, Span,
    StreamPart, has_values,
};
use crate::device::{Carrier, LayoutError};
use crate::modbus::rtu::{BROADCAST, MAX_ADDRESS, MAX_SLAVES, Operation};
use crate::recipe::PartError;
use crate::recipe::model::{MAX_CAN_IDS, Mode};
use crate::sysvar::Direction;
use crate::time::Duration;

/// Maximum pause after an exchange.
pub const MAX_PAUSE: Duration = Duration::from_secs(10);
pub(super) struct ExchangeCheck<'a> {
    pub config: ConfigView<'a>,
    pub index: u8,
    pub recipe: &'a Recipe,
}

impl<'a> ExchangeCheck<'a> {
    pub(super) fn check(&self) -> Check {
        check_pool(self.at(0, Key::Whole), self.recipe.exchanges, self.config.exchanges.len())?;
        let exchanges = self.config.exchanges_of(self.recipe);
        if exchanges.is_empty() {
            return Ok(());
        }
        let mut parts = [Direction::Input, Direction::Output].into_iter();
        let mut part = |part| self.recipe.stream_part(part).is_some_and(StreamPart::is_cut);
        if parts.any(&mut part) {
            return self.refuse(0, Key::Whole, ExchangeError::CutParts);
        }
        let (mut peers, mut count) = ([false; 256], 0_usize);
        for (nth, exchange) in (0..).zip(exchanges) {
            self.check_one(nth, exchange)?;
            if let Some(seen) = peers.get_mut(usize::from(exchange.peer))
                && !core::mem::replace(seen, true)
                && !matches!(exchange.transaction, Transaction::Rtu { .. } if exchange.peer == BROADCAST)
            {
                count = count.saturating_add(1);
            }
            if count > MAX_SLAVES {
                return self.refuse(nth, Key::Peer, ExchangeError::TooManyPeers);
            }
            self.check_ids(nth, exchange)?;
            let earlier = exchanges.iter().take(usize::from(nth));
            for before in earlier {
                if core::mem::discriminant(&before.transaction)
                    != core::mem::discriminant(&exchange.transaction)
                {
                    return self.refuse(nth, Key::Whole, ExchangeError::Mixed);
                }
                if overlap(before, exchange) {
                    return self.refuse(nth, Key::Registers, ExchangeError::Overlap);
                }
            }
            check_time(self.at(nth, Key::Timeout), exchange.timeout, MAX_TIME)?;
            if let Some(every) = exchange.when.every {
                check_time(self.at(nth, Key::Every), every, MAX_TIME)?;
            }
            if exchange.pause > MAX_PAUSE {
                let kind = Kind::TimeTooLong { time: exchange.pause, longest: MAX_PAUSE };
                return fail(self.at(nth, Key::Pause), kind);
            }
            if let Some((var, bit)) = exchange.when.rising {
                check_trigger(self.at(nth, Key::Rising), var, bit)?;
            }
            self.check_event(nth, exchange)?;
            self.check_restarted(nth, exchange)?;
        }
        if self.config.can_ids(self.recipe, Direction::Input).nth(MAX_CAN_IDS).is_some() {
            let last = self.recipe.exchanges.len.saturating_sub(1) as u8;
            return self.refuse(last, Key::Whole, ExchangeError::TooManyIds);
        }
        Ok(())
    }

    /// Checks events: their times, their order, and the variables for their outcome.
    fn check_event(&self, nth: u8, exchange: &Exchange) -> Check {
        if let Some(time) = exchange.trigger {
            if !exchange.is_event() {
                return self.refuse(nth, Key::Trigger, ExchangeError::NoEvent);
            }
            if time == Duration::ZERO || time > LONGEST_TRIGGER {
                return self.refuse(nth, Key::Trigger, ExchangeError::Trigger { time });
            }
        }
        if let Some(late) = exchange.late.filter(|late| *late > MAX_TIME) {
            return fail(self.at(nth, Key::Late), Kind::TimeTooLong { time: late, longest: MAX_TIME });
        }
        if let Some(overdue) = exchange.overdue.filter(|overdue| *overdue != Port::NEVER) {
            check_time(self.at(nth, Key::Overdue), overdue, MAX_TIME)?;
        }
        if exchange.stop && !exchange.is_answered() {
            return self.refuse(nth, Key::Stop, ExchangeError::StopNeedsReply);
        }
        if exchange.outcome.variables().next().is_some() && !exchange.is_event() {
            return self.refuse(nth, Key::Outcome, ExchangeError::NoEvent);
        }
        if let Some(var) = exchange.outcome.variables().find(|var| !PortHealth::can_write(*var)) {
            return self.refuse(nth, Key::Outcome, ExchangeError::NotForOutcome { var });
        }
        let Some(follow) = exchange.follow else { return Ok(()) };
        let exchanges = self.config.exchanges_of(self.recipe);
        let refuse = |error| self.refuse(nth, Key::Follow, error);
        if exchange.when.rising.is_some() || exchange.stop {
            return refuse(ExchangeError::FollowsAndRises);
        }
        let mut before = follow;
        for _ in 0..=exchanges.len() {
            match exchanges.get(usize::from(before)) {
                _ if follow == nth => return refuse(ExchangeError::FollowsNothing { follow }),
                _ if before == nth => return refuse(ExchangeError::FollowsCircle),
                None => return refuse(ExchangeError::FollowsNothing { follow }),
                Some(leader) if !leader.is_answered() => return refuse(ExchangeError::FollowsUnanswered),
                Some(Exchange { follow: Some(next), .. }) => before = *next,
                Some(_) => return Ok(()),
            }
        }
        refuse(ExchangeError::FollowsCircle)
    }

    /// Checks that the frames an exchange accepts can be told from all others that may arrive at that time: those of
    /// the same exchange, and unsolicited ones.
    fn check_ids(&self, nth: u8, exchange: &Exchange) -> Check {
        let Transaction::Frames { request, reply, refusal } = exchange.transaction else { return Ok(()) };
        let spec = |index: u8| self.config.frames.get(usize::from(index));
        let answers = [(Key::Reply, reply), (Key::Pending, exchange.pending), (Key::Refusal, refusal)];
        for (place, (key, own)) in answers.into_iter().enumerate() {
            let Some(own) = own.and_then(spec) else { continue };
            let mut others = answers.into_iter().enumerate().filter(|(other, _)| *other != place);
            let hides = |(other, (_, index)): (usize, (Key, Option<u8>))| {
                index.and_then(spec).is_some_and(|index| index.hides(own, other < place, self.config))
            };
            if others.any(hides) {
                return self.refuse(nth, key, ExchangeError::Hidden);
            }
            if key == Key::Pending
                && request.and_then(spec).is_some_and(|request| own.may_echo(request, self.config))
            {
                return self.refuse(nth, key, ExchangeError::PendingEcho);
            }
        }
        let frame = |index: u8| {
            let frame = spec(index)?;
            Some((frame.id?, frame.fields))
        };
        let part = match &self.recipe.parts {
            Parts::Can { input, .. } => &input[..],
            Parts::Stream { .. } => &[],
        };
        let is_unasked = request.is_none();
        for (key, own) in answers {
            let Some((id, fields)) = own.and_then(frame) else { continue };
            let earlier = self.config.exchanges_of(self.recipe).iter().take(usize::from(nth));
            let earlier = earlier.filter(|earlier| {
                is_unasked || matches!(earlier.transaction, Transaction::Frames { request: None, .. })
            });
            let earlier = earlier.flat_map(|earlier| earlier.frames(Direction::Input));
            let others = part.iter().map(|frame| (frame.id, frame.fields)).chain(earlier.filter_map(frame));
            let constants = |fields: Span| Constants::of(fields.of(self.config.fields), Direction::Input);
            let mut same_id = others.filter(|(other, _)| *other == id).map(|(_, fields)| fields);
            if same_id.any(|other| !constants(other).differ(&constants(fields))) {
                return self.refuse(nth, key, ExchangeError::Indistinguishable { id });
            }
        }
        Ok(())
    }

    fn at(&self, exchange: u8, key: Key) -> Place {
        Place::Exchange { recipe: self.index, exchange, key }
    }

    fn refuse(&self, exchange: u8, key: Key, error: ExchangeError) -> Check {
        fail(self.at(exchange, key), Kind::Exchange(error))
    }

    fn check_one(&self, nth: u8, exchange: &Exchange) -> Check {
        if self.recipe.mode != Mode::User {
            return self.refuse(nth, Key::Whole, ExchangeError::NeedsUser);
        }
        let is_alone = matches!(self.recipe.parts, Parts::Stream { input: None, output: None });
        let (peer, is_never) = (exchange.peer, exchange.is_never());
        match exchange.transaction {
            Transaction::Rtu { .. } | Transaction::Served { .. } if !is_alone => {
                self.refuse(nth, Key::Whole, ExchangeError::PartsBesideModbus)
            }
            Transaction::Rtu { operation, written, read } => {
                if peer > MAX_ADDRESS && !self.is_only_over_tcp() {
                    return self.refuse(nth, Key::Peer, ExchangeError::Slave { address: peer });
                }
                if peer == BROADCAST && operation.reads() {
                    return self.refuse(nth, Key::Peer, ExchangeError::BroadcastRead);
                }
                if is_never {
                    return self.refuse(nth, Key::Whole, ExchangeError::Never);
                }
                self.check_operation(nth, operation, [(Direction::Output, written), (Direction::Input, read)])
            }
            Transaction::Served { operation, written, read } => {
                if peer == BROADCAST || peer > MAX_ADDRESS {
                    return self.refuse(nth, Key::Peer, ExchangeError::OwnAddress { address: peer });
                }
                let first = self.config.exchanges_of(self.recipe).first();
                if first.is_some_and(|first| first.peer != peer) {
                    return self.refuse(nth, Key::Peer, ExchangeError::OtherAddress);
                }
                if !is_never {
                    return self.refuse(nth, Key::Whole, ExchangeError::Unasked);
                }
                match operation {
                    Operation::ReadWriteRegisters { .. }
                    | Operation::WriteCoil { .. }
                    | Operation::WriteRegister { .. }
                    | Operation::MaskWriteRegister { .. } => {
                        self.refuse(nth, Key::Registers, ExchangeError::NotServed)
                    }
                    _ => {
                        let spans = [(Direction::Input, written), (Direction::Output, read)];
                        self.check_operation(nth, operation, spans)
                    }
                }
            }
            Transaction::Frames { request, reply, refusal } => {
                self.check_frames(nth, is_never, [request, reply, exchange.pending, refusal])
            }
        }
    }

    /// Whether all ports with this recipe are Modbus TCP, where unit ids use the whole byte.
    fn is_only_over_tcp(&self) -> bool {
        let mut own = self.config.ports.iter().filter(|port| port.recipe == self.index).peekable();
        own.peek().is_some() && own.all(|port| port.bus.is_modbus_tcp())
    }

    /// Checks the counts, and that the written and read fields fill them.
    fn check_operation(&self, nth: u8, operation: Operation, spans: [(Direction, Span); 2]) -> Check {
        let refuse = |error| self.refuse(nth, Key::Registers, error);
        if let Err(error) = operation.check() {
            return refuse(ExchangeError::Count(error));
        }
        if let Some((address, count)) = beyond_last(&operation) {
            return refuse(ExchangeError::BeyondLast { address, count });
        }
        let needed = [operation.written_len(), operation.read_len()];
        for ((part, span), needed) in spans.into_iter().zip(needed) {
            check_pool(self.at(nth, Key::Registers), span, self.config.fields.len())?;
            let fields = span.of(self.config.fields);
            if fields.is_empty() && needed == 0 {
                continue;
            }
            let layout = match DeviceFrame::new(Carrier::Whole, part, (&[], &[]), fields) {
                Ok(frame) => frame.layout,
                Err(error) => {
                    let place = self.place_of(nth, part, fields, error);
                    return fail(place, Kind::Layout(error));
                }
            };
            let (shortest, longest) = layout.lengths();
            if shortest != longest {
                return refuse(ExchangeError::Varying);
            }
            if longest != needed {
                return refuse(ExchangeError::Fields { needed, found: longest });
            }
            if let Operation::MaskWriteRegister { mask, .. } = operation
                && (mask != register_bits(fields) || matches!(mask, 0 | 0xFFFF))
            {
                return refuse(ExchangeError::Mask);
            }
        }
        Ok(())
    }

    fn check_frames(&self, nth: u8, is_never: bool, frames: [Option<u8>; 4]) -> Check {
        let refused = match frames {
            [None, None, ..] => Some((Key::Whole, ExchangeError::Nothing)),
            [None, _, Some(_), _] | [_, None, Some(_), _] => Some((Key::Pending, ExchangeError::LoneRefusal)),
            [None, _, _, Some(_)] | [_, None, _, Some(_)] => Some((Key::Refusal, ExchangeError::LoneRefusal)),
            [Some(_), ..] if is_never => Some((Key::Whole, ExchangeError::Never)),
            [None, ..] if !is_never => Some((Key::Whole, ExchangeError::Unasked)),
            _ => None,
        };
        if let Some((key, error)) = refused {
            return self.refuse(nth, key, error);
        }
        let [request, reply, pending, refusal] = frames;
        for (key, part, index) in [
            (Key::Request, Direction::Output, request),
            (Key::Reply, Direction::Input, reply),
            (Key::Pending, Direction::Input, pending),
            (Key::Refusal, Direction::Input, refusal),
        ] {
            let Some(index) = index else { continue };
            check_pool(self.at(nth, key), Span { start: index.into(), len: 1 }, self.config.frames.len())?;
            let Some(frame) = self.config.frames.get(usize::from(index)) else { continue };
            self.check_frame(nth, key, part, frame)?;
        }
        Ok(())
    }

    fn check_frame(&self, nth: u8, key: Key, part: Direction, frame: &FrameSpec) -> Check {
        let place = self.at(nth, key);
        check_pool(place, frame.fields, self.config.fields.len())?;
        let is_can = matches!(self.recipe.parts, Parts::Can { .. });
        if frame.id.is_some() != is_can || (frame.remote && !is_can) {
            return self.refuse(nth, key, ExchangeError::WrongBus);
        }
        if let Some(id) = frame.id.filter(|id| !id.is_valid()) {
            return fail(place, Kind::Part(PartError::InvalidId { frame: 0, id }));
        }
        let fields = frame.fields.of(self.config.fields);
        if frame.remote {
            return match (key, fields) {
                (Key::Request, []) => Ok(()),
                (Key::Request, _) => self.refuse(nth, key, ExchangeError::RemoteFields),
                _ => self.refuse(nth, key, ExchangeError::RemoteReply),
            };
        }
        let is_other = matches!(key, Key::Pending | Key::Refusal);
        if is_other && fields.iter().any(is_command_or_counter) {
            return self.refuse(nth, key, ExchangeError::RefusalValues);
        }
        match frame.layout(self.config, part) {
            Ok(_) => Ok(()),
            Err(error) if is_other && !has_values(fields) => fail(place, Kind::Layout(error)),
            Err(error) => fail(self.place_of(nth, part, fields, error), Kind::Layout(error)),
        }
    }

    /// Checks the field that shows a restart.
    fn check_restarted(&self, nth: u8, exchange: &Exchange) -> Check {
        let Some(restarted) = exchange.restarted else { return Ok(()) };
        let refuse = |error| self.refuse(nth, Key::Restarted, error);
        let exchanges = self.config.exchanges_of(self.recipe);
        let has_start = exchanges
            .iter()
            .any(|other| other.peer == exchange.peer && other.when.start && !other.is_served());
        let fields = match exchange.fields(self.config.frames, Direction::Input) {
            Some(span) if has_start => span.of(self.config.fields),
            _ => return refuse(ExchangeError::RestartedNothing),
        };
        match restarted.place(fields) {
            Some((_, encoding)) => {
                check_number_read(self.at(nth, Key::Restarted), &encoding, restarted.value)
            }
            None => refuse(ExchangeError::RestartedField { field: restarted.field }),
        }
    }

    /// The place of an error in a frame of an exchange that is counted in this part.
    fn place_of(&self, nth: u8, part: Direction, fields: &[FieldSpec], error: LayoutError) -> Place {
        let recipe = self.index;
        let exchange = self.config.exchanges_of(self.recipe).get(usize::from(nth));
        let mut walk = self.config.frames_of(self.recipe, part);
        // Whether a frame belongs to this exchange and has these fields.
        let is_it = |of: Option<(&Exchange, bool)>, span: Span| {
            let own = exchange.zip(of).is_some_and(|(own, (other, _))| core::ptr::eq(own, other));
            own && core::ptr::eq(span.of(self.config.fields), fields)
        };
        let mut frame = 0;
        while let Some((count, span)) = walk.next() {
            frame = count;
            if is_it(walk.exchange(), span) {
                break;
            }
        }
        match super::device::field_of(fields, error) {
            Some(field) => Place::Field { recipe, part, frame, field },
            None => Place::Frame { recipe, part, frame },
        }
    }
}

impl FrameSpec {
    /// The frame's elements and layout.
    ///
    /// # Errors
    /// [`LayoutError`]; its element indices do not count the checksum.
    pub(crate) fn layout(&self, config: ConfigView<'_>, part: Direction) -> Result<DeviceFrame, LayoutError> {
        let fields: &[FieldSpec] = self.fields.of(config.fields);
        let carrier = if self.id.is_some() { Carrier::Can } else { Carrier::Stream };
        DeviceFrame::new(carrier, part, (&self.head, &self.tail), fields)
    }
}

/// Whether a field selects a command or is an alive counter.
fn is_command_or_counter(field: &FieldSpec) -> bool {
    match field {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => {
            matches!(to, InputBinding::Commands { .. } | InputBinding::Counter { .. })
        }
        _ => false,
    }
}

/// Whether two blocks of a slave overlap.
fn overlap(one: &Exchange, other: &Exchange) -> bool {
    let (Transaction::Served { operation: one, .. }, Transaction::Served { operation: other, .. }) =
        (&one.transaction, &other.transaction)
    else {
        return false;
    };
    let ((table, from, count), (others, at, len)) = (one.place(), other.place());
    let end = |from: u16, count: u16| u32::from(from).saturating_add(u32::from(count));
    table == others && u32::from(from) < end(at, len) && u32::from(at) < end(from, count)
}

/// Address and count, if they exceed the last register or coil, 65535.
fn beyond_last(operation: &Operation) -> Option<(u16, u16)> {
    let (_, address, count) = operation.place();
    let written = match *operation {
        Operation::ReadWriteRegisters { write_address, write_count, .. } => (write_address, write_count),
        _ => (0, 1),
    };
    let is_beyond =
        |&(address, count): &(u16, u16)| u32::from(address).saturating_add(u32::from(count)) > 0x1_0000;
    [(address, count), written].into_iter().find(is_beyond)
}
