//! Faults for tests, and operations at the teach pendant (docs/simulated-controller.md section 6).
//!
//! All are methods of [`Controller`]; clients cannot cause them.

use proto_core::modbus::Exception;
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::{LEN, OperationMode};

use super::build::{mode, start_values};
use super::common::Link;
use super::corrupted::{Corrupted, NoSuchFloat};
use super::events::Happened;
use super::machine::{Machine, SafetyHold};
use super::random::Random;
use super::registers::SetError;
use super::{Controller, ControllerOutput, RecipeError};
pub use recipe_config::CommandClients;
use recipe_config::InitialTarget;

#[derive(Debug, Clone, Default)]
pub(super) struct Faults {
    muted: [bool; 3],
    refused: [bool; 3],
    command_clients: CommandClients,
    delay: [Duration; 3],
    muted_ports: Vec<usize>,
    exception: Option<Exception>,
    state_cut: Option<usize>,
    garbage: [bool; 3],
    /// The packet that is repeated; `Some(None)` until the first packet.
    frozen: Option<Option<Box<[u8; LEN]>>>,
    random: Random,
    /// Additional time of transitions begun by commands.
    transitions: Duration,
    corrupted: Corrupted,
}

impl Faults {
    /// The faults of the configuration only.
    pub(super) fn new(command_clients: CommandClients) -> Self {
        Self { command_clients, ..Self::default() }
    }

    pub(super) fn command_clients(&self) -> CommandClients {
        self.command_clients
    }

    pub(super) fn mutes(&self, link: Link) -> bool {
        self.muted[link as usize]
    }

    pub(super) fn refuses(&self, link: Link) -> bool {
        self.refused[link as usize]
    }

    pub(super) fn delay(&self, link: Link) -> Duration {
        self.delay[link as usize]
    }

    pub(super) fn mutes_port(&self, port: usize) -> bool {
        self.muted_ports.contains(&port)
    }

    pub(super) fn exception(&self) -> Option<Exception> {
        self.exception
    }

    pub(super) fn corrupted(&self) -> &Corrupted {
        &self.corrupted
    }

    pub(super) fn is_garbage(&self, link: Link) -> bool {
        self.garbage[link as usize]
    }

    pub(super) fn set_garbage(&mut self, link: Link, on: bool) {
        self.garbage[link as usize] = on;
    }

    /// Replaces sent data by random bytes, if the fault is set.
    pub(super) fn corrupt_bytes(&mut self, link: Link, bytes: &mut [u8]) {
        if self.is_garbage(link) {
            self.random.fill(bytes);
        }
    }

    pub(super) fn is_frozen(&self) -> bool {
        self.frozen.is_some()
    }

    pub(super) fn freeze(&mut self, on: bool) {
        self.frozen = on.then_some(None);
    }

    pub(super) fn freeze_packet(&mut self, packet: &mut Box<[u8; LEN]>) {
        if let Some(frozen) = &mut self.frozen {
            packet.clone_from(frozen.get_or_insert_with(|| packet.clone()));
        }
    }

    pub(super) fn transitions(&self) -> Duration {
        self.transitions
    }

    pub(super) fn heal_server(&mut self, link: Link) {
        let nth = link as usize;
        (self.muted[nth], self.refused[nth], self.garbage[nth]) = (false, false, false);
        self.delay[nth] = Duration::ZERO;
        match link {
            Link::State => (self.frozen, self.state_cut) = (None, None),
            Link::Modbus => self.exception = None,
            Link::Command => {}
        }
    }

    pub(super) fn heal_all(&mut self) {
        let (command_clients, random) = (self.command_clients, self.random.clone());
        *self = Self { random, ..Self::new(command_clients) };
    }

    pub(super) fn seed(&mut self, seed: u64) {
        self.random = Random::seeded(seed);
    }

    pub(super) fn take_state_cut(&mut self) -> Option<usize> {
        self.state_cut.take()
    }
}

/// Faults of the connection to the controller.
impl Controller {
    /// Drops all answers of the server from now on; requests are still executed.
    pub fn mute(&mut self, link: Link) {
        self.quiet.ends();
        self.faults.muted[link as usize] = true;
    }

    /// Ends [`Self::mute`].
    pub fn unmute(&mut self, link: Link) {
        self.quiet.ends();
        self.faults.muted[link as usize] = false;
    }

    /// Closes every new connection of the server at once from now on.
    pub fn refuse(&mut self, link: Link) {
        self.quiet.ends();
        self.faults.refused[link as usize] = true;
    }

    /// Ends [`Self::refuse`].
    pub fn accept(&mut self, link: Link) {
        self.quiet.ends();
        self.faults.refused[link as usize] = false;
    }

    /// Sets how many clients port 2000 accepts. Connected clients stay until the next one connects.
    pub fn command_clients(&mut self, clients: CommandClients) {
        self.quiet.ends();
        self.faults.command_clients = clients;
    }

    /// Closes all connections of the server.
    pub fn disconnect(&mut self, link: Link) {
        self.quiet.ends();
        self.close_clients(link);
    }

    /// Delays every answer of the server from now on. Without effect on the state stream, which has no answers.
    pub fn delay_answers(&mut self, link: Link, delay: Duration) {
        self.quiet.ends();
        self.faults.delay[link as usize] = delay;
    }

    /// Makes the transitions of `poweron`, `poweroff`, `enable`, `disable`, `stop` and `pause` longer by `by`
    /// from now on.
    pub fn delay_transitions(&mut self, by: Duration) {
        self.quiet.ends();
        self.faults.transitions = by;
        self.machine.delay_transitions(by);
    }

    /// Answers every Modbus request with this exception without executing it; `None` ends this.
    pub fn answer_modbus_with(&mut self, exception: Option<Exception>) {
        self.quiet.ends();
        self.faults.exception = exception;
    }

    /// Sends only the first `len` bytes of the next state packet, then closes every connection of port 2001.
    pub fn cut_next_state_packet(&mut self, len: usize) {
        self.quiet.ends();
        self.faults.state_cut = Some(len);
    }

    /// Sends `instead`, such as NaN, in place of the item's value in state packets and in frames of recipes'
    /// output parts. Modbus and programs still see the value.
    ///
    /// An item is a system variable such as `RobotState[8]`, an analog input such as `AI_V[1]`, or any
    /// other float of the state packet, such as `joint_torque[1]` (proto-core/docs/wire/state.md section 2).
    ///
    /// # Errors
    /// [`NoSuchFloat`] if there is no such item; nothing changed.
    pub fn corrupt(&mut self, name: &str, instead: f32) -> Result<(), NoSuchFloat> {
        self.quiet.ends();
        self.faults.corrupted.corrupt(name, instead)
    }

    /// Ends [`Self::corrupt`] for the item.
    ///
    /// # Errors
    /// [`NoSuchFloat`] if there is no such item.
    pub fn heal(&mut self, name: &str) -> Result<(), NoSuchFloat> {
        self.quiet.ends();
        self.faults.corrupted.heal(name)
    }

    /// Drops everything that the port sends from now on. `port` is its index in the configuration.
    pub fn mute_port(&mut self, port: usize) {
        self.quiet.ends();
        if !self.faults.mutes_port(port) {
            self.faults.muted_ports.push(port);
        }
    }

    /// Ends [`Self::mute_port`].
    pub fn unmute_port(&mut self, port: usize) {
        self.quiet.ends();
        self.faults.muted_ports.retain(|&muted| muted != port);
    }

    /// Closes the connection of a TCP client port. Without effect on other ports.
    pub fn close_port(&mut self, port: usize) {
        self.quiet.ends();
        if let Some(own) = self.ports.get_mut(port).filter(|own| own.is_tcp_client() && own.is_up()) {
            own.went_down();
            self.outputs.push_back(ControllerOutput::PortClose { port });
        }
    }

    /// Switches the controller off and on: all connections are closed, the registers get the configuration's initial
    /// values and otherwise 0, and the robot boots to power off (docs/simulated-controller.md section 1). Faults stay.
    pub fn restart(&mut self, now: Instant) {
        self.quiet.ends();
        self.close_all_clients();
        if let Some(running) = self.running.take() {
            self.runs.ends_by("restart");
            self.run_over(now, running.name(), None);
        }
        self.runs.forget();
        self.variables.clear();
        for port in 0..self.ports.len() {
            self.close_port(port);
        }
        for nth in 0..self.ports.len() {
            let epoch = self.port_epoch(nth, now);
            // A serial line or bus still exists, as does the address of the UDP server.
            if let Some(port) = self.ports.get_mut(nth).filter(|port| port.is_up()) {
                port.went_down();
                port.came_up(now, epoch);
            }
        }
        // The initial values were valid at the start, from the same configuration.
        if let Ok((registers, arm)) = start_values(&self.config) {
            self.registers = registers;
            self.arm = arm;
            self.arm_shown = None;
        }
        self.machine = Machine::booting(now, mode(&self.config));
        self.machine.delay_transitions(self.faults.transitions);
        self.happened(now, || Happened::Started);
    }
}

/// Loss of the registers.
impl Controller {
    /// As [`Self::restart`], but registers and outputs are 0 instead of their initial values. Only wired inputs and the
    /// arm have their initial values.
    pub fn restart_cleared(&mut self, now: Instant) {
        self.quiet.ends();
        self.restart(now);
        self.registers.clear();
    }
}

/// Other versions of the controller's software.
impl Controller {
    /// The name of the dialect in use.
    pub fn dialect(&self) -> &'static str {
        self.dialect.name
    }

    /// Switches to another dialect, as a software update would, and restarts the controller. Without effect
    /// if there is no such dialect.
    pub fn replace_software(&mut self, now: Instant, dialect: &str) {
        self.quiet.ends();
        if let Some(dialect) = Dialect::named(dialect) {
            self.dialect = dialect;
            self.restart(now);
        }
    }
}

/// Events in the cell.
impl Controller {
    /// Sets the value of an input or of any other item.
    ///
    /// # Errors
    /// [`SetError::Value`] if the value is out of range, [`SetError::ShowsState`] if the output shows a state;
    /// nothing changed.
    pub fn force(&mut self, target: InitialTarget, value: f64) -> Result<(), SetError> {
        self.quiet.ends();
        self.registers.force(target, value)?;
        // The tool's frame determines the TCP's position.
        self.arm_shown = None;
        Ok(())
    }

    /// Assigns another recipe to a port, as at the teach pendant. `recipe` is an index into
    /// [`recipe_config::SimConfig::recipes`]; without one the port is idle.
    ///
    /// # Errors
    /// [`RecipeError`] if the port cannot carry the recipe; nothing changed.
    pub fn assign_recipe(
        &mut self,
        now: Instant,
        port: usize,
        recipe: Option<usize>,
    ) -> Result<(), RecipeError> {
        self.quiet.ends();
        let epoch = self.port_epoch(port, now);
        let (Some(own), Some(place)) = (self.ports.get_mut(port), self.config.ports.get_mut(port)) else {
            return Ok(());
        };
        let before = std::mem::replace(&mut place.recipe, recipe);
        let result = own.assign(now, epoch, &self.config, &self.config.ports[port]);
        if result.is_err() {
            self.config.ports[port].recipe = before;
        }
        result
    }

    /// Changes the operation mode, as the key switch does.
    pub fn set_mode(&mut self, mode: OperationMode) {
        self.quiet.ends();
        self.machine.set_mode(mode);
    }

    /// Presses the emergency stop: the program ends, and the robot is disabled.
    pub fn emergency_stop(&mut self, now: Instant) {
        self.quiet.ends();
        self.runs.ends_by("emergency_stop");
        let effect = self.machine.emergency_stop(now);
        self.apply(now, effect);
    }

    /// Causes a protective stop, as an open door does: the program ends, and the robot is disabled.
    pub fn protective_stop(&mut self, now: Instant) {
        self.quiet.ends();
        self.runs.ends_by("protective_stop");
        let effect = self.machine.protective_stop(now);
        self.apply(now, effect);
    }

    /// Makes the arm collide on this axis (proto-core/docs/wire/state.md section 2): the program is paused.
    pub fn collide(&mut self, now: Instant, axis: u8) {
        self.quiet.ends();
        let effect = self.machine.collide(now, axis);
        self.apply(now, effect);
    }

    /// Removes and acknowledges the cause of a stop: the safety state recovers.
    pub fn clear_stop(&mut self, now: Instant) {
        self.quiet.ends();
        self.machine.clear_stop(now);
    }

    /// Lets the safety controller stop working: the program ends, and the robot is disabled.
    pub fn hold_safety(&mut self, now: Instant, hold: SafetyHold) {
        self.quiet.ends();
        self.runs.ends_by("safety");
        let effect = self.machine.hold_safety(now, hold);
        self.apply(now, effect);
    }

    /// Ends [`Self::hold_safety`].
    pub fn release_safety(&mut self) {
        self.quiet.ends();
        self.machine.release_safety();
    }

    /// Reduces the speed, as a person in a safety zone does.
    pub fn enter_reduced(&mut self, now: Instant) {
        self.quiet.ends();
        self.machine.set_reduced(true);
        self.speed_changed(now);
    }

    /// Ends the reduced speed.
    pub fn leave_reduced(&mut self, now: Instant) {
        self.quiet.ends();
        self.machine.set_reduced(false);
        self.speed_changed(now);
    }
}
