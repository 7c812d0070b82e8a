//! A borrowed view of a configuration of any size.
//!
//! In: a [`GatewayConfig`](super::GatewayConfig) of any size, or slices of a program's own. Out: borrowed slices, and
//! queries across them.

use heapless::VecView;

use super::network::Network;
use super::{CommandEntry, ControllerLink, Exchange, FieldSpec, FrameSpec, Port, Recipe, SafeValue};

/// A configuration of any size, borrowed; [`GatewayConfig`](super::GatewayConfig) describes the fields.
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
    /// The values that inputs take if their port times out; ports refer to ranges of it.
    pub safe_values: &'c [SafeValue],
    /// The exchanges of all recipes; recipes refer to ranges of it.
    pub exchanges: &'c [Exchange],
    /// The frames of exchanges.
    pub frames: &'c [FrameSpec],
}

impl<'c> ConfigView<'c> {
    /// A view with only a controller; a program with slices of its own sets the other fields.
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

    /// The recipes on the routes to the controller: that of the recipe link, then those of the listening ports.
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
}

/// A mutable borrow of a configuration of any size; [`GatewayConfig`](super::GatewayConfig) describes the fields.
#[derive(Debug)]
pub(crate) struct ConfigMut<'c> {
    pub(crate) controller: &'c mut ControllerLink,
    #[cfg(feature = "image")]
    pub(crate) network: &'c mut super::BoardAddress,
    pub(crate) recipes: &'c mut VecView<Recipe>,
    pub(crate) ports: &'c mut VecView<Port>,
    pub(crate) fields: &'c mut VecView<FieldSpec>,
    pub(crate) commands: &'c mut VecView<CommandEntry>,
    pub(crate) safe_values: &'c mut VecView<SafeValue>,
    pub(crate) exchanges: &'c mut VecView<Exchange>,
    pub(crate) frames: &'c mut VecView<FrameSpec>,
}

#[cfg(feature = "image")]
impl ConfigMut<'_> {
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
