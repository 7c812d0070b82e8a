//! The health of ports and links that a configuration shows: their places among extra values, and variables.

use super::build::Groups;
use crate::config::{ConfigView, Counted, LinkSource, OutputBinding};
use crate::engine::build_error::{BuildError, one_too_many};
use crate::engine::dispatch::EngineView;
use crate::engine::field::health::{HealthVariable, Of, Shown};
use crate::engine::io::{LinkId, PortId};
use crate::engine::link::state::Kept;
use crate::image::{MAX_EXTRA, MAX_GROUPS};
use crate::time::Instant;
use crate::wire::dialect::Dialect;

impl EngineView<'_> {
    /// Gives values of the state packet and of the health of ports their places among the image's extra values.
    pub(crate) fn assign_extra(&mut self, dialect: &Dialect) -> Result<(), BuildError> {
        let mut used = 0_u8;
        let mut next = || {
            let extra = used;
            used = used.saturating_add(1);
            let has_room = usize::from(extra) < MAX_EXTRA;
            if has_room { Ok(extra) } else { Err(one_too_many(Counted::Sources, MAX_EXTRA)) }
        };
        for index in 0..self.ports.len() {
            let outputs = self.ports.get(index).map_or(0..0, |port| {
                let start = usize::from(port.outputs.start);
                start..start.saturating_add(usize::from(port.outputs.len))
            });
            for binding in self.bindings.outputs.get_mut(outputs).into_iter().flatten() {
                match binding.from {
                    OutputBinding::State { value, .. } => {
                        let Some(state) = self.links.state.first_mut() else { continue };
                        let known = state.kept.iter().find(|kept| kept.value == value).map(|kept| kept.extra);
                        binding.extra = match (known, value.place(dialect)) {
                            (Some(extra), _) => extra,
                            (None, Ok((offset, ty))) => {
                                let extra = next()?;
                                // Cannot fail: there is room for every extra value.
                                let _ = state.kept.push(Kept { value, extra, offset, ty });
                                extra
                            }
                            // Validation has refused it.
                            (None, Err(_)) => continue,
                        };
                        if let Some(port) = self.ports.get_mut(index) {
                            port.sender.sources.insert(state.group);
                            port.sender.shown_extra.set(binding.extra, true);
                        }
                    }
                    OutputBinding::Port { .. } | OutputBinding::Link { .. } => {
                        let of = match binding.from {
                            OutputBinding::Link { link, .. } => Of::Link(id_of(link)),
                            OutputBinding::Port { port, value, .. } => {
                                let of = match port {
                                    Some(id) => self.ports.iter().position(|other| other.id.0 == id),
                                    None => Some(index),
                                };
                                // Validation has refused unknown ports.
                                Of::Port(of.unwrap_or(index) as u8, value)
                            }
                            _ => continue,
                        };
                        let is_it = |shown: &&Shown| shown.of == of;
                        let known = self.health.shown.iter().find(is_it).map(|shown| shown.extra);
                        binding.extra = match known {
                            Some(extra) => extra,
                            None => {
                                let extra = next()?;
                                // Cannot fail: there is room for every extra value.
                                let _ = self.health.shown.push(Shown { of, extra });
                                extra
                            }
                        };
                        if let Some(port) = self.ports.get_mut(index) {
                            port.sender.shows_health = true;
                            // Without a cycle, a frame is made when another one has arrived.
                            let has_cycle = port.sender.next_cycle(Instant::ZERO) != Instant::NEVER;
                            self.store.watches_bits |= !has_cycle;
                        }
                        self.store.check_health_at(Instant::ZERO);
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// Notes the variables that report the health of ports.
    pub(crate) fn assign_health(
        &mut self,
        config: ConfigView<'_>,
        groups: &mut Groups,
    ) -> Result<(), BuildError> {
        for (nth, (_, port, _)) in (0..).zip(config.field_ports()) {
            let recipe = config.recipes.get(usize::from(port.recipe));
            let vars = recipe.into_iter().flat_map(|recipe| config.status_variables(nth, port, recipe));
            for (_, var) in vars {
                if !self.health.is_reported {
                    self.health.is_reported = true;
                    self.health.group = groups.next().ok_or(one_too_many(Counted::Groups, MAX_GROUPS))?;
                    self.store.check_health_at(Instant::ZERO);
                }
                self.store.image.assign(var, self.health.group);
                self.store.health.insert(var);
            }
            for (value, var) in port.health.iter() {
                // Cannot fail: there is room for every value of every port.
                let _ = self.health.variables.push(HealthVariable { port: nth, value, var, last: None });
            }
        }
        Ok(())
    }
}

fn id_of(link: LinkSource) -> LinkId {
    match link {
        LinkSource::Command => LinkId::COMMAND,
        LinkSource::Urgent => LinkId::URGENT,
        LinkSource::State => LinkId::STATE,
        LinkSource::Modbus => LinkId::MODBUS,
        LinkSource::RecipeUdp => LinkId::RECIPE_UDP,
        LinkSource::Listening(port) => LinkId::of_port(PortId(port)),
    }
}
