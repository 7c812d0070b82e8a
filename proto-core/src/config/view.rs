//! A borrowed view of a configuration of any size.
//!
//! In: a [`GatewayConfig`](super::GatewayConfig) of any parameters, or slices of a program's own. Out:
//! borrowed slices, and the questions that concern several of them.

use heapless::VecView;

use super::error::{ExchangeKey, Place, PortKey};
use super::network::Network;
use super::walk::{FrameFieldIter, FrameVariables, Variables};
use super::{
    CommandEntry, ControllerLink, Exchange, FieldSpec, FrameSpec, OutputBinding, Port, Recipe, SafeValue,
};
use crate::sysvar::{Direction, SysVar, VarBit};

/// A configuration of any size, borrowed; [`GatewayConfig`](super::GatewayConfig) describes the
/// fields.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ConfigView<'c> {
    /// The controller's address, ports and dialect.
    pub controller: &'c ControllerLink,
    /// The board's own address; `None` means DHCP.
    pub network: Option<&'c Network>,
    /// Every recipe.
    pub recipes: &'c [Recipe],
    /// Every port.
    pub ports: &'c [Port],
    /// The fields of all recipes; parts refer to ranges of it.
    pub fields: &'c [FieldSpec],
    /// The entries of all command tables; bindings refer to ranges of it.
    pub commands: &'c [CommandEntry],
    /// The values that inputs take when their port times out; ports refer to ranges of it.
    pub safe_values: &'c [SafeValue],
    /// The exchanges of all recipes; recipes refer to ranges of it.
    pub exchanges: &'c [Exchange],
    /// The frames of exchanges.
    pub frames: &'c [FrameSpec],
}

impl<'c> ConfigView<'c> {
    /// A view with a controller and nothing else; a program that keeps its own slices sets the
    /// other fields.
    pub const fn new(controller: &'c ControllerLink) -> Self {
        Self {
            controller,
            network: None,
            recipes: &[],
            ports: &[],
            fields: &[],
            commands: &[],
            safe_values: &[],
            exchanges: &[],
            frames: &[],
        }
    }

    /// The recipes on the ways up: that of the recipe link, then those of the listening ports.
    pub(crate) fn upstream_recipes(self) -> impl Iterator<Item = (u8, &'c Recipe)> {
        let link = self.controller.recipe_link.map(|link| link.recipe);
        let ports = self.ports.iter().filter(|port| !port.bus.is_field()).map(|port| port.recipe);
        link.into_iter().chain(ports).filter_map(|index| Some((index, self.recipes.get(usize::from(index))?)))
    }

    /// The field ports, each with its index and recipe.
    pub fn field_ports(self) -> impl Iterator<Item = (u8, &'c Port, &'c Recipe)> {
        (0..)
            .zip(self.ports)
            .filter(|(_, port)| port.bus.is_field())
            .filter_map(|(index, port)| Some((index, port, self.recipes.get(usize::from(port.recipe))?)))
    }

    /// The fields of one part of `recipe`, with the number of the frame (see
    /// `frames_of`) and the index of the field in it.
    pub fn fields_of(
        self,
        recipe: &'c Recipe,
        part: Direction,
    ) -> impl Iterator<Item = (u8, u8, &'c FieldSpec)> {
        self.frame_fields(recipe, part)
    }

    fn frame_fields(self, recipe: &'c Recipe, part: Direction) -> FrameFieldIter<'c> {
        let frames = self.frames_of(recipe, part);
        FrameFieldIter { frames, pool: self.fields, fields: [].iter(), frame: 0, count: 0 }
    }

    /// The input variables that a field port writes as a whole.
    pub fn written_by(self, recipe: &'c Recipe) -> impl Iterator<Item = SysVar> + 'c {
        let fields = self.frame_fields(recipe, Direction::Input);
        FrameVariables { fields, variables: Variables::NONE }
    }

    /// Whether a field of one part of `recipe` is bound to the variable.
    pub(crate) fn carries(self, recipe: &'c Recipe, part: Direction, var: SysVar) -> bool {
        let mut frames = self.frames_of(recipe, part);
        frames.any(|(_, span)| span.of(self.fields).iter().any(|field| field.is_bound_to(var)))
    }

    /// The input variables that a field port owns: those that its frames write, and those of its
    /// health.
    pub fn owned_by(self, port: &'c Port, recipe: &'c Recipe) -> impl Iterator<Item = SysVar> + 'c {
        self.written_by(recipe).chain(self.status_variables(0, port, recipe).map(|(_, var)| var))
    }

    /// The input variables that tell the robot something about the port with this index: its health, and what became of
    /// events. Each with its place.
    pub(crate) fn status_variables(
        self,
        index: u8,
        port: &'c Port,
        recipe: &'c Recipe,
    ) -> impl Iterator<Item = (Place, SysVar)> + 'c {
        let health = Place::Port { port: index, key: PortKey::Health };
        let outcomes = (0..).zip(self.exchanges_of(recipe)).flat_map(move |(exchange, of)| {
            let place = Place::Exchange { recipe: port.recipe, exchange, key: ExchangeKey::Outcome };
            of.outcome.variables().map(move |var| (place, var))
        });
        port.health.iter().map(move |(_, var)| (health, var)).chain(outcomes)
    }

    /// Whether the output part of a field port shows a value of the controller's state packet.
    pub(crate) fn shows_state(self) -> bool {
        let shows = |field: &FieldSpec| matches!(field.source(), Some(OutputBinding::State { .. }));
        self.field_ports()
            .any(|(_, _, recipe)| self.fields_of(recipe, Direction::Output).any(|(_, _, field)| shows(field)))
    }

    /// The bits that a field port writes one by one.
    pub fn bits_written_by(self, recipe: &'c Recipe) -> impl Iterator<Item = VarBit> + 'c {
        self.fields_of(recipe, Direction::Input).filter_map(|(_, _, field)| field.bit())
    }

    /// Whether a field port writes the variable.
    pub(super) fn is_owned(self, var: SysVar) -> bool {
        self.field_ports().any(|(_, port, recipe)| {
            self.carries(recipe, Direction::Input, var)
                || self.status_variables(0, port, recipe).any(|(_, own)| own == var)
        })
    }
}

/// A mutable borrow of a configuration of any size; [`GatewayConfig`](super::GatewayConfig) describes the fields.
#[derive(Debug)]
pub(crate) struct ConfigMut<'c> {
    /// The controller's address, ports and dialect.
    pub(crate) controller: &'c mut ControllerLink,
    /// The board's own address.
    #[cfg(feature = "image")]
    pub(crate) network: &'c mut super::BoardAddress,
    /// Every recipe.
    pub(crate) recipes: &'c mut VecView<Recipe>,
    /// Every port.
    pub(crate) ports: &'c mut VecView<Port>,
    /// The fields of all recipes.
    pub(crate) fields: &'c mut VecView<FieldSpec>,
    /// The entries of all command tables.
    pub(crate) commands: &'c mut VecView<CommandEntry>,
    /// The safe values of all ports.
    pub(crate) safe_values: &'c mut VecView<SafeValue>,
    /// The exchanges of all recipes.
    pub(crate) exchanges: &'c mut VecView<Exchange>,
    /// The frames of exchanges.
    pub(crate) frames: &'c mut VecView<FrameSpec>,
}

#[cfg(feature = "image")]
impl ConfigMut<'_> {
    /// A read-only view of the configuration.
    pub(crate) fn view(&self) -> ConfigView<'_> {
        ConfigView {
            controller: self.controller,
            network: self.network.fixed(),
            recipes: self.recipes,
            ports: self.ports,
            fields: self.fields,
            commands: self.commands,
            safe_values: self.safe_values,
            exchanges: self.exchanges,
            frames: self.frames,
        }
    }
}
