//! The recipes of a file as they were read, with places for the errors of later checks.
//!
//! Does not know the keys or how they are read.

use proto_core::config::{Exchange, ExchangeKey, FieldSpec, OnStale, SendOn, Transaction, Triggers};
use proto_core::device::{Boundary, Escape};
use proto_core::recipe::model::Mode;
use proto_core::wire::can::CanId;

use super::reader::Spot;
use crate::device::{DeviceField, ExchangeKind};
use crate::keys::recipe::RecipeKind;

/// The kind of file: only a gateway's recipes have bindings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Flavour {
    Gateway,
    Controller,
}

pub(super) struct FileRecipe {
    pub(super) spot: Spot,
    pub(super) name: String,
    pub(super) name_spot: Spot,
    pub(super) mode: Mode,
    pub(super) kind: RecipeKind,
    pub(super) input: Option<FilePart>,
    pub(super) output: Option<FilePart>,
    /// Exchanges beside the parts, or everything that a Modbus recipe has.
    pub(super) exchanges: Vec<FileExchange>,
    /// What requests do while one of their values is stale, if no output part says it.
    pub(super) on_stale: Option<OnStale>,
}

pub(super) struct FilePart {
    pub(super) spot: Spot,
    pub(super) head: Vec<u8>,
    pub(super) tail: Vec<u8>,
    pub(super) head_spot: Option<Spot>,
    pub(super) tail_spot: Option<Spot>,
    /// One frame in a stream part, one for each id in a CAN part.
    pub(super) frames: Vec<FileFrame>,
    /// The gateway's keys of an output part.
    pub(super) sending: Sending,
    /// How the frames of a stream are separated.
    pub(super) framing: (Boundary, Option<Escape>),
}

pub(super) struct FileFrame {
    pub(super) spot: Spot,
    /// 0 in a stream part.
    pub(super) id: CanId,
    pub(super) id_spot: Spot,
    pub(super) fields: Vec<FileField>,
    /// Only of an output frame on CAN.
    pub(super) order: FrameOrder,
}

/// A field with its name, and places for the errors of later checks.
pub(super) struct FileField {
    pub(super) spot: Spot,
    pub(super) named: DeviceField,
    /// The places of its commands.
    pub(super) commands: Vec<Spot>,
    /// The place of another port's name.
    pub(super) port: Option<Spot>,
    /// The number that reports that the device has restarted.
    pub(super) restarted: Option<(Spot, f64)>,
}

impl FileField {
    /// A field with a name, empty if it needs none.
    pub(super) fn new(spot: Spot, name: String, spec: FieldSpec) -> Self {
        let named = DeviceField::new(name, spec);
        Self { spot, named, commands: Vec::new(), port: None, restarted: None }
    }

    /// The field as in the configuration, but without its commands and the number of another port.
    pub(super) fn spec(&self) -> FieldSpec {
        self.named.spec
    }
}

/// One exchange, or one block of a slave.
pub(super) struct FileExchange {
    pub(super) spot: Spot,
    /// The places of the keys, for later checks.
    pub(super) spots: Vec<(ExchangeKey, Spot)>,
    /// As in the configuration, except for frames and repetitions.
    pub(super) settings: Exchange,
    pub(super) retries: Option<u8>,
    pub(super) kind: ExchangeKind,
    /// The frame to the device. On Modbus only registers or coils, without a frame around them.
    pub(super) output: Option<FilePart>,
    /// The frame from the device.
    pub(super) input: Option<FilePart>,
    pub(super) pending: Option<FilePart>,
    pub(super) refusal: Option<FilePart>,
    /// Whether the frames are on a CAN bus.
    pub(super) is_can: bool,
    /// Whether the request is a remote frame on CAN.
    pub(super) remote: bool,
}

impl FileExchange {
    /// Settings of an exchange that is never requested.
    pub(super) const fn never(peer: u8) -> Exchange {
        Exchange::new(
            peer,
            Transaction::Frames { request: None, reply: None, refusal: None },
            Triggers::NEVER,
        )
    }
}

/// When an output part is sent.
#[derive(Default)]
pub(super) struct Sending {
    pub(super) on_stale: OnStale,
    pub(super) send: SendOn,
    pub(super) send_spot: Option<Spot>,
}

/// The name of a frame, and the frame that goes before it.
#[derive(Debug, Clone, Default)]
pub(super) struct FrameOrder {
    pub(super) name: Option<(String, Spot)>,
    pub(super) after: Option<(String, Spot)>,
}

impl FrameOrder {
    pub(super) fn name(&self) -> Option<&str> {
        self.name.as_ref().map(|(name, _)| name.as_str())
    }

    pub(super) fn after(&self) -> Option<&str> {
        self.after.as_ref().map(|(name, _)| name.as_str())
    }
}
