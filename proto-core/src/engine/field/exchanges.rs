//! The exchanges of all ports: their frames, their turns and what is known of their peers.
//!
//! In: the exchanges of a configuration. Out: for each port with exchanges a [`Line`], and the frames
//! that it sends and takes. One list for all ports, so that a port without exchanges takes no room.

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

/// The exchanges of all ports; ports name ranges of them.
pub(crate) struct Exchanges<'e> {
    pub items: &'e mut VecView<ExchangeItem>,
    pub rows: &'e mut VecView<Row>,
    pub peers: &'e mut VecView<PeerState>,
    /// What masters have written, and the requests of events.
    pub written: &'e mut [Piece],
}

/// Bytes of a block that a master writes, or of the request of an event; each takes as many pieces as it needs.
pub(crate) type Piece = [u8; 32];

/// The same, of any size.
pub(crate) struct View<'a> {
    items: &'a mut [ExchangeItem],
    rows: &'a mut [Row],
    peers: &'a mut [PeerState],
    written: &'a mut [Piece],
}

/// What is asked, and what answers.
#[derive(Debug, Clone)]
pub(crate) struct ExchangeItem {
    pub asks: Asks,
    pub request: Option<DeviceFormat>,
    pub reply: Option<InputFormat>,
    pub pending: Option<OtherFormat>,
    pub refusal: Option<OtherFormat>,
    /// What in the reply tells that the peer has restarted.
    pub restart: Option<RestartSign>,
    /// It is asked when a value of the request changes.
    pub on_change: bool,
    /// The bit whose rise asks it.
    pub trigger: Option<Trigger>,
    /// It stops its peer.
    pub stops: bool,
    /// The exchange of the port after whose good answer it is sent.
    pub follow: Option<u8>,
    /// How long after an event its request may be sent.
    pub window: Duration,
    pub event: Event,
    /// What the robot is told of its events, in which variables, and whether that is new.
    pub reported: ReportedOutcome,
    pub outcome: OutcomeTo,
    pub is_news: bool,
    /// The newest request, to tell a change.
    pub digest: Option<NonZero<u64>>,
    /// It was to be asked, and a value of it was unknown or stale.
    pub is_owed: bool,
    /// Where a block that a master writes is kept, so that the master can read it; or the request of an event.
    pub pieces: Span,
    /// A master has written it.
    pub is_written: bool,
}

/// How a request is made.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Asks {
    /// As a master on Modbus; request and reply are the data in their frames.
    Rtu { slave: u8, operation: Operation },
    /// With a frame of the device's own.
    Frame,
    /// With a remote frame on a CAN bus, which says how long the reply is.
    Remote { id: CanId, len: u8 },
    /// Not at all: a master asks, and these are registers or coils of ours.
    Served { table: Table, address: u16, count: u16 },
    /// Not at all: the reply comes unasked.
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

/// The number in a reply that tells that the peer has restarted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RestartSign {
    /// Its place among the elements of the reply.
    pub element: u8,
    pub value: f64,
    /// Whether the reply before had it; `None` if there was none since the peer started.
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

    /// The same, and what masters have written on all ports.
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
