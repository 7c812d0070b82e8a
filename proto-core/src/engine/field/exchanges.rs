//! The exchanges of all ports: their frames, their turns and the state of their peers.
//!
//! In: the exchanges of a configuration. Out: for each port with exchanges a [`Line`], and the frames it sends and
//! receives. One list for all ports, so that a port without exchanges takes no memory.

use core::num::NonZero;

use heapless::VecView;

use super::event::{Event, ReportedOutcome, Trigger};
use super::format::DeviceFormat;
use super::line::{ExchangeTable, Line};
use super::turns::{PeerState, Row};
use crate::config::{FieldSpec, OutcomeTo, Restarted, Span};
use crate::modbus::rtu::{Operation, Table};
use crate::time::Duration;
use crate::wire::can::CanId;

/// The exchanges of all ports; ports refer to ranges of them.
pub(crate) struct Exchanges<'e> {
    pub items: &'e mut VecView<ExchangeItem>,
    pub rows: &'e mut VecView<Row>,
    pub peers: &'e mut VecView<PeerState>,
    /// Blocks that masters have written, and requests of events.
    pub written: &'e mut [Piece],
}

/// Part of a block that a master writes, or of the request of an event; each takes as many as it needs.
pub(crate) type Piece = [u8; 32];

/// [`Exchanges`] as slices.
pub(crate) struct View<'a> {
    items: &'a mut [ExchangeItem],
    rows: &'a mut [Row],
    peers: &'a mut [PeerState],
    written: &'a mut [Piece],
}

/// One exchange: its request and its possible replies.
#[derive(Debug, Clone)]
pub(crate) struct ExchangeItem {
    pub asks: Asks,
    pub request: Option<DeviceFormat>,
    pub reply: Option<InputFormat>,
    pub pending: Option<OtherFormat>,
    pub refusal: Option<OtherFormat>,
    /// The value in the reply that shows a restart of the peer.
    pub restart: Option<RestartSign>,
    /// Sent when a value of the request changes.
    pub on_change: bool,
    /// The bit whose rise sends it.
    pub trigger: Option<Trigger>,
    pub stops: bool,
    /// The exchange of the port that it follows once that is done.
    pub follow: Option<u8>,
    /// How long after an event its request may still be sent.
    pub window: Duration,
    pub event: Event,
    /// What is reported to the robot about its events, in which variables, and whether that has changed.
    pub reported: ReportedOutcome,
    pub outcome: OutcomeTo,
    pub is_news: bool,
    /// Digest of the newest request, to detect a change.
    pub digest: Option<NonZero<u64>>,
    /// It was due, but a value of it was unknown or stale.
    pub is_owed: bool,
    /// Where a block that a master writes is kept for reading back, or the request of an event.
    pub pieces: Span,
    /// A master has written it.
    pub is_written: bool,
}

/// How a request is made.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Asks {
    /// As a Modbus master; request and reply are the data in their frames.
    Rtu { slave: u8, operation: Operation },
    /// With a device frame.
    Frame,
    /// With a remote frame on a CAN bus, which has the length of the reply.
    Remote { id: CanId, len: u8 },
    /// Not at all: a master accesses these registers or coils of the gateway.
    Served { table: Table, address: u16, count: u16 },
    /// Not at all: the reply is unsolicited.
    Nothing,
}

/// An input frame and its place in the store.
#[derive(Debug, Clone)]
pub(crate) struct InputFormat {
    pub format: DeviceFormat,
    pub slot: u8,
}

/// A pending answer or a refusal, and its place in the store if it has values.
#[derive(Debug, Clone)]
pub(crate) struct OtherFormat {
    pub format: DeviceFormat,
    pub slot: Option<u8>,
}

/// The value in a reply that shows that the peer has restarted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RestartSign {
    /// The place of the value among the elements of the reply.
    pub element: u8,
    pub value: f64,
    /// Whether the previous reply had it; `None` if there was none since the peer started.
    pub was_there: Option<bool>,
}

impl RestartSign {
    pub(crate) fn new(of: Restarted, fields: &[FieldSpec]) -> Option<Self> {
        let (element, _) = of.place(fields)?;
        Some(Self { element, value: of.value, was_there: None })
    }
}

impl Exchanges<'_> {
    pub(crate) fn is_used(&self) -> bool {
        !self.items.is_empty()
    }

    pub(crate) fn view(&mut self) -> View<'_> {
        let Self { items, rows, peers, written } = self;
        View { items, rows, peers, written }
    }
}

impl View<'_> {
    /// The exchanges of a port.
    pub(crate) fn of(&mut self, line: &Line) -> (&mut [ExchangeItem], ExchangeTable<'_>) {
        let (items, table, _) = self.served(line);
        (items, table)
    }

    /// Like [`Self::of`], with what masters have written on all ports.
    pub(crate) fn served(&mut self, line: &Line) -> (&mut [ExchangeItem], ExchangeTable<'_>, &mut [Piece]) {
        let range = |span: Span| {
            let start = usize::from(span.start);
            start..start.saturating_add(usize::from(span.len))
        };
        let (exchanges, peers) = (range(line.exchanges), range(line.peers));
        (
            self.items.get_mut(exchanges.clone()).unwrap_or(&mut []),
            ExchangeTable {
                rows: self.rows.get_mut(exchanges).unwrap_or(&mut []),
                peers: self.peers.get_mut(peers).unwrap_or(&mut []),
            },
            &mut *self.written,
        )
    }
}
