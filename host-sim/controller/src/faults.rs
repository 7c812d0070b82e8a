//! What a test, or somebody at the teach pendant, can do to the controller.
//!
//! Plain methods; none of them is reachable from outside the process.

use proto_core::modbus::Exception;
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::OperationMode;

use super::machine::Machine;
use super::registers::SetError;
use super::spoiled::{NoSuchFloat, Spoiled};
use super::{Controller, ControllerOutput, RecipeError, mode, start_values};
pub use recipe_config::CommandClients;
use recipe_config::InitialTarget;

/// One of the controller's TCP servers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// Port 2000.
    Command,
    /// Port 2001.
    State,
    /// Modbus.
    Modbus,
}

/// What is broken at present.
#[derive(Debug, Clone, Default)]
pub(super) struct Faults {
    muted: [bool; 3],
    refused: [bool; 3],
    command_clients: CommandClients,
    delay: [Duration; 3],
    muted_ports: Vec<usize>,
    exception: Option<Exception>,
    state_cut: Option<usize>,
    /// What commands begin takes this much longer.
    transitions: Duration,
    spoiled: Spoiled,
}

impl Faults {
    /// None but what the configuration asks for.
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

    pub(super) fn spoiled(&self) -> &Spoiled {
        &self.spoiled
    }

    pub(super) fn take_state_cut(&mut self) -> Option<usize> {
        self.state_cut.take()
    }
}

/// Faults of the connection to the controller.
impl Controller {
    /// The server takes requests and carries them out, but its answers get lost.
    pub fn mute(&mut self, link: Link) {
        self.faults.muted[link as usize] = true;
    }

    /// The server's answers arrive again.
    pub fn unmute(&mut self, link: Link) {
        self.faults.muted[link as usize] = false;
    }

    /// The server closes new connections at once.
    pub fn refuse(&mut self, link: Link) {
        self.faults.refused[link as usize] = true;
    }

    /// The server takes connections again.
    pub fn accept(&mut self, link: Link) {
        self.faults.refused[link as usize] = false;
    }

    /// How many clients port 2000 takes from now on. Those that are there stay until the next one
    /// comes.
    pub fn command_clients(&mut self, clients: CommandClients) {
        self.faults.command_clients = clients;
    }

    /// The server closes every connection it has.
    pub fn disconnect(&mut self, link: Link) {
        self.server.close_link(link, &mut self.outputs);
    }

    /// Every answer of the server is late by this much from now on. The state stream, which is
    /// not asked for, knows no delay.
    pub fn delay_answers(&mut self, link: Link, delay: Duration) {
        self.faults.delay[link as usize] = delay;
    }

    /// What `poweron`, `poweroff`, `enable`, `disable`, `stop` and `pause` begin takes this much
    /// longer from now on.
    pub fn delay_transitions(&mut self, by: Duration) {
        self.faults.transitions = by;
        self.machine.delay_transitions(by);
    }

    /// Every Modbus request is answered with this exception and not carried out; `None` ends it.
    pub fn answer_modbus_with(&mut self, exception: Option<Exception>) {
        self.faults.exception = exception;
    }

    /// Of the next state packet only the first `len` bytes are sent, then every connection of port
    /// 2001 is closed.
    pub fn cut_next_state_packet(&mut self, len: usize) {
        self.faults.state_cut = Some(len);
    }

    /// State packets and the frames of recipes' output parts show this instead of the item's value,
    /// such as NaN. Modbus and programs go on seeing the value.
    ///
    /// An item is a system variable such as `RobotState[8]`, an analog input such as `AI_V[1]`, or any
    /// other float of the state packet, such as `joint_torque[1]` (proto-core/docs/wire/state.md section 2).
    ///
    /// # Errors
    /// [`NoSuchFloat`]; nothing changed.
    pub fn spoil(&mut self, name: &str, instead: f32) -> Result<(), NoSuchFloat> {
        self.faults.spoiled.spoil(name, instead)
    }

    /// They show its value again.
    ///
    /// # Errors
    /// [`NoSuchFloat`].
    pub fn heal(&mut self, name: &str) -> Result<(), NoSuchFloat> {
        self.faults.spoiled.heal(name)
    }

    /// What the port sends gets lost.
    pub fn mute_port(&mut self, port: usize) {
        if !self.faults.mutes_port(port) {
            self.faults.muted_ports.push(port);
        }
    }

    /// What the port sends arrives again.
    pub fn unmute_port(&mut self, port: usize) {
        self.faults.muted_ports.retain(|&muted| muted != port);
    }

    /// A TCP client's connection is lost.
    pub fn close_port(&mut self, port: usize) {
        if let Some(own) = self.ports.get_mut(port).filter(|own| own.is_tcp_client() && own.is_up()) {
            own.went_down();
            self.outputs.push_back(ControllerOutput::PortClose { port });
        }
    }

    /// Switched off and on again: everything is closed, the registers start afresh with the
    /// configuration's initial values and 0 everywhere else, and the robot goes through its start to
    /// power off. Faults stay as they are.
    pub fn restart(&mut self, now: Instant) {
        self.server.close_all(&mut self.outputs);
        self.running = None;
        self.variables.clear();
        for port in 0..self.ports.len() {
            self.close_port(port);
        }
        let epoch = self.epoch.unwrap_or(now);
        for port in &mut self.ports {
            // A serial line or bus is still there, and so is the address of the UDP server.
            if port.is_up() {
                port.went_down();
                port.came_up(now, epoch);
            }
        }
        // The same configuration made the values that there were at the start.
        if let Ok((registers, arm)) = start_values(&self.config) {
            self.registers = registers;
            self.arm = arm;
            self.arm_shown = None;
        }
        self.machine = Machine::booting(now, mode(&self.config));
        self.machine.delay_transitions(self.faults.transitions);
    }
}

/// A controller that has lost its memory.
impl Controller {
    /// [`Self::restart`], and registers and outputs are 0 whatever the configuration's initial values
    /// are. Only what is wired to it or belongs to the arm is as it was at the start.
    pub fn restart_cleared(&mut self, now: Instant) {
        self.restart(now);
        self.registers.clear();
    }
}

/// Another version of the controller's software.
impl Controller {
    /// The name of the dialect that it speaks.
    pub fn dialect(&self) -> &'static str {
        self.dialect.name
    }

    /// Its software is replaced by one that speaks this dialect: it restarts. Nothing happens when
    /// no dialect has this name.
    pub fn replace_software(&mut self, now: Instant, dialect: &str) {
        if let Some(dialect) = Dialect::named(dialect) {
            self.dialect = dialect;
            self.restart(now);
        }
    }
}

/// What happens in the cell.
impl Controller {
    /// Gives an input, or any other item, a value.
    ///
    /// # Errors
    /// [`SetError::Value`]; nothing changed.
    pub fn force(&mut self, target: InitialTarget, value: f64) -> Result<(), SetError> {
        self.registers.force(target, value)?;
        // The tool's frame decides where the TCP is.
        self.arm_shown = None;
        Ok(())
    }

    /// Another recipe is assigned to a port at the teach pendant, by its index in
    /// [`recipe_config::SimConfig::recipes`]; `None` leaves the port idle.
    ///
    /// # Errors
    /// [`RecipeError`] when the port cannot have it; nothing changed.
    pub fn assign_recipe(
        &mut self,
        now: Instant,
        port: usize,
        recipe: Option<usize>,
    ) -> Result<(), RecipeError> {
        let epoch = self.epoch.unwrap_or(now);
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

    /// The key switch is turned.
    pub fn set_mode(&mut self, mode: OperationMode) {
        self.machine.set_mode(mode);
    }

    /// The emergency stop is pressed.
    pub fn emergency_stop(&mut self, now: Instant) {
        let effect = self.machine.emergency_stop(now);
        self.apply(now, effect);
    }

    /// A protective stop, such as an open door.
    pub fn protective_stop(&mut self, now: Instant) {
        let effect = self.machine.protective_stop(now);
        self.apply(now, effect);
    }

    /// The arm has hit something on this axis (see proto-core/docs/wire/state.md section 2).
    pub fn collide(&mut self, now: Instant, axis: u8) {
        let effect = self.machine.collide(now, axis);
        self.apply(now, effect);
    }

    /// The cause of a stop is gone and was acknowledged.
    pub fn clear_stop(&mut self, now: Instant) {
        self.machine.clear_stop(now);
    }

    /// Somebody enters the zone of reduced speed.
    pub fn enter_reduced(&mut self, now: Instant) {
        self.machine.set_reduced(true);
        self.speed_changed(now);
    }

    /// Nobody is in the zone of reduced speed any more.
    pub fn leave_reduced(&mut self, now: Instant) {
        self.machine.set_reduced(false);
        self.speed_changed(now);
    }
}
