//! What is read of a gateway's or a controller's recipes, with the places of what later checks refuse.
//!
//! It knows neither the keys nor how they are read.

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
    /// What is asked of devices beside the parts, or all that a recipe of Modbus has.
    pub(super) exchanges: Vec<FileExchange>,
    /// What requests do while a value of them is stale, if there is no output part to say it.
    pub(super) on_stale: Option<OnStale>,
}

pub(super) struct FilePart {
    pub(super) spot: Spot,
    pub(super) head: Vec<u8>,
    pub(super) tail: Vec<u8>,
    pub(super) head_spot: Option<Spot>,
    pub(super) tail_spot: Option<Spot>,
    /// One in a stream part, one for each id in a CAN part.
    pub(super) frames: Vec<FileFrame>,
    /// The gateway's keys of an output part.
    pub(super) sending: Sending,
    /// What tells the frames of a stream apart.
    pub(super) framing: (Boundary, Option<Escape>),
}

pub(super) struct FileFrame {
    pub(super) spot: Spot,
    /// 0 in a stream part.
    pub(super) id: CanId,
    pub(super) id_spot: Spot,
    pub(super) fields: Vec<FileField>,
    /// Of an output frame on CAN.
    pub(super) order: FrameOrder,
}

/// A field with its name, and the places of what later checks refuse.
pub(super) struct FileField {
    pub(super) spot: Spot,
    pub(super) named: DeviceField,
    /// The places of its commands.
    pub(super) commands: Vec<Spot>,
    /// The place of the name of another port.
    pub(super) port: Option<Spot>,
    /// The number that tells that the device has restarted.
    pub(super) restarted: Option<(Spot, f64)>,
}

impl FileField {
    /// A field with a name, empty if it needs none.
    pub(super) fn new(spot: Spot, name: String, spec: FieldSpec) -> Self {
        let named = DeviceField::new(name, spec);
        Self { spot, named, commands: Vec::new(), port: None, restarted: None }
    }

    /// The field as the configuration has it, still without its commands and without the number of another port.
    pub(super) fn spec(&self) -> FieldSpec {
        self.named.spec
    }
}

/// One exchange, or one block of a slave.
pub(super) struct FileExchange {
    pub(super) spot: Spot,
    /// The places of its keys, for later checks.
    pub(super) spots: Vec<(ExchangeKey, Spot)>,
    /// As in the configuration, but for its frames and repetitions.
    pub(super) settings: Exchange,
    pub(super) retries: Option<u8>,
    pub(super) kind: ExchangeKind,
    /// What goes to the device. Of Modbus: its registers or coils only, without a frame around them.
    pub(super) output: Option<FilePart>,
    /// What comes from it.
    pub(super) input: Option<FilePart>,
    pub(super) pending: Option<FilePart>,
    pub(super) refusal: Option<FilePart>,
    /// Its frames are on a CAN bus.
    pub(super) is_can: bool,
    /// The request is a remote frame on CAN.
    pub(super) remote: bool,
}

impl FileExchange {
    /// Settings of what is never asked.
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

/// What a frame is called, and which one goes before it.
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
