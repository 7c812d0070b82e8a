//! The health of field ports as values: for output fields, and for variables that tell the robot; and for
//! output fields whether links are up.
//!
//! In: the ports' states and counters, the states of links. Out: extra values of the image just before a frame is made;
//! variables, which go up as those of a field frame do. Does not know how they are written.

use heapless::Vec;

use super::build::Groups;
use super::build_error::{BuildError, one_too_many};
use super::clock::Dirty;
use super::field_port::FieldPort;
use super::io::{LinkId, PortId, PortState};
use super::line::PeerState;
use super::state_link::Kept;
use super::store::InputFrame;
use super::user::wrapping_count;
use super::view::EngineView;
use crate::config::{ConfigView, Counted, LinkSource, MAX_PORTS, OutputBinding, PortValue};
use crate::image::{GroupId, InputSet, MAX_EXTRA, MAX_GROUPS, saturate_to_field};
use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

/// What the robot is told is checked this often; [`PortValue::Alive`] is also told at once when it
/// becomes 0.
const CHECK_EVERY: Duration = Duration::from_millis(100);
/// Unchanged values are told again this often: an unanswered write, another master or a restarted
/// controller may have undone them.
const REPEAT_EVERY: Duration = Duration::from_secs(1);

/// Each value of each port.
const MOST: usize = MAX_PORTS * PortValue::NAMES.len();

/// A value that an output field shows.
#[derive(Debug, Clone, Copy)]
struct Shown {
    of: Of,
    /// Its place among the image's extra values.
    extra: u8,
}

/// What it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of {
    /// The health of the port with this index in the engine.
    Port(u8, PortValue),
    /// Whether the link is up.
    Link(LinkId),
}

/// A variable that shows the robot the health of a port.
#[derive(Debug, Clone, Copy)]
struct HealthVariable {
    port: u8,
    value: PortValue,
    var: SysVar,
    /// What it was when the variable was last set.
    last: Option<u32>,
}

/// What is shown to devices and to the robot of the ports' health.
#[derive(Debug, Clone)]
pub(super) struct PortsHealth {
    shown: Vec<Shown, MAX_EXTRA>,
    variables: Vec<HealthVariable, MOST>,
    /// Whether anything is reported to the robot: health, or what became of events.
    is_reported: bool,
    /// The group of the variables.
    group: GroupId,
    report_at: Instant,
    repeat_at: Instant,
}

impl PortsHealth {
    pub(super) const fn new() -> Self {
        let (report_at, repeat_at) = (Instant::ZERO, Instant::ZERO);
        Self {
            shown: Vec::new(),
            variables: Vec::new(),
            is_reported: false,
            group: GroupId(0),
            report_at,
            repeat_at,
        }
    }

    pub(super) fn clear(&mut self) {
        self.shown.clear();
        self.variables.clear();
        self.is_reported = false;
        self.group = GroupId(0);
        self.report_at = Instant::ZERO;
        self.repeat_at = Instant::ZERO;
    }

    /// Index of the port whose health the variable shows.
    pub(super) fn owner(&self, var: SysVar) -> Option<u8> {
        self.variables.iter().find(|own| own.var == var).map(|own| own.port)
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

/// The value of a variable that shows a port's health.
fn scalar_of(var: SysVar, value: PortValue, number: u32) -> Scalar {
    if value.is_count() {
        wrapping_count(var.ty(), number)
    } else {
        saturate_to_field(var.ty(), f64::from(number), 1.0, 0.0)
    }
}

/// Health of the port with this index in the engine.
pub(super) fn state_of(
    index: usize,
    port: &FieldPort,
    frames: &[InputFrame],
    peers: &[PeerState],
) -> PortState {
    let mut own = frames.iter().filter(|frame| usize::from(frame.port) == index);
    let peers = port.line().map_or(&[][..], |line| line.peers.of(peers));
    port.state(own.any(InputFrame::is_overdue) || peers.iter().any(PeerState::is_down))
}

impl EngineView<'_> {
    /// Gives values of the state packet and of the health of ports their places among the image's
    /// extra values.
    #[inline(never)]
    pub(super) fn assign_extra(&mut self, dialect: &Dialect) -> Result<(), BuildError> {
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
                                // As many places as there are extra values.
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
                                // Validation has refused other ports.
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
                                // As many places as there are extra values.
                                let _ = self.health.shown.push(Shown { of, extra });
                                extra
                            }
                        };
                        if let Some(port) = self.ports.get_mut(index) {
                            port.sender.shows_health = true;
                            // Without a cycle, a frame is made when another one has come.
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

    /// Notes the variables that tell the health of ports.
    pub(super) fn assign_health(
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
                // There is room for every value of every port.
                let _ = self.health.variables.push(HealthVariable { port: nth, value, var, last: None });
            }
        }
        Ok(())
    }

    fn health_of(&self, index: u8, value: PortValue, now: Instant) -> u32 {
        let Some(port) = self.ports.get(usize::from(index)) else { return 0 };
        match value {
            PortValue::Alive => {
                let state = state_of(usize::from(index), port, &self.store.frames, self.exchanges.peers);
                u32::from(state == PortState::Working)
            }
            PortValue::Frames => port.counters.frames_in,
            PortValue::Rejected => port.counters.rejected(),
            PortValue::Ignored => port.counters.ignored,
            PortValue::Age => {
                let own = (0..).zip(&self.store.frames).filter(|(_, frame)| frame.port == index);
                let heard_at = own.filter_map(|(group, _)| self.store.image.stamp_of(GroupId(group))).max();
                heard_at.map_or(u32::MAX, |at| {
                    u32::try_from(now.saturating_since(at).as_millis()).unwrap_or(u32::MAX)
                })
            }
        }
    }

    /// Sets the extra values that output fields show of the ports' health, and of links.
    #[cold]
    #[inline(never)]
    pub(super) fn show_health(&mut self, now: Instant) {
        for nth in 0..self.health.shown.len() {
            let Some(&Shown { of, extra }) = self.health.shown.get(nth) else { break };
            let number = match of {
                Of::Port(port, value) => self.health_of(port, value, now),
                Of::Link(link) => u32::from(self.links.view().is_up(link)),
            };
            self.store.image.receive_extra(extra, f64::from(number));
        }
    }

    /// Tells the robot what has changed and shows the field the present, just before the cycles of
    /// the ports that show it.
    #[cold]
    #[inline(never)]
    pub(super) fn check_health(&mut self, now: Instant) {
        if self.health.is_reported && now >= self.health.report_at {
            self.tell_changes(now);
            self.health.report_at = now + CHECK_EVERY;
        }
        self.show_health(now);
        let shows = self.ports.iter().filter(|port| port.sender.shows_health);
        let next = shows.map(|port| port.sender.next_cycle(now)).min().unwrap_or(Instant::NEVER);
        let report_at = if self.health.is_reported { self.health.report_at } else { Instant::NEVER };
        self.store.check_health_at(next.min(report_at));
    }

    /// Tells the robot what has changed, and now and then everything.
    fn tell_changes(&mut self, now: Instant) {
        let repeats = now >= self.health.repeat_at;
        if repeats {
            self.health.repeat_at = now + REPEAT_EVERY;
        }
        self.tell_health(|_| true, repeats, now);
        if self.exchanges.is_used() {
            self.tell_outcomes(repeats);
        }
        self.store.image.stamp(self.health.group, now);
    }

    /// Tells the robot at once whether ports work.
    #[cold]
    #[inline(never)]
    pub(super) fn tell_alive(&mut self, now: Instant) {
        self.tell_health(|value| value == PortValue::Alive, false, now);
    }

    fn tell_health(&mut self, is_asked: impl Fn(PortValue) -> bool, repeats: bool, now: Instant) {
        let mut news = InputSet::EMPTY;
        for nth in 0..self.health.variables.len() {
            let Some(&HealthVariable { port, value, var, last }) = self.health.variables.get(nth) else {
                break;
            };
            if !is_asked(value) {
                continue;
            }
            let number = self.health_of(port, value, now);
            if last == Some(number) && !repeats {
                continue;
            }
            // The value has the variable's type.
            let _ = self.store.image.set(var, scalar_of(var, value, number));
            news.insert(var);
            if let Some(own) = self.health.variables.get_mut(nth) {
                own.last = Some(number);
            }
        }
        if !news.is_empty() {
            self.store.tell(&news);
            self.clock.dirty.add(Dirty::LINKS);
        }
    }
}
