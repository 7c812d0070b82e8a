//! The gateway's configuration as the engine takes it. TOML on the host, postcard on the board and
//! the builder in a program all produce these types (docs/architecture.md section 5).
//!
//! Bounded and plain: names are kept for messages, everything else is numbers. Nothing here has
//! been checked until [`ConfigView::validate`] has accepted it. [`GatewayConfig::builder`] makes a
//! configuration in a program. If the default sizes are too large, give smaller ones, such as
//! `GatewayConfig<1, 1, 32, 0, 4>`: one port, one recipe, 32 fields, no commands, 4 safe values.

mod add;
mod budget;
mod builder;
mod check_recipe;
mod describe;
mod device;
mod draft;
mod error;
mod fields;
#[cfg(feature = "image")]
pub mod image;
mod listen;
mod network;
mod rules;
mod validate;
mod view;

pub use budget::{PartBudget, Warning, can_frame_time};
pub use builder::ConfigBuilder;
pub use device::DeviceFrame;
pub use draft::{Can, ControllerBuilder, Listen, PortBuilder, PortBus, RecipeBuilder, SafeValues};
pub use error::{
    ConfigError, ConfigErrorKind, ControllerKey, Counted, NetworkKey, Place, PortKey, RecipeKey,
};
pub use fields::{CanFields, Fields, InputField, OutputField, Var};
pub use listen::listen_address;
pub use network::{BoardAddress, Network};
pub(crate) use rules::MIN_CYCLE;
pub use rules::{check_address, check_bitrate, check_cycle, check_name};
pub(crate) use view::ConfigMut;
pub use view::ConfigView;

use heapless::{String, Vec};

use crate::device::{Checksum, Encoding, Overflow};
use crate::recipe::model::{MAX_CAN_IDS, MAX_DELIMITER, Mode};
use crate::sysvar::SysVar;
use crate::time::Duration;
use crate::wire::can::CanId;
use crate::wire::dialect::Dialect;
use crate::wire::scalar::ScalarType;

/// Maximum number of ports: field ports, and listening ports for the controller's own clients.
pub const MAX_PORTS: usize = 8;
/// Maximum number of recipes.
pub const MAX_RECIPES: usize = 16;
/// Maximum number of fields in all recipes together.
pub const MAX_ALL_FIELDS: usize = 1024;
/// Maximum number of entries in all command tables together.
pub const MAX_COMMANDS: usize = 32;
/// Maximum number of safe values on all ports together.
pub const MAX_SAFE_VALUES: usize = 64;
/// Maximum length of the name of a recipe or port, in bytes.
pub const MAX_NAME: usize = 32;
/// Maximum length of the controller's address or host name, in bytes.
pub const MAX_ADDRESS: usize = 64;
/// Maximum length of an address and port to listen on, in bytes.
pub const MAX_LISTEN: usize = 48;

/// Name of a recipe or port.
pub type Name = String<MAX_NAME>;
/// Head or tail of a stream part.
pub type Delimiter = Vec<u8, MAX_DELIMITER>;

/// A whole gateway file. The parameters are the numbers of ports, recipes, fields in all recipes,
/// entries in all command tables and safe values on all ports that there is room for.
///
/// The defaults are the maximum for a file and take 44 KiB. [`Self::empty`] is all zeros, so a
/// static one takes no flash.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct GatewayConfig<
    const PORTS: usize = MAX_PORTS,
    const RECIPES: usize = MAX_RECIPES,
    const ALL_FIELDS: usize = MAX_ALL_FIELDS,
    const COMMANDS: usize = MAX_COMMANDS,
    const SAFE_VALUES: usize = MAX_SAFE_VALUES,
> {
    /// The controller's address, ports and dialect.
    pub controller: ControllerLink,
    /// The board's own address.
    pub network: BoardAddress,
    /// Every recipe, in file order.
    pub recipes: Vec<Recipe, RECIPES>,
    /// Every port, in file order.
    pub ports: Vec<Port, PORTS>,
    /// The fields of all recipes; parts refer to ranges of it.
    pub fields: Vec<FieldSpec, ALL_FIELDS>,
    /// The entries of all command tables; bindings refer to ranges of it.
    pub commands: Vec<CommandEntry, COMMANDS>,
    /// The values that inputs take when their port times out; ports refer to ranges of it.
    pub safe_values: Vec<SafeValue, SAFE_VALUES>,
}

impl<
    const PORTS: usize,
    const RECIPES: usize,
    const ALL_FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
> GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES>
{
    /// An empty configuration: no controller, no recipes, no ports. All bytes are zero.
    pub const fn empty() -> Self {
        Self {
            controller: ControllerLink::none(),
            network: BoardAddress::Dhcp,
            recipes: Vec::new(),
            ports: Vec::new(),
            fields: Vec::new(),
            commands: Vec::new(),
            safe_values: Vec::new(),
        }
    }

    /// A view of the same type for every size, as the engine, the checks and the image take it.
    pub fn view(&self) -> ConfigView<'_> {
        ConfigView {
            controller: &self.controller,
            network: self.network.fixed(),
            recipes: &self.recipes,
            ports: &self.ports,
            fields: &self.fields,
            commands: &self.commands,
            safe_values: &self.safe_values,
        }
    }

    /// A mutable view of the same type for every size.
    pub(crate) fn view_mut(&mut self) -> ConfigMut<'_> {
        ConfigMut {
            controller: &mut self.controller,
            #[cfg(feature = "image")]
            network: &mut self.network,
            recipes: self.recipes.as_mut_view(),
            ports: self.ports.as_mut_view(),
            fields: self.fields.as_mut_view(),
            commands: self.commands.as_mut_view(),
            safe_values: self.safe_values.as_mut_view(),
        }
    }

    /// Checks everything that can be checked without the controller.
    ///
    /// # Errors
    /// The first mistake, with its place and the numbers.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.view().validate()
    }
}

impl<
    const PORTS: usize,
    const RECIPES: usize,
    const ALL_FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
> Default for GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES>
{
    /// Same as [`Self::empty`].
    fn default() -> Self {
        Self::empty()
    }
}

impl<
    'c,
    const PORTS: usize,
    const RECIPES: usize,
    const ALL_FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
> From<&'c GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES>> for ConfigView<'c>
{
    fn from(config: &'c GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES>) -> Self {
        config.view()
    }
}

/// The controller's side of the gateway.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct ControllerLink {
    /// Address or host name; empty on a board that learns it otherwise.
    pub address: String<MAX_ADDRESS>,
    /// Name of the dialect (see [`crate::wire::dialect`]).
    pub dialect: String<16>,
    /// Command port, normally 2000.
    pub command_port: u16,
    /// State port, normally 2001.
    pub state_port: u16,
    /// Modbus port, normally 502.
    pub modbus_port: u16,
    /// The controller's UDP 2011 recipe server, if it is set to one of our recipes.
    pub recipe_link: Option<RecipeLink>,
}

impl ControllerLink {
    pub(crate) const fn none() -> Self {
        Self {
            address: String::new(),
            dialect: String::new(),
            command_port: 0,
            state_port: 0,
            modbus_port: 0,
            recipe_link: None,
        }
    }

    /// Sets the dialect, and the Modbus port that a controller of this dialect has.
    pub fn set_dialect(&mut self, dialect: Dialect) {
        self.modbus_port = dialect.modbus_port;
        // The names of the table are short.
        self.dialect = String::try_from(dialect.name).unwrap_or_default();
    }
}

impl Default for ControllerLink {
    /// The defaults of a file that gives only an address: dialect v2.3, ports 2000, 2001 and 502,
    /// no recipe link.
    fn default() -> Self {
        let mut link = Self { command_port: 2000, state_port: 2001, ..Self::none() };
        link.set_dialect(Dialect::V2_3);
        link
    }
}

/// The controller's own recipe port, used as the fast way up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RecipeLink {
    /// UDP port on the controller, normally 2011.
    pub udp_port: u16,
    /// Index into [`GatewayConfig::recipes`].
    pub recipe: u8,
}

/// One recipe.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct Recipe {
    /// Its name.
    pub name: Name,
    /// System variables, or user-defined fields.
    pub mode: Mode,
    /// Stream or CAN, with the parts.
    pub parts: Parts,
    /// What a port does while the sources of its output are stale.
    pub on_stale: OnStale,
    /// What makes a port send the output part.
    pub send: SendOn,
}

/// A recipe's two parts; either may be absent, not both.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[allow(clippy::large_enum_variant, reason = "without an allocator there is no box to put the larger one in")]
pub enum Parts {
    /// Byte streams and datagrams.
    Stream {
        /// User to robot.
        input: Option<StreamPart>,
        /// Robot to user.
        output: Option<StreamPart>,
    },
    /// CAN; an absent part has no frames.
    Can {
        /// User to robot.
        input: Vec<CanFramePart, MAX_CAN_IDS>,
        /// Robot to user.
        output: Vec<CanFramePart, MAX_CAN_IDS>,
    },
}

/// One part of a stream recipe.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StreamPart {
    /// Bytes before the fields.
    pub head: Delimiter,
    /// Bytes after the fields.
    pub tail: Delimiter,
    /// The fields.
    pub fields: Span,
}

/// One frame id of a CAN recipe's part.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CanFramePart {
    /// The frame's id.
    pub id: CanId,
    /// The fields, at most 8 bytes together.
    pub fields: Span,
}

/// A range of one of the pools of [`GatewayConfig`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Span {
    /// First index.
    pub start: u16,
    /// Number of entries.
    pub len: u16,
}

impl Span {
    /// The part of `pool` that this range covers; empty if it does not fit.
    pub fn of<T>(self, pool: &[T]) -> &[T] {
        let start = usize::from(self.start);
        pool.get(start..start.saturating_add(usize::from(self.len))).unwrap_or(&[])
    }
}

/// One field, and what the gateway does with it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum FieldSpec {
    /// A system variable of a realtime recipe.
    System(SysVar),
    /// A field of a user-defined recipe's input part.
    UserInput {
        /// The field's type on the wire.
        ty: ScalarType,
        /// What is done with its value.
        to: InputBinding,
    },
    /// A field of a user-defined recipe's output part.
    UserOutput {
        /// The field's type on the wire.
        ty: ScalarType,
        /// Where its value comes from.
        from: OutputBinding,
    },
    /// A field of a device's frame, in the input part of a user recipe.
    DeviceInput {
        /// How it is written.
        encoding: Encoding,
        /// What becomes of a number that its variable cannot hold.
        overflow: Overflow,
        /// What is done with its value.
        to: InputBinding,
    },
    /// A field of a device's frame, in the output part of a user recipe.
    DeviceOutput {
        /// How it is written.
        encoding: Encoding,
        /// What becomes of a number that it cannot hold.
        overflow: Overflow,
        /// Where its value comes from.
        from: OutputBinding,
    },
    /// An integer that is the same in every frame; a received frame with another one is not this
    /// frame.
    Fixed {
        /// How it is written.
        encoding: Encoding,
        /// The integer.
        value: i64,
    },
    /// Bytes without a meaning: any are accepted.
    Padding {
        /// Number of bytes.
        len: u8,
        /// What is sent.
        fill: u8,
    },
    /// The frame's checksum stands here.
    Checksum(Checksum),
}

/// What is done with a received user-defined value.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum InputBinding {
    /// It is ignored.
    Unused,
    /// `value * scale + offset` becomes the variable's value.
    Variable {
        /// An input variable.
        var: SysVar,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// The value picks a port-2000 command from a table; a value not in the table does nothing.
    Commands {
        /// The table, in [`GatewayConfig::commands`].
        table: Span,
        /// When a value takes effect.
        when: CommandWhen,
    },
}

/// When a value that picks a command takes effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum CommandWhen {
    /// When it differs from the previous frame; the first frame after silence only sets the base.
    #[default]
    Change,
    /// With every accepted frame: for devices that send a frame only when they mean it.
    Frame,
}

/// Where a user-defined output value comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum OutputBinding {
    /// `variable * scale + offset`, saturated to the field's type.
    Variable {
        /// Any variable that the controller shows.
        var: SysVar,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// A constant.
    Constant(f64),
    /// Frames sent so far, wrapping in the field's type.
    Counter,
    /// The result of this port's newest command: see [`crate::engine::ReplyCode`].
    Reply,
}

/// One entry of a command table.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CommandEntry {
    /// The field's value that picks the command.
    pub value: i64,
    /// The command as port 2000 takes it, such as `run(pick.jspf,50)`.
    pub text: String<MAX_COMMAND_TEXT>,
}

/// Maximum length of a command in a table, in bytes; well below the controller's limit (D5).
pub const MAX_COMMAND_TEXT: usize = 96;

/// What a port does while the sources of its output are older than `stale_after`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum OnStale {
    /// Keep sending the last values.
    #[default]
    Hold,
    /// Send nothing.
    Stop,
}

/// What makes a port send its output part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum SendOn {
    /// The port's cycle; the only choice for realtime recipes.
    #[default]
    Period,
    /// Each cycle in which a value changed.
    Change,
    /// Every accepted input frame: request and response.
    Frame,
    /// A bit going from 0 to 1.
    Rising {
        /// A bit variable that the controller shows.
        var: SysVar,
        /// Bit 0..=7.
        bit: u8,
    },
}

/// One port.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct Port {
    /// Its name, as `--bind` and `--stats` use it.
    pub name: Name,
    /// Its bus.
    pub bus: Bus,
    /// Index into [`GatewayConfig::recipes`].
    pub recipe: u8,
    /// How often the output part is sent; at least 4 ms.
    pub cycle: Duration,
    /// After this long without an accepted frame the port's inputs take their safe values.
    pub timeout: Duration,
    /// The safe values that inputs take then; inputs without a safe value hold.
    pub on_timeout: Span,
    /// Outputs whose source is older than this are stale.
    pub stale_after: Duration,
}

impl Recipe {
    /// A recipe with these parts that is sent every cycle and holds stale values.
    pub const fn new(name: Name, mode: Mode, parts: Parts) -> Self {
        Self { name, mode, parts, on_stale: OnStale::Hold, send: SendOn::Period }
    }
}

impl Port {
    /// A port with the file's defaults: a cycle of 4 ms, a timeout of 100 ms, stale after 500 ms, and
    /// inputs that hold.
    pub const fn new(name: Name, bus: Bus, recipe: u8) -> Self {
        Self {
            name,
            bus,
            recipe,
            cycle: MIN_CYCLE,
            timeout: Duration::from_millis(100),
            on_timeout: Span { start: 0, len: 0 },
            stale_after: Duration::from_millis(500),
        }
    }
}

/// The bus of a port.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Bus {
    /// Half-duplex serial line on the field side.
    Rs485(Rs485),
    /// CAN bus on the field side.
    Can {
        /// Bit/s, 10_000..=1_000_000; a file's default is [`Bus::BITRATE`].
        bitrate: u32,
    },
    /// Where the controller's TCP client connects to: a way up, like the recipe link.
    TcpListen {
        /// Address and port, such as `0.0.0.0:50000`.
        listen: String<MAX_LISTEN>,
    },
    /// Where the controller's UDP client sends to: a way up, like the recipe link.
    UdpListen {
        /// Address and port.
        listen: String<MAX_LISTEN>,
    },
}

impl Bus {
    /// Default bit rate of a CAN bus, in bit/s.
    pub const BITRATE: u32 = 500_000;

    /// Whether devices (not the controller) are at the other end.
    pub fn is_field(&self) -> bool {
        matches!(self, Self::Rs485(_) | Self::Can { .. })
    }
}

/// A serial line's settings (D19, D20, D21).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Rs485 {
    /// Bit/s, 1200..=4_000_000.
    pub baud: u32,
    /// Parity bit.
    pub parity: Parity,
    /// 1 or 2.
    pub stop_bits: u8,
    /// A partial frame is discarded after the line has been silent for this long.
    pub idle_gap: Duration,
    /// The line must have been silent for this long before a frame is sent.
    pub turnaround: Duration,
}

impl Default for Rs485 {
    /// The defaults of a file: 115 200 bit/s, no parity, 1 stop bit, an idle gap of 50 ms, a
    /// turnaround of 100 µs.
    fn default() -> Self {
        Self {
            baud: 115_200,
            parity: Parity::None,
            stop_bits: 1,
            idle_gap: Duration::from_millis(50),
            turnaround: Duration::from_micros(100),
        }
    }
}

/// A serial line's parity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Parity {
    /// No parity bit.
    #[default]
    None,
    /// Even parity.
    Even,
    /// Odd parity.
    Odd,
}

/// The value that an input variable takes when its port times out.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SafeValue {
    /// An input variable that the port owns.
    pub var: SysVar,
    /// Its safe value.
    pub value: crate::wire::scalar::Scalar,
}

#[cfg(test)]
mod tests;
