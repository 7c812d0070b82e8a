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
    /// One that the controller can have as well.
    Plain(SimRecipe),
    /// One with a device's own frames, for field ports of the gateway.
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
    /// What tells the frames of the input part apart.
    pub input_ends: FrameEnds,
    /// What tells the frames of the output part apart.
    pub output_ends: FrameEnds,
    /// What is asked beside these frames, in the order of the file.
    pub exchanges: Vec<NamedExchange>,
}

/// What tells the frames of a stream part apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameEnds {
    /// Without escape bytes.
    pub boundary: Boundary,
    /// Escape bytes around each frame.
    pub escape: Option<Escape>,
}

/// An exchange with the names of its fields. Its frames are whole: those of Modbus have address,
/// function and CRC.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedExchange {
    /// The slave's address on Modbus, or the number of the device.
    pub peer: u8,
    /// Whose frames they are.
    pub kind: ExchangeKind,
    /// What asks.
    pub request: Option<NamedFrame>,
    /// What answers.
    pub reply: Option<NamedFrame>,
    /// What the device sends while it is at it.
    pub pending: Option<NamedFrame>,
    /// What the device sends if it refuses the request.
    pub refusal: Option<NamedFrame>,
    /// The request is a remote frame on CAN, without data.
    pub remote: bool,
}

/// Whose frames an exchange has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExchangeKind {
    /// The device's own.
    Frames,
    /// Those of Modbus RTU, which the gateway asks as master.
    Master(Operation),
    /// Those of Modbus RTU, which the gateway answers as slave: all of a block is read or written.
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

    /// What tells the frames of one part apart.
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
    /// Its name, if the file gives it one: of an output frame on CAN.
    pub name: Option<String>,
    /// The name of the frame behind which it is sent.
    pub after: Option<String>,
}

/// A field of a device's frame. Its `spec` has no table of commands: the field is unused there, and
/// `commands` has them.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceField {
    /// Name; empty for what needs none.
    pub name: String,
    /// What it is.
    pub spec: FieldSpec,
    /// It is a second use of the bytes of the field before, under the same name.
    pub repeats: bool,
    /// The commands that its values pick.
    pub commands: Option<FieldCommands>,
    /// It is the coil of Modbus function 5, which is FF for 1.
    pub is_coil: bool,
    /// Its `offset` is written, also if it is 0.
    pub has_offset: bool,
    /// The port whose health it shows, if that is not the port that sends it.
    pub of_port: Option<String>,
    /// What it may send: limits, or the entries of a table.
    pub sendable: Vec<FieldSpec>,
}

impl DeviceField {
    /// A field with a name, empty if it needs none, and nothing beside its `spec`.
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
    /// First and last value, and the command; an empty one is that of idle values.
    pub entries: Vec<(i64, i64, String)>,
}

impl NamedFrame {
    /// Lays out the frame.
    ///
    /// # Errors
    /// None for a frame from a file: reading the file laid it out.
    pub fn lay_out(&self, carrier: Carrier, part: Direction) -> Result<DeviceFrame, LayoutError> {
        let specs: Vec<_> = self.fields.iter().map(|field| field.spec).collect();
        DeviceFrame::new(carrier, part, (&self.head, &self.tail), &specs)
    }
}
