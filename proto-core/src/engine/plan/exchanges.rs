//! The exchanges of a port, from the configuration.

use heapless::VecView;

use crate::config::{
    Bus, ConfigView, Counted, DeviceFrame, Echo, Exchange, FieldSpec, FrameSpec, OutcomeTo, Port, Recipe,
    Span, Transaction, has_values,
};
use crate::device::{Carrier, LayoutError};
use crate::engine::build_error::{BuildError, one_too_many};
use crate::engine::dispatch::EngineView;
use crate::engine::field::bindings::{InputBind, InputTo};
use crate::engine::field::event::{Event, ReportedOutcome, Trigger};
use crate::engine::field::exchanges::{Asks, ExchangeItem, InputFormat, OtherFormat, Piece, RestartSign};
use crate::engine::field::format::DeviceFormat;
use crate::engine::field::line::Line;
use crate::engine::field::modbus_tcp::Transactions;
use crate::engine::field::turns::{PeerState, Row, RowKind, Times};
use crate::modbus::rtu::{BROADCAST, Timing};
use crate::schedule::Grid;
use crate::sysvar::Direction;
use crate::time::{Duration, Instant};
use crate::wire::can::{CanId, CanKey};

/// Where the next fields go among the bindings of their direction, and the next input frame in the store.
pub(crate) struct Places {
    pub inputs: u16,
    pub outputs: u16,
    pub slot: u8,
}

/// Makes the formats of one recipe's exchanges.
struct Formats<'c> {
    config: ConfigView<'c>,
    recipe: u8,
    places: Places,
    /// Number of frames of each direction so far, for messages.
    frames: [u8; 2],
    /// The input bindings of all ports; those of refusals are appended.
    refusals: &'c mut VecView<InputBind>,
}

/// The source of a frame's fields.
#[derive(Clone, Copy)]
enum FrameOf<'c> {
    /// The data of Modbus registers or coils.
    Data(&'c [FieldSpec]),
    Spec(&'c FrameSpec),
}

impl FrameOf<'_> {
    fn layout(self, config: ConfigView<'_>, part: Direction) -> Result<DeviceFrame, LayoutError> {
        match self {
            Self::Data(fields) => DeviceFrame::new(Carrier::Whole, part, (&[], &[]), fields),
            Self::Spec(spec) => spec.layout(config, part),
        }
    }

    fn id(self) -> CanId {
        match self {
            Self::Spec(FrameSpec { id: Some(id), .. }) => *id,
            _ => CanId::Standard(0),
        }
    }
}

impl Formats<'_> {
    fn format(&mut self, part: Direction, of: FrameOf<'_>) -> Result<DeviceFormat, BuildError> {
        let (next, nth) = match (part, &mut self.frames) {
            (Direction::Input, [nth, _]) => (&mut self.places.inputs, nth),
            (Direction::Output, [_, nth]) => (&mut self.places.outputs, nth),
        };
        let frame = of.layout(self.config, part);
        let frame =
            frame.map_err(|error| BuildError::Layout { recipe: self.recipe, part, frame: *nth, error })?;
        let bindings = Span { start: *next, len: frame.elements.len() as u16 };
        *next = next.saturating_add(bindings.len);
        *nth = nth.saturating_add(1);
        Ok(DeviceFormat { layout: frame.layout, key: CanKey::of(of.id()), bindings })
    }

    fn input(&mut self, of: FrameOf<'_>) -> Result<InputFormat, BuildError> {
        let format = self.format(Direction::Input, of)?;
        let slot = self.places.slot;
        self.places.slot = slot.saturating_add(1);
        Ok(InputFormat { format, slot })
    }

    /// A pending answer or a refusal.
    fn other(&mut self, spec: &FrameSpec) -> Result<OtherFormat, BuildError> {
        if has_values(spec.fields.of(self.config.fields)) {
            let InputFormat { format, slot } = self.input(FrameOf::Spec(spec))?;
            return Ok(OtherFormat { format, slot: Some(slot) });
        }
        Ok(OtherFormat { format: self.without_values(spec)?, slot: None })
    }

    /// The format of such a frame without values; its bindings come after those of the recipe.
    fn without_values(&mut self, spec: &FrameSpec) -> Result<DeviceFormat, BuildError> {
        let (recipe, part, [frames, _]) = (self.recipe, Direction::Input, self.frames);
        let frame = spec.layout(self.config, part);
        let frame = frame.map_err(|error| BuildError::Layout { recipe, part, frame: frames, error })?;
        let len = frame.elements.len() as u16;
        let bindings = Span { start: self.refusals.len() as u16, len };
        for &element in &frame.elements {
            let bind = InputBind::new(InputTo::Unused, element);
            self.refusals
                .push(bind)
                .map_err(|_| one_too_many(Counted::UserFields, self.refusals.capacity()))?;
        }
        Ok(DeviceFormat { layout: frame.layout, key: CanKey::of(FrameOf::Spec(spec).id()), bindings })
    }

    /// The data of Modbus registers or coils that are sent.
    fn data_out(&mut self, span: Span) -> Result<Option<DeviceFormat>, BuildError> {
        let fields: &[FieldSpec] = span.of(self.config.fields);
        if fields.is_empty() {
            return Ok(None);
        }
        self.format(Direction::Output, FrameOf::Data(fields)).map(Some)
    }

    /// The data of Modbus registers or coils that are received.
    fn data_in(&mut self, span: Span) -> Result<Option<InputFormat>, BuildError> {
        let fields: &[FieldSpec] = span.of(self.config.fields);
        if fields.is_empty() {
            return Ok(None);
        }
        self.input(FrameOf::Data(fields)).map(Some)
    }

    /// Length in bytes of the reply to a remote request.
    fn longest_of(&self, spec: &FrameSpec) -> usize {
        spec.layout(self.config, Direction::Input).map_or(0, |frame| frame.layout.lengths().1)
    }

    fn item(&mut self, exchange: &Exchange) -> Result<ExchangeItem, BuildError> {
        let mut item = ExchangeItem {
            asks: Asks::Nothing,
            request: None,
            reply: None,
            pending: None,
            refusal: None,
            restart: None,
            on_change: exchange.when.change,
            trigger: exchange.when.rising.map(Trigger::new),
            stops: exchange.stop,
            follow: exchange.follow,
            window: Duration::ZERO,
            event: Event::Over,
            reported: ReportedOutcome::default(),
            outcome: exchange.outcome,
            is_news: exchange.outcome != OutcomeTo::NONE,
            digest: None,
            is_owed: false,
            pieces: Span::default(),
            is_written: false,
        };
        match exchange.transaction {
            Transaction::Rtu { operation, written, read } => {
                item.asks = Asks::Rtu { slave: exchange.peer, operation };
                item.request = self.data_out(written)?;
                item.reply = self.data_in(read)?;
            }
            Transaction::Served { operation, written, read } => {
                let (table, address, count) = operation.place();
                item.asks = Asks::Served { table, address, count };
                item.request = self.data_out(read)?;
                item.reply = self.data_in(written)?;
            }
            Transaction::Frames { request, reply, refusal } => {
                let config = self.config;
                let frame = |nth: Option<u8>| config.frames.get(usize::from(nth?));
                if let Some(request) = frame(request) {
                    item.asks = match request.id {
                        Some(id) if request.remote => {
                            let len = frame(reply).map_or(0, |reply| self.longest_of(reply));
                            Asks::Remote { id, len: len as u8 }
                        }
                        _ => Asks::Frame,
                    };
                    if matches!(item.asks, Asks::Frame) {
                        item.request = Some(self.format(Direction::Output, FrameOf::Spec(request))?);
                    }
                }
                if let Some(reply) = frame(reply) {
                    item.reply = Some(self.input(FrameOf::Spec(reply))?);
                }
                for (from, to) in [(exchange.pending, &mut item.pending), (refusal, &mut item.refusal)] {
                    if let Some(spec) = frame(from) {
                        *to = Some(self.other(spec)?);
                    }
                }
            }
        }
        let fields = exchange.fields(self.config.frames, Direction::Input).unwrap_or_default();
        item.restart = exchange.restarted.and_then(|of| RestartSign::new(of, fields.of(self.config.fields)));
        Ok(item)
    }
}

impl EngineView<'_> {
    /// Adds the exchanges of a port. Their fields and input frames come after those of its parts, at these places.
    #[inline(never)]
    pub(crate) fn add_exchanges(
        &mut self,
        config: ConfigView<'_>,
        port: &Port,
        recipe: &Recipe,
        places: Places,
    ) -> Result<Line, BuildError> {
        let room = self.exchanges.written.len();
        let full = || one_too_many(Counted::Exchanges, room);
        let exchanges = config.exchanges_of(recipe);
        let start = self.exchanges.items.len() as u16;
        let first_peer = self.exchanges.peers.len();
        let part_frames = |part| recipe.part_frames(part).count() as u8;
        let frames = [part_frames(Direction::Input), part_frames(Direction::Output)];
        let refusals = &mut *self.bindings.inputs;
        let mut formats = Formats { config, recipe: port.recipe, places, frames, refusals };
        // A start exchange may have to wait for its values.
        let may_wait = |exchange: &Exchange| {
            exchange.when.start && exchange.fields(config.frames, Direction::Output).is_some()
        };
        let looks = exchanges.iter().any(|exchange| exchange.when.change || may_wait(exchange));
        let looks = looks.then(|| Grid::starting_at(Instant::ZERO, port.cycle));
        let line_of = match &port.bus {
            Bus::Rs485(line) => Some(line),
            _ => None,
        };
        let is_tcp = port.bus.is_modbus_tcp();
        let mut hears_unasked = part_frames(Direction::Input) > 0;
        self.store.watches_bits |= exchanges.iter().any(|exchange| exchange.when.rising.is_some());
        for (nth, exchange) in exchanges.iter().enumerate() {
            let mut item = formats.item(exchange)?;
            item.window = exchange.trigger(port.timeout);
            item.follow = item.follow.or_else(|| step_before(exchanges, nth));
            let request_len = match (item.asks, &item.request) {
                (Asks::Rtu { operation, .. }, _) => operation.request_len(),
                (Asks::Remote { .. }, _) | (_, None) => 0,
                (_, Some(request)) => request.layout.lengths().1,
            };
            let kept = match (item.asks, &item.reply) {
                (Asks::Served { .. }, Some(block)) => block.format.layout.lengths().1,
                (Asks::Served { .. }, None) => 0,
                // Escape bytes could double a frame; recipes with exchanges have none.
                _ if exchange.is_event() => request_len,
                _ => 0,
            };
            if kept > 0 {
                let ends =
                    self.exchanges.items.iter().map(|item| item.pieces.start.saturating_add(item.pieces.len));
                let used = ends.max().unwrap_or(0);
                let len = kept.div_ceil(size_of::<Piece>());
                if usize::from(used).saturating_add(len) > room {
                    return Err(one_too_many(Counted::WrittenPieces, room));
                }
                item.pieces = Span { start: used, len: len as u16 };
            }
            hears_unasked |= matches!(item.asks, Asks::Nothing);
            let own = self.exchanges.peers.get(first_peer..).unwrap_or(&[]);
            let peer = match own.iter().position(|peer| peer.number == exchange.peer) {
                Some(peer) => peer,
                None => {
                    let peer = own.len();
                    let new = PeerState::new(exchange.peer, port.absent);
                    self.exchanges.peers.push(new).map_err(|_| full())?;
                    peer
                }
            };
            let on_line = line_of.map_or(Duration::ZERO, |line| line.time_on_line(request_len));
            let mut row = row_of(exchange, item.asks, peer as u8, on_line);
            // Over TCP, the transaction id distinguishes all replies.
            row.alike = if is_tcp { 0 } else { config.waits_for(recipe, exchange) };
            self.exchanges.rows.push(row).map_err(|_| full())?;
            self.exchanges.items.push(item).map_err(|_| full())?;
        }
        let peers = self.exchanges.peers.len().saturating_sub(first_peer) as u16;
        let mut line = Line::new(
            Span { start, len: exchanges.len() as u16 },
            Span { start: first_peer as u16, len: peers },
            looks,
            line_of.map_or(Echo::No, |line| line.echo),
        );
        line.hears_unasked = hears_unasked;
        line.transactions = is_tcp.then(Transactions::new);
        Ok(line)
    }
}

/// The row of an exchange whose request takes this time on the line.
fn row_of(exchange: &Exchange, asks: Asks, peer: u8, on_line: Duration) -> Row {
    let when = &exchange.when;
    let kind = RowKind {
        is_answered: exchange.is_answered(),
        starts: when.start,
        is_state: !exchange.is_start_event()
            && (!exchange.is_event() || when.every.is_some() || when.change || when.start),
        stops: exchange.stop,
        retries: [exchange.retries, exchange.event_retries],
    };
    let times = Times {
        cost: on_line + exchange.timeout + exchange.pause,
        timeout: exchange.timeout,
        late: exchange.late(),
        pause: match asks {
            // A broadcast has no reply, so the slaves get time to execute it.
            Asks::Rtu { slave: BROADCAST, .. } => exchange.pause + Timing::TURNAROUND,
            _ => exchange.pause,
        },
    };
    Row::new(peer, kind, when.every, times)
}

/// The previous exchange of the same peer that the same bit triggers: together they are steps of one event.
fn step_before(exchanges: &[Exchange], nth: usize) -> Option<u8> {
    let own = exchanges.get(nth).filter(|own| own.when.rising.is_some() && !own.stop)?;
    let is_step =
        |other: &Exchange| other.peer == own.peer && other.when.rising == own.when.rising && !other.stop;
    let before = exchanges.iter().take(nth).rposition(is_step)?;
    Some(before as u8)
}
