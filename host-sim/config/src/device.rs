//! A recipe with a device's own frames, with the names of its fields, for tools that show frames.

use proto_core::config::{CommandWhen, DeviceFrame, FieldSpec};
use proto_core::device::{Boundary, Carrier, Escape, LayoutError};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::Direction;
use proto_core::wire::can::CanId;

use crate::sim::SimRecipe;

/// A recipe of a file.
#[derive(Debug, Clone, PartialEq)]
pub enum AnyRecipe {
    /// A recipe that the controller can have as well.
    Plain(SimRecipe),
    /// A recipe with a device's own frames, for field ports of the gateway.
    Device(DeviceRecipe),
}

impl AnyRecipe {
    /// Its name.
    pub fn name(&self) -> &str {
        match self {
            Self::Plain(recipe) => &recipe.name,
            Self::Device(recipe) => &recipe.name,
        }
    }

    /// The recipe, if the controller can have it as well.
    pub fn plain(&self) -> Option<&SimRecipe> {
        match self {
            Self::Plain(recipe) => Some(recipe),
            Self::Device(_) => None,
        }
    }
}

/// A recipe with a device's own frames.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceRecipe {
    /// Name.
    pub name: String,
    /// What carries the frames.
    pub carrier: Carrier,
    /// Device to gateway: one frame on a stream, one for each id on CAN; empty without such a part.
    pub input: Vec<NamedFrame>,
    /// Gateway to device.
    pub output: Vec<NamedFrame>,
    /// How the frames of the input part are separated.
    pub input_ends: FrameEnds,
    /// How the frames of the output part are separated.
    pub output_ends: FrameEnds,
    /// Exchanges beside these frames, in the order of the file.
    pub exchanges: Vec<NamedExchange>,
}

/// How the frames of a stream part are separated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameEnds {
    /// Without escape bytes.
    pub boundary: Boundary,
    /// Escape bytes around each frame.
    pub escape: Option<Escape>,
}

/// An exchange with the names of its fields. Its frames are complete: those of Modbus have address, function and CRC.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedExchange {
    /// The slave's address on Modbus, or the number of the device.
    pub peer: u8,
    /// Whether the frames are the device's own or Modbus.
    pub kind: ExchangeKind,
    /// The request.
    pub request: Option<NamedFrame>,
    /// The reply.
    pub reply: Option<NamedFrame>,
    /// What the device sends while it is still executing the request.
    pub pending: Option<NamedFrame>,
    /// What the device sends to refuse the request.
    pub refusal: Option<NamedFrame>,
    /// The request is a remote frame on CAN, without data.
    pub remote: bool,
}

/// The frame format of an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExchangeKind {
    /// The device's own frames.
    Frames,
    /// Modbus RTU with the gateway as master.
    Master(Operation),
    /// Modbus RTU with the gateway as slave: a block is read or written as a whole.
    Slave(Operation),
}

impl DeviceRecipe {
    /// The frames of one part.
    pub fn part(&self, part: Direction) -> &[NamedFrame] {
        match part {
            Direction::Input => &self.input,
            Direction::Output => &self.output,
        }
    }

    /// How the frames of one part are separated.
    pub fn ends(&self, part: Direction) -> FrameEnds {
        match part {
            Direction::Input => self.input_ends,
            Direction::Output => self.output_ends,
        }
    }
}

/// A frame with the names of its fields.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedFrame {
    /// Its id on CAN.
    pub id: Option<CanId>,
    /// Bytes before the fields.
    pub head: Vec<u8>,
    /// Bytes after the fields.
    pub tail: Vec<u8>,
    /// The fields, and the checksum at its place.
    pub fields: Vec<DeviceField>,
    /// Name in the file, if any: only of an output frame on CAN.
    pub name: Option<String>,
    /// The name of the frame after which this frame is sent.
    pub after: Option<String>,
}

/// A field of a device's frame. Its `spec` has no table of commands: the field is unused there, and `commands` has the
/// table.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceField {
    /// Name; empty if it needs none.
    pub name: String,
    /// What it is.
    pub spec: FieldSpec,
    /// Whether the field reuses the bytes of the previous field, under the same name.
    pub repeats: bool,
    /// The commands that its values pick.
    pub commands: Option<FieldCommands>,
    /// Whether it is the coil of Modbus function 5, which is FF for 1.
    pub is_coil: bool,
    /// Whether the file has an `offset`, even if it is 0.
    pub has_offset: bool,
    /// The port whose health the field shows, if not the port that sends it.
    pub of_port: Option<String>,
    /// Limits of the sent value, or the entries of a table.
    pub sendable: Vec<FieldSpec>,
}

impl DeviceField {
    /// A field with a name, empty if it needs none, and nothing but its `spec`.
    pub const fn new(name: String, spec: FieldSpec) -> Self {
        Self {
            name,
            spec,
            repeats: false,
            commands: None,
            is_coil: false,
            has_offset: false,
            of_port: None,
            sendable: Vec::new(),
        }
    }
}

/// The commands that the values of a field pick.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldCommands {
    /// When a value takes effect.
    pub when: CommandWhen,
    /// First and last value, and the command, which is empty for idle values.
    pub entries: Vec<(i64, i64, String)>,
}

impl NamedFrame {
    /// Lays out the frame.
    ///
    /// # Errors
    /// Never for a frame from a file: reading the file has laid it out.
    pub fn lay_out(&self, carrier: Carrier, part: Direction) -> Result<DeviceFrame, LayoutError> {
        let specs: Vec<_> = self.fields.iter().map(|field| field.spec).collect();
        DeviceFrame::new(carrier, part, (&self.head, &self.tail), &specs)
    }
}
