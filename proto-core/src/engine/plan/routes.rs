//! The plan: the route of each variable (docs/engine.md section 4).
//!
//! In: a configuration. Out: the owner and route of every input variable, and the source of every variable that a port
//! shows. Decided once; it does not change while the engine runs.

use crate::engine::build_error::PlanError;

use crate::config::{ConfigView, FieldSpec, Recipe, SendOn};
use crate::engine::io::{LinkId, PortId};
use crate::image::InputSet;
use crate::sysvar::{BIT_INPUT_COUNT, COUNT, Direction, INPUT_COUNT, ModbusPlace, SysVar, VarBit};

/// How an input variable reaches the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Route {
    /// In frames of a recipe link.
    Recipe(LinkId),
    /// By Modbus writes.
    Modbus,
}

/// The source of a variable that a port shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// Frames of a recipe link, one each cycle.
    Recipe(LinkId),
    /// Modbus polls.
    Modbus,
    /// The 10 Hz state stream.
    State,
    /// An input variable as its owner last sent it.
    Field(PortId),
}

/// Owner, route and source of every variable.
#[derive(Debug, Clone)]
pub struct Plan {
    owners: [Option<PortId>; INPUT_COUNT],
    ways: [Option<Route>; INPUT_COUNT],
    sources: [Option<Source>; COUNT],
    read_back: InputSet,
    /// The owners of single bits of byte variables.
    bit_owners: [[Option<PortId>; 8]; BIT_INPUT_COUNT],
    shows_state: bool,
}

impl Plan {
    /// Makes the plan of a configuration.
    ///
    /// # Errors
    /// [`PlanError`] names the first variable without a route, source or single owner.
    pub fn new<'c>(config: impl Into<ConfigView<'c>>) -> Result<Self, PlanError> {
        Self::of(config.into())
    }

    fn of(config: ConfigView<'_>) -> Result<Self, PlanError> {
        let mut plan = Self {
            owners: [None; INPUT_COUNT],
            ways: [None; INPUT_COUNT],
            sources: [None; COUNT],
            read_back: InputSet::EMPTY,
            bit_owners: [[None; 8]; BIT_INPUT_COUNT],
            shows_state: config.shows_state(),
        };
        for (id, port, recipe) in config.field_ports() {
            for var in config.owned_by(port, recipe) {
                plan.claim(config, var, PortId(id))?;
            }
        }
        for (port, recipe) in field_ports(config) {
            for bit in config.bits_written_by(recipe) {
                plan.claim_bit(config, bit, port)?;
            }
        }
        for (port, recipe) in field_ports(config) {
            for var in shown_by(config, recipe) {
                let source = plan.find_source(config, var).ok_or(PlanError::NoSource { var, port })?;
                if let Some(slot) = plan.sources.get_mut(var.ordinal()) {
                    *slot = Some(source);
                }
            }
        }
        for (link, recipe) in uplinks(config) {
            if is_one_frame(config, recipe) {
                continue;
            }
            for var in inputs_of(config, recipe) {
                if var.stream().is_some() {
                    plan.read_back.insert(var);
                } else if plan.owner(var).is_none() {
                    return Err(PlanError::NobodySends { var, link });
                }
            }
        }
        Ok(plan)
    }

    /// The field port that owns a bit, on its own or with the whole variable.
    pub fn bit_owner(&self, bit: VarBit) -> Option<PortId> {
        let bits = self.bit_owners.get(bit.var.ordinal());
        let owner = bits.and_then(|bits| bits.get(usize::from(bit.bit)).copied().flatten());
        owner.or_else(|| self.owner(bit.var))
    }

    /// The field ports that own the variable or its bits, once for each bit.
    pub(crate) fn owners(&self, var: SysVar) -> impl Iterator<Item = PortId> + '_ {
        let bits = self.bit_owners.get(var.ordinal()).into_iter().flatten();
        self.owner(var).into_iter().chain(bits.filter_map(|owner| *owner))
    }

    /// The field port that owns the variable as a whole: its frames contain it.
    pub fn owner(&self, var: SysVar) -> Option<PortId> {
        self.owners.get(var.ordinal()).copied().flatten()
    }

    /// The route of an input variable that has an owner, or bits with owners.
    pub fn route(&self, var: SysVar) -> Option<Route> {
        self.ways.get(var.ordinal()).copied().flatten()
    }

    /// The source of a variable that a port shows.
    pub fn source(&self, var: SysVar) -> Option<Source> {
        self.sources.get(var.ordinal()).copied().flatten()
    }

    /// Input variables that share a recipe link's frame. Their present values are read back from the state stream as
    /// long as no port sends them.
    pub(crate) fn read_back(&self) -> InputSet {
        self.read_back
    }

    /// Whether the stream of port 2001 is needed.
    pub(crate) fn needs_state(&self) -> bool {
        self.shows_state || !self.read_back.is_empty() || self.sources.contains(&Some(Source::State))
    }

    pub(crate) fn needs_modbus(&self) -> bool {
        self.ways.contains(&Some(Route::Modbus)) || self.sources.contains(&Some(Source::Modbus))
    }

    fn claim(&mut self, config: ConfigView<'_>, var: SysVar, port: PortId) -> Result<(), PlanError> {
        let Some(owner) = self.owners.get_mut(var.ordinal()) else { return Ok(()) };
        match *owner {
            Some(first) if first != port => return Err(PlanError::TwoOwners { var, first, second: port }),
            _ => *owner = Some(port),
        }
        self.find_route(config, var, port)
    }

    fn claim_bit(&mut self, config: ConfigView<'_>, bit: VarBit, port: PortId) -> Result<(), PlanError> {
        if let Some(whole) = self.owner(bit.var) {
            return Err(PlanError::OwnedAndShared { bit, whole, part: port });
        }
        let owner = self.bit_owners.get_mut(bit.var.ordinal());
        let Some(owner) = owner.and_then(|bits| bits.get_mut(usize::from(bit.bit))) else { return Ok(()) };
        match *owner {
            Some(first) if first != port => {
                return Err(PlanError::TwoBitOwners { bit, first, second: port });
            }
            _ => *owner = Some(port),
        }
        self.find_route(config, bit.var, port)
    }

    fn find_route(&mut self, config: ConfigView<'_>, var: SysVar, port: PortId) -> Result<(), PlanError> {
        let way = uplinks(config)
            .find(|&(_, recipe)| config.carries(recipe, Direction::Input, var))
            .map(|(link, _)| Route::Recipe(link))
            .or_else(|| is_exact_modbus(var).then_some(Route::Modbus))
            .ok_or(PlanError::NoRoute { var, port })?;
        if let Some(slot) = self.ways.get_mut(var.ordinal()) {
            *slot = Some(way);
        }
        Ok(())
    }

    fn find_source(&self, config: ConfigView<'_>, var: SysVar) -> Option<Source> {
        if var.direction() == Direction::Input
            && let Some(owner) = self.owner(var)
        {
            return Some(Source::Field(owner));
        }
        uplinks(config)
            .find(|&(_, recipe)| config.carries(recipe, Direction::Output, var))
            .map(|(link, _)| Source::Recipe(link))
            .or_else(|| is_exact_modbus(var).then_some(Source::Modbus))
            .or_else(|| var.stream().map(|_| Source::State))
    }
}

/// Whether Modbus carries the variable without loss: bits and words, not scaled floats.
fn is_exact_modbus(var: SysVar) -> bool {
    matches!(var.modbus(), Some(ModbusPlace::Coils { .. } | ModbusPlace::Register { .. }))
}

/// The recipe links in order of preference, each with its recipe.
pub(crate) fn uplinks<'c>(config: ConfigView<'c>) -> impl Iterator<Item = (LinkId, &'c Recipe)> {
    let own = config.controller.recipe_link.map(|link| (LinkId::RECIPE_UDP, link.recipe));
    let listening = (0..)
        .zip(config.ports)
        .filter(|(_, port)| !port.bus.is_field())
        .map(|(id, port)| (LinkId::of_port(PortId(id)), port.recipe));
    own.into_iter()
        .chain(listening)
        .filter_map(|(link, recipe)| Some((link, config.recipes.get(usize::from(recipe))?)))
}

fn field_ports<'c>(config: ConfigView<'c>) -> impl Iterator<Item = (PortId, &'c Recipe)> {
    config.field_ports().map(|(port, _, recipe)| (PortId(port), recipe))
}

fn inputs_of<'a>(config: ConfigView<'a>, recipe: &'a Recipe) -> impl Iterator<Item = SysVar> + 'a {
    config.written_by(recipe)
}

/// Whether a recipe link's frame has exactly the variables of one field frame, all with safe values or none. Then all
/// of them are known whenever one is written.
fn is_one_frame(config: ConfigView<'_>, link: &Recipe) -> bool {
    config.field_ports().any(|(_, port, recipe)| {
        config.frames_of(recipe, Direction::Input).any(|(_, fields)| {
            let fields = fields.of(config.fields);
            let brings = |var| fields.iter().any(|field| field.is_bound_to(var));
            let safe = |var| port.on_timeout.of(config.safe_values).iter().any(|safe| safe.var == var);
            let mut vars = inputs_of(config, link).peekable();
            let first_is_safe = vars.peek().is_some_and(|&var| safe(var));
            vars.all(|var| brings(var) && safe(var) == first_is_safe)
        })
    })
}

/// The variables that a recipe's output part shows, and the one whose bit triggers it. Those of exchanges are checked
/// when their requests are made.
pub(crate) fn sent_by<'a>(config: ConfigView<'a>, recipe: &'a Recipe) -> impl Iterator<Item = SysVar> + 'a {
    let trigger = match recipe.send {
        SendOn::Rising { var, .. } => Some(var),
        _ => None,
    };
    let fields = recipe.part_frames(Direction::Output).flat_map(move |span| span.of(config.fields));
    fields.flat_map(FieldSpec::variables).chain(trigger)
}

/// The variables that a recipe's outputs and requests show, and those whose bits trigger them.
pub(crate) fn shown_by<'a>(config: ConfigView<'a>, recipe: &'a Recipe) -> impl Iterator<Item = SysVar> + 'a {
    let exchanges = config.exchanges_of(recipe).iter();
    let requests =
        exchanges.clone().filter_map(move |exchange| exchange.fields(config.frames, Direction::Output));
    let fields = requests.flat_map(move |span| span.of(config.fields)).flat_map(FieldSpec::variables);
    let asks = exchanges.filter_map(|exchange| Some(exchange.when.rising?.0));
    sent_by(config, recipe).chain(fields).chain(asks)
}
