//! The gateway's configuration for the engine. TOML on the host, postcard on the board and the builder in a program all
//! produce these types (docs/architecture.md section 5).
//!
//! Bounded and plain: names are kept for messages, everything else is numbers. Nothing here is checked before
//! [`ConfigView::validate`]. [`GatewayConfig::builder`] builds a configuration in a program. Smaller sizes than the
//! defaults are possible, such as `GatewayConfig<1, 1, 32, 0, 4>`: one port, one recipe, 32 fields, no commands, 4 safe
//! values.

mod add;
mod add_exchange;
mod advice;
mod budget;
mod builder;
mod check_exchange;
mod check_limits;
mod check_recipe;
mod command_text;
mod describe;
mod device;
mod draft;
mod error;
mod exchange;
mod exchange_builder;
mod fields;
mod fitting;
#[cfg(feature = "image")]
pub mod image;
mod keys;
mod limits;
mod line_budget;
mod listen;
mod multiplexing;
mod network;
mod port;
mod recipe;
mod rules;
mod safe_value;
mod source;
mod validate;
mod view;
mod walk;

pub use budget::{PartBudget, Warning, can_frame_time};
pub use builder::ConfigBuilder;
pub use check_exchange::MAX_PAUSE;
pub use check_limits::{check_read, check_sent};
pub use command_text::CommandText;
pub(crate) use command_text::{fill_in, placeholders};
pub use device::{DeviceFrame, register_bits};
pub use draft::{
    Can, ControllerBuilder, Listen, ModbusTcp, PortBuilder, PortBus, RecipeBuilder, RtuLine, SafeValues,
    SerialLine,
};
pub use error::{
    ConfigError, ConfigErrorKind, ControllerKey, Counted, ExchangeError, ExchangeKey, NetworkKey, Place,
    PortKey, RecipeKey,
};
pub(crate) use exchange::has_values;
pub use exchange::{
    DEFAULT_LATE, DEFAULT_REPLY_TIMEOUT, Exchange, FrameSpec, MAX_TRIGGER, OutcomeTo, Restarted, Transaction,
    Triggers,
};
pub use exchange_builder::{Coil, ExchangeBuilder, ExchangeFrame};
pub use fields::{CanFields, Fields, InputField, OutputField, Sum, Var};
pub use fitting::Fitting;
pub(crate) use fitting::fitting_numbers;
pub use limits::{InputRule, Limits, MAX_SENDABLE, MapEntry, NO_TEXT, NoText, Outside};
pub use line_budget::ExchangeBudget;
pub use listen::listen_address;
pub use multiplexing::Constants;
pub use network::{BoardAddress, Network};
pub use port::{Bus, Echo, MIN_CYCLE, Parity, Port, Rs485};
pub use recipe::{
    CanFramePart, CommandEntry, CommandWhen, FieldSpec, InputBinding, MAX_COMMAND_TEXT, OnStale,
    OutputBinding, Parts, Recipe, SendOn, Span, StreamPart, Words,
};
pub use rules::{
    LONGEST_TRIGGER, MAX_LINE_TIME, MAX_TIME, check_address, check_bit, check_bitrate, check_cycle,
    check_name,
};
pub use safe_value::SafeValue;
pub use source::{LinkSource, PortHealth, PortValue, StateValue, StateValueError};
pub(crate) use view::ConfigMut;
pub use view::ConfigView;

use heapless::{String, Vec};

use crate::recipe::model::MAX_DELIMITER;
use crate::wire::dialect::Dialect;

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
/// Maximum number of exchanges in all recipes together, and of their frames.
pub const MAX_EXCHANGES: usize = 64;
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

/// A whole gateway file. The parameters are the maximum numbers of ports, recipes, fields in all recipes, entries in
/// all command tables, safe values on all ports, and exchanges in all recipes.
///
/// The defaults are the maximum for a file and take 59 KiB. [`Self::empty`] is all zeros, so a static one takes no
/// flash.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct GatewayConfig<
    const PORTS: usize = MAX_PORTS,
    const RECIPES: usize = MAX_RECIPES,
    const ALL_FIELDS: usize = MAX_ALL_FIELDS,
    const COMMANDS: usize = MAX_COMMANDS,
    const SAFE_VALUES: usize = MAX_SAFE_VALUES,
    const EXCHANGES: usize = MAX_EXCHANGES,
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
    /// The values that inputs take if their port times out; ports refer to ranges of it.
    pub safe_values: Vec<SafeValue, SAFE_VALUES>,
    /// The exchanges of all recipes; recipes refer to ranges of it.
    pub exchanges: Vec<Exchange, EXCHANGES>,
    /// The frames of exchanges, which refer to them; Modbus has none.
    pub frames: Vec<FrameSpec, EXCHANGES>,
}

impl<
    const PORTS: usize,
    const RECIPES: usize,
    const ALL_FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
    const EXCHANGES: usize,
> GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>
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
            exchanges: Vec::new(),
            frames: Vec::new(),
        }
    }

    /// A view whose type is the same for every size; engine, checks and image use it.
    pub fn view(&self) -> ConfigView<'_> {
        ConfigView {
            controller: &self.controller,
            network: self.network.fixed(),
            recipes: &self.recipes,
            ports: &self.ports,
            fields: &self.fields,
            commands: &self.commands,
            safe_values: &self.safe_values,
            exchanges: &self.exchanges,
            frames: &self.frames,
        }
    }

    /// A mutable view whose type is the same for every size.
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
            exchanges: self.exchanges.as_mut_view(),
            frames: self.frames.as_mut_view(),
        }
    }

    /// Checks everything that can be checked without the controller.
    ///
    /// # Errors
    /// The first error, with its place and numbers.
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
    const EXCHANGES: usize,
> Default for GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>
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
    const EXCHANGES: usize,
> From<&'c GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>> for ConfigView<'c>
{
    fn from(config: &'c GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>) -> Self {
        config.view()
    }
}

/// The controller's address, ports, dialect and recipe link.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct ControllerLink {
    /// Address or host name; empty on a board that learns it in another way.
    pub address: String<MAX_ADDRESS>,
    /// Name of the dialect (see [`crate::wire::dialect`]).
    pub dialect: String<16>,
    /// Command port, normally 2000.
    pub command_port: u16,
    /// State port, normally 2001.
    pub state_port: u16,
    /// Modbus port, normally 502.
    pub modbus_port: u16,
    /// The controller's UDP recipe server, if it is set to one of our recipes.
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

    /// Sets the dialect and its Modbus port.
    pub fn set_dialect(&mut self, dialect: Dialect) {
        self.modbus_port = dialect.modbus_port;
        // All dialects' names fit.
        self.dialect = String::try_from(dialect.name).unwrap_or_default();
    }
}

impl Default for ControllerLink {
    /// The defaults of a file with only an address: dialect v2.3, ports 2000, 2001 and 502, no recipe link.
    fn default() -> Self {
        let mut link = Self { command_port: 2000, state_port: 2001, ..Self::none() };
        link.set_dialect(Dialect::V2_3);
        link
    }
}

/// The controller's own recipe port, used as the fast route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RecipeLink {
    /// UDP port on the controller, normally 2011.
    pub udp_port: u16,
    /// Index into [`GatewayConfig::recipes`].
    pub recipe: u8,
}

#[cfg(test)]
mod tests;
