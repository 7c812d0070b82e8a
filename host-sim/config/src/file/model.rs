//! What is read of a gateway's or a controller's recipes, with the places of what later checks refuse.
//!
//! It knows neither the keys nor how they are read.

use proto_core::config::{
    ExchangeKey, FieldSpec, InputBinding, OnStale, OutcomeTo, OutputBinding, Restarted, SendOn, Triggers,
};
use proto_core::device::{Boundary, Checksum, Encoding, Escape, Kind, Overflow};
use proto_core::recipe::model::{Field, Mode};
use proto_core::sysvar::{SysVar, VarBit};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use super::commands::FileCommands;
use super::reader::Spot;
use crate::device::ExchangeKind;
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

pub(super) struct FileField {
    pub(super) spot: Spot,
    pub(super) kind: FileFieldKind,
}

pub(super) enum FileFieldKind {
    System(SysVar),
    /// `again` marks a second use of the bytes of the field before.
    UserInput {
        name: String,
        written: WrittenField,
        to: FileInput,
        again: bool,
        /// The number that tells that the device has restarted.
        restarted: Option<(Spot, f64)>,
    },
    UserOutput {
        name: String,
        written: WrittenField,
        from: FileOutput,
    },
    Fixed {
        name: Option<String>,
        encoding: Encoding,
        value: i64,
    },
    Padding {
        len: u8,
        fill: u8,
    },
    Checksum(Checksum),
    /// What has no binding of a number: a text, or a length.
    Device {
        name: Option<String>,
        spec: FieldSpec,
    },
}

/// How a field with a value is written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct WrittenField {
    pub(super) encoding: Encoding,
    pub(super) overflow: Overflow,
}

impl WrittenField {
    pub(super) fn plain(ty: ScalarType) -> Self {
        Self { encoding: Encoding::scalar(ty), overflow: Overflow::Usual }
    }

    /// The type, if the controller's recipes have such a field.
    fn as_plain(self) -> Option<ScalarType> {
        match self.encoding.kind {
            Kind::Scalar(ty) if self == Self::plain(ty) => Some(ty),
            _ => None,
        }
    }
}

impl FileField {
    /// The field as the controller's recipes have it; `None` if only frames of devices have it.
    pub(super) fn field(&self) -> Option<Field> {
        match self.kind {
            FileFieldKind::System(var) => Some(Field::System(var)),
            FileFieldKind::UserInput { written, .. } | FileFieldKind::UserOutput { written, .. } => {
                written.as_plain().map(Field::User)
            }
            _ => None,
        }
    }

    /// The field as the configuration has it; `bind` makes the binding of an input field.
    pub(super) fn bound_spec(&self, bind: impl FnOnce(&FileInput) -> InputBinding) -> FieldSpec {
        match &self.kind {
            FileFieldKind::System(var) => FieldSpec::System(*var),
            FileFieldKind::UserInput { written, to, .. } => {
                let to = bind(to);
                let WrittenField { encoding, overflow } = *written;
                match written.as_plain() {
                    Some(ty) => FieldSpec::UserInput { ty, to },
                    None => FieldSpec::DeviceInput { encoding, overflow, to },
                }
            }
            FileFieldKind::UserOutput { written, from, .. } => {
                let from = match from {
                    // Which port it is, is put in when all ports are known.
                    FileOutput::Bound(binding) | FileOutput::PortNamed { binding, .. } => *binding,
                    FileOutput::Program => OutputBinding::Constant(0.0),
                };
                let WrittenField { encoding, overflow } = *written;
                match written.as_plain() {
                    Some(ty) => FieldSpec::UserOutput { ty, from },
                    None => FieldSpec::DeviceOutput { encoding, overflow, from },
                }
            }
            &FileFieldKind::Fixed { encoding, value, .. } => FieldSpec::Fixed { encoding, value },
            &FileFieldKind::Padding { len, fill } => FieldSpec::Padding { len, fill },
            FileFieldKind::Checksum(sum) => FieldSpec::Checksum(*sum),
            FileFieldKind::Device { spec, .. } => *spec,
        }
    }

    /// The source of an output field that shows the health of a port with this name.
    pub(super) fn port_named(&self) -> Option<(OutputBinding, &str, &Spot)> {
        match &self.kind {
            FileFieldKind::UserOutput { from: FileOutput::PortNamed { name, spot, binding }, .. } => {
                Some((*binding, name, spot))
            }
            _ => None,
        }
    }

    /// Its name; empty for what needs none.
    pub(super) fn name(&self) -> String {
        match &self.kind {
            FileFieldKind::System(var) => var.to_string(),
            FileFieldKind::UserInput { name, .. } | FileFieldKind::UserOutput { name, .. } => name.clone(),
            FileFieldKind::Fixed { name, .. } | FileFieldKind::Device { name, .. } => {
                name.clone().unwrap_or_default()
            }
            FileFieldKind::Padding { .. } | FileFieldKind::Checksum(_) => String::new(),
        }
    }
}

/// One exchange, or one block of a slave.
pub(super) struct FileExchange {
    pub(super) spot: Spot,
    /// The places of its keys, for later checks.
    pub(super) spots: Vec<(ExchangeKey, Spot)>,
    pub(super) peer: u8,
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
    /// When the values of its reply are overdue.
    pub(super) overdue: Option<Duration>,
    /// What in its reply tells that the device has restarted.
    pub(super) restarted: Option<Restarted>,
    pub(super) timing: AskTiming,
}

/// When an exchange is asked, and how long it may take.
pub(super) struct AskTiming {
    pub(super) when: Triggers,
    pub(super) timeout: Duration,
    pub(super) retries: Option<u8>,
    pub(super) pause: Duration,
    pub(super) trigger: Option<Duration>,
    pub(super) late: Option<Duration>,
    pub(super) stop: bool,
    pub(super) follow: Option<u8>,
    pub(super) outcome: OutcomeTo,
}

/// The binding of an input field.
pub(super) enum FileInput {
    Unused,
    Variable {
        var: SysVar,
        scale: f32,
        offset: f32,
        /// It is written in the file.
        has_offset: bool,
    },
    Bit(VarBit),
    Commands(FileCommands),
    /// An alive counter, which goes from this number to 0.
    Counter {
        max: u32,
    },
}

impl FileInput {
    /// The binding, if it needs no table of commands.
    pub(super) fn without_commands(&self) -> InputBinding {
        match *self {
            Self::Variable { var, scale, offset, .. } => InputBinding::Variable { var, scale, offset },
            Self::Bit(VarBit { var, bit }) => InputBinding::Bit { var, bit },
            Self::Counter { max } => InputBinding::Counter { max },
            Self::Unused | Self::Commands(_) => InputBinding::Unused,
        }
    }
}

/// The source of an output field.
pub(super) enum FileOutput {
    /// A program of the controller sets it.
    Program,
    Bound(OutputBinding),
    /// The health of a port with this name, which may stand behind the recipe.
    PortNamed {
        name: String,
        spot: Spot,
        binding: OutputBinding,
    },
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
