//! Line usage of exchanges, alone and together.
//!
//! In: a configuration. Out: times. Refuses nothing.

use super::budget::can_frame_time;
use super::exchange::{Exchange, FrameSpec, Transaction};
use super::{Bus, ConfigView, FieldSpec, Port, Recipe, SendOn};
use crate::modbus::rtu::{BROADCAST, Timing};
use crate::sysvar::Direction;
use crate::time::Duration;
use crate::wire::can::CanId;

/// Line usage of one exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ExchangeBudget {
    /// Length of the request in bytes, including the bytes around its fields; on CAN, of its data. 0 without a request.
    pub request: usize,
    /// Maximum length of the reply, counted in the same way.
    pub reply: usize,
    /// Time from the end of the previous exchange to the end of its pause, if the reply comes at once: silences, both
    /// frames and the pause.
    pub time: Duration,
    /// Like [`Self::time`], if no reply comes before the timeout; the same if no reply is expected.
    pub time_without_reply: Duration,
}

impl ConfigView<'_> {
    /// Line usage of an exchange on `port`. For a slave's block, that of a master that reads or writes all of it.
    pub fn exchange_budget(self, port: &Port, exchange: &Exchange) -> ExchangeBudget {
        let frame = |nth: Option<u8>| self.frames.get(usize::from(nth?));
        let bytes = |frame: Option<&FrameSpec>| frame.map_or(0, |frame| self.bytes_of(frame));
        let (request, reply, ids) = match exchange.transaction {
            Transaction::Rtu { operation, .. } if exchange.peer == BROADCAST => {
                (operation.request_len(), 0, [None; 2])
            }
            Transaction::Rtu { operation, .. } | Transaction::Served { operation, .. } => {
                (operation.request_len(), operation.reply_len(), [None; 2])
            }
            Transaction::Frames { request, reply, .. } => {
                let (request, reply) = (frame(request), frame(reply));
                let id = |frame: Option<&FrameSpec>| frame.and_then(|frame| frame.id);
                (bytes(request), bytes(reply), [id(request), id(reply)])
            }
        };
        // Modbus TCP has a header of 6 bytes instead of a CRC.
        let framing = if port.bus.is_modbus_tcp() { 4 } else { 0 };
        let (request, reply) = (request.saturating_add(framing), reply.saturating_add(framing));
        let [request_id, reply_id] = ids;
        let asks = request_on_line(port, exchange, request, request_id);
        let answers = on_line(port, exchange, reply, reply_id);
        let waits = if exchange.is_answered() { answers.max(exchange.timeout) } else { answers };
        ExchangeBudget {
            request,
            reply,
            time: asks + answers + exchange.pause,
            time_without_reply: asks + waits + exchange.pause,
        }
    }

    /// The time of the reply to an exchange on `port`, including the silence before it.
    pub(super) fn reply_time(self, port: &Port, exchange: &Exchange) -> Duration {
        let budget = self.exchange_budget(port, exchange);
        on_line(port, exchange, budget.reply, None)
    }

    /// The exchanges of a recipe, as bits, that wait while an answer to this one may arrive: those of its peer for
    /// whose replies it could be mistaken.
    pub fn held_back_by(self, recipe: &Recipe, exchange: &Exchange) -> u64 {
        self.exchanges_that(recipe, |other| self.may_confirm(exchange, other))
    }

    /// The exchanges, as bits, whose answers could be mistaken for the reply to this one.
    pub(crate) fn waits_for(self, recipe: &Recipe, exchange: &Exchange) -> u64 {
        self.exchanges_that(recipe, |other| self.may_confirm(other, exchange))
    }

    fn exchanges_that(self, recipe: &Recipe, is_one: impl Fn(&Exchange) -> bool) -> u64 {
        let all = (0_u32..).zip(self.exchanges_of(recipe)).filter(|(_, exchange)| is_one(exchange));
        all.fold(0, |set, (nth, _)| set | 1_u64.unbounded_shl(nth))
    }

    /// Whether an answer to `own` (reply, pending answer or refusal) could be mistaken for the reply to `other`.
    fn may_confirm(self, own: &Exchange, other: &Exchange) -> bool {
        let frame = |nth: Option<u8>| self.frames.get(usize::from(nth?));
        own.peer == other.peer
            && own.is_answered()
            && other.is_answered()
            && match (own.transaction, other.transaction) {
                (Transaction::Rtu { operation: own, .. }, Transaction::Rtu { operation: other, .. }) => {
                    own.is_answered_like(&other)
                }
                (Transaction::Frames { .. }, Transaction::Frames { reply: other, .. }) => {
                    let Some(other) = frame(other) else { return true };
                    let mut answers = own.frames(Direction::Input).filter_map(|nth| frame(Some(nth)));
                    answers.any(|own| core::ptr::eq(own, other) || !own.is_distinct_from(other, self))
                }
                _ => false,
            }
    }

    /// Line usage of `port` in percent, rounded up: of its periodic exchanges and of an output part that is sent each
    /// cycle. `None` without periodic exchanges.
    pub fn line_share(self, port: &Port) -> Option<u32> {
        let recipe = self.recipes.get(usize::from(port.recipe))?;
        let share = |time: Duration, every: Duration| {
            let parts = time.as_micros().saturating_mul(1_000_000);
            parts.div_ceil(every.as_micros().max(1))
        };
        let cyclic = |exchange: &Exchange| {
            Some(share(self.exchange_budget(port, exchange).time, exchange.when.every?))
        };
        let exchanges = self.exchanges_of(recipe).iter().filter_map(cyclic);
        let asked =
            exchanges.fold(None, |sum: Option<u64>, one| Some(sum.unwrap_or(0).saturating_add(one)))?;
        let sent = match (recipe.send, self.shortest_cycle(port)) {
            (SendOn::Period, time) => share(time, port.cycle),
            _ => 0,
        };
        Some(u32::try_from(asked.saturating_add(sent).div_ceil(10_000)).unwrap_or(u32::MAX))
    }

    /// The longest period of the exchanges of `port` whose replies have values.
    pub(super) fn slowest_reply(self, port: &Port) -> Option<Duration> {
        let recipe = self.recipes.get(usize::from(port.recipe))?;
        let with_reply = self
            .exchanges_of(recipe)
            .iter()
            .filter(|exchange| exchange.fields(self.frames, Direction::Input).is_some());
        with_reply.filter_map(|exchange| exchange.when.every).max()
    }

    fn bytes_of(self, frame: &FrameSpec) -> usize {
        let fields =
            frame.fields.of(self.fields).iter().map(FieldSpec::longest).fold(0, usize::saturating_add);
        fields.saturating_add(frame.head.len()).saturating_add(frame.tail.len())
    }
}

/// The silence before a frame of an exchange.
fn silence(port: &Port, exchange: &Exchange) -> Duration {
    match (&port.bus, exchange.transaction) {
        // A slave answers after the silence that ends the request.
        (Bus::Rs485(line), Transaction::Served { .. }) => line.turnaround.max(line.idle_gap),
        (Bus::Rs485(line), _) => line.turnaround,
        _ => Duration::ZERO,
    }
}

/// The time of a frame and the silence before it.
fn on_line(port: &Port, exchange: &Exchange, len: usize, id: Option<CanId>) -> Duration {
    match (&port.bus, id) {
        (Bus::Rs485(line), _) if len > 0 => silence(port, exchange) + line.time_on_line(len),
        (Bus::Can { bitrate }, Some(id)) => can_frame_time(id, len, *bitrate),
        _ => Duration::ZERO,
    }
}

/// The time of a request, including the turnaround after a broadcast.
fn request_on_line(port: &Port, exchange: &Exchange, len: usize, id: Option<CanId>) -> Duration {
    let is_broadcast = matches!(exchange.transaction, Transaction::Rtu { .. }) && exchange.peer == BROADCAST;
    let rest = if is_broadcast { Timing::TURNAROUND } else { Duration::ZERO };
    on_line(port, exchange, len, id) + rest
}
