//! Builds a configuration in one expression.
//!
//! In: controller, recipes, ports, in this order. Out: a checked [`GatewayConfig`], or the first error. For a board
//! with a small stack, `set_controller`, `add_recipe` and `add_port` do the same step by step on a static
//! configuration.

use super::draft::{ControllerBuilder, PortBuilder, PortBus, RecipeBuilder};
use super::error::{ConfigError, ConfigErrorKind as Kind, Counted};
use super::{
    GatewayConfig, MAX_ALL_FIELDS, MAX_COMMANDS, MAX_EXCHANGES, MAX_PORTS, MAX_RECIPES, MAX_SAFE_VALUES,
    Network,
};

/// A configuration under construction: [`GatewayConfig::builder`].
#[derive(Debug, Clone)]
#[must_use = "nothing is made until `build`"]
pub struct ConfigBuilder<
    const PORTS: usize = MAX_PORTS,
    const RECIPES: usize = MAX_RECIPES,
    const ALL_FIELDS: usize = MAX_ALL_FIELDS,
    const COMMANDS: usize = MAX_COMMANDS,
    const SAFE_VALUES: usize = MAX_SAFE_VALUES,
    const EXCHANGES: usize = MAX_EXCHANGES,
> {
    config: GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>,
    error: Option<ConfigError>,
    needed: Needed,
}

/// Number of items added, including those that did not fit.
#[derive(Debug, Clone, Copy, Default)]
struct Needed {
    ports: usize,
    recipes: usize,
    fields: usize,
    commands: usize,
    safe_values: usize,
    exchanges: usize,
    frames: usize,
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
    /// Builds a configuration in one expression; a recipe comes before the ports that use it.
    ///
    /// The builder is moved by value. If the stack is small, use a static [`Self::empty`] with
    /// [`Self::set_controller`], [`Self::add_recipe`], [`Self::add_port`] and [`Self::validate`].
    ///
    /// ```
    /// use proto_core::config::{GatewayConfig, Port, Recipe};
    /// use proto_core::time::Duration;
    ///
    /// // One port, one recipe, 8 fields, no commands, one safe value.
    /// let config: GatewayConfig<1, 1, 8, 0, 1> = GatewayConfig::builder()
    ///     .controller("192.168.12.138")
    ///     .recipe(
    ///         Recipe::realtime("sensor")
    ///             .stream_input(&[0xFF, 0xFF], &[0xEE, 0xEE], &["DigitalOutputCommand[1]"])
    ///             .stream_output(&[0xFF, 0xFF], &[0xFE, 0xFE], &["RobotState[8..13]"]),
    ///     )
    ///     .port(
    ///         Port::rs485("rs485-1", "sensor")
    ///             .baud(460_800)
    ///             .timeout(Duration::from_millis(50))
    ///             .safe(&[("DigitalOutputCommand[1]", 0.0)]),
    ///     )
    ///     .build()?;
    /// assert_eq!(config.fields.len(), 7);
    /// # Ok::<(), proto_core::config::ConfigError>(())
    /// ```
    pub const fn builder() -> ConfigBuilder<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES> {
        let needed =
            Needed { ports: 0, recipes: 0, fields: 0, commands: 0, safe_values: 0, exchanges: 0, frames: 0 };
        ConfigBuilder { config: Self::empty(), error: None, needed }
    }
}

impl<
    const PORTS: usize,
    const RECIPES: usize,
    const ALL_FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
    const EXCHANGES: usize,
> ConfigBuilder<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>
{
    /// The controller: its address, or a [`ControllerBuilder`].
    pub fn controller<'a>(mut self, controller: impl Into<ControllerBuilder<'a>>) -> Self {
        let controller = controller.into();
        self.attempt(|config| config.set_controller(controller));
        self
    }

    /// The board's own address; without it the board uses DHCP.
    pub fn network(mut self, network: Network) -> Self {
        self.config.network = super::BoardAddress::Static(network);
        self
    }

    /// Adds a recipe.
    pub fn recipe(mut self, recipe: RecipeBuilder<'_>) -> Self {
        let counts = recipe.counts();
        self.needed.recipes = self.needed.recipes.saturating_add(1);
        self.needed.fields = self.needed.fields.saturating_add(counts.fields);
        self.needed.commands = self.needed.commands.saturating_add(counts.commands);
        self.needed.exchanges = self.needed.exchanges.saturating_add(counts.exchanges);
        self.needed.frames = self.needed.frames.saturating_add(counts.frames);
        self.attempt(|config| config.add_recipe(&recipe).map(|_| ()));
        self
    }

    /// Adds a port.
    pub fn port<B: PortBus>(mut self, port: PortBuilder<'_, B>) -> Self {
        self.needed.ports = self.needed.ports.saturating_add(1);
        self.needed.safe_values = self.needed.safe_values.saturating_add(port.safe.len());
        self.attempt(|config| config.add_port(&port).map(|_| ()));
        self
    }

    /// Declares that the controller's UDP server at port 2011 is set to this recipe.
    pub fn recipe_link(self, recipe: &str) -> Self {
        self.recipe_link_at(recipe, 2011)
    }

    /// Declares that the controller's UDP server at another port is set to this recipe.
    pub fn recipe_link_at(mut self, recipe: &str, udp_port: u16) -> Self {
        self.attempt(|config| config.set_recipe_link(recipe, udp_port));
        self
    }

    /// Checks the configuration and returns it.
    ///
    /// # Errors
    /// The first error, with its place. If items did not fit, `needed` is the number of all items added.
    pub fn build(
        self,
    ) -> Result<GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>, ConfigError>
    {
        let Some(mut error) = self.error else {
            self.config.validate()?;
            return Ok(self.config);
        };
        if let Kind::TooMany { what, needed, .. } = &mut error.kind {
            *needed = match what {
                Counted::Ports => self.needed.ports,
                Counted::Recipes => self.needed.recipes,
                Counted::Fields => self.needed.fields,
                Counted::Commands => self.needed.commands,
                Counted::SafeValues => self.needed.safe_values,
                Counted::Exchanges => self.needed.exchanges,
                Counted::ExchangeFrames => self.needed.frames,
                // Limits of a single recipe, or of the engine.
                _ => *needed,
            };
        }
        Err(error)
    }

    /// After the first error, items are only counted.
    fn attempt(
        &mut self,
        add: impl FnOnce(
            &mut GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>,
        ) -> Result<(), ConfigError>,
    ) {
        if self.error.is_none() {
            self.error = add(&mut self.config).err();
        }
    }
}
