//! A controller, a recipe and a port as written in a program.
//!
//! In: the caller's names, numbers and slices. Out: the same, borrowed and small. All defaults are those of files
//! (docs/configuration.md). [`GatewayConfig`](super::GatewayConfig) takes them with `add_recipe` and `add_port`, in a
//! builder or in place, and reports errors.

use super::error::ConfigErrorKind as Kind;
use super::exchange_builder::ExchangeBuilder;
use super::fields::{CanFields, Fields, Var};
use super::rules::text;
use super::{Bus, Echo, OnStale, Parity, Port, PortHealth, Recipe, Rs485, SafeValue, SendOn};
use crate::device::{Boundary, Escape};
use crate::recipe::model::Mode;
use crate::sysvar::{Direction, SysVar};
use crate::time::Duration;

/// The controller's address, ports and dialect; an address converts by `into()`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControllerBuilder<'a> {
    pub(super) address: &'a str,
    pub(super) dialect: Option<&'a str>,
    pub(super) command_port: Option<u16>,
    pub(super) state_port: Option<u16>,
    pub(super) modbus_port: Option<u16>,
}

impl<'a> ControllerBuilder<'a> {
    /// A controller with this IP address or host name, dialect `v2.3`, and ports 2000, 2001 and 502. An empty address
    /// means that the address is learned in another way.
    pub const fn new(address: &'a str) -> Self {
        Self { address, dialect: None, command_port: None, state_port: None, modbus_port: None }
    }

    /// Sets the dialect, `"v2.3"` or `"v2.6"`, and its Modbus port unless [`Self::modbus_port`] was called.
    pub const fn dialect(self, name: &'a str) -> Self {
        Self { dialect: Some(name), ..self }
    }

    /// Sets the command port; 2000 by default.
    pub const fn command_port(self, port: u16) -> Self {
        Self { command_port: Some(port), ..self }
    }

    /// Sets the state port; 2001 by default.
    pub const fn state_port(self, port: u16) -> Self {
        Self { state_port: Some(port), ..self }
    }

    /// Sets the Modbus port; the dialect's by default.
    pub const fn modbus_port(self, port: u16) -> Self {
        Self { modbus_port: Some(port), ..self }
    }
}

impl<'a> From<&'a str> for ControllerBuilder<'a> {
    fn from(address: &'a str) -> Self {
        Self::new(address)
    }
}

/// A recipe under construction: [`Recipe::realtime`], [`Recipe::user`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecipeBuilder<'a> {
    pub(super) name: &'a str,
    pub(super) mode: Mode,
    pub(super) input: PartFields<'a>,
    pub(super) output: PartFields<'a>,
    pub(super) on_stale: OnStale,
    pub(super) trigger: DraftTrigger<'a>,
    pub(super) exchanges: &'a [ExchangeBuilder<'a>],
}

/// Number of entries that a recipe adds to the configuration's lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct ListDemand {
    pub(super) fields: usize,
    pub(super) commands: usize,
    pub(super) exchanges: usize,
    pub(super) frames: usize,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum PartFields<'a> {
    Absent,
    Stream { head: &'a [u8], tail: &'a [u8], fields: Fields<'a>, ends: (Boundary, Option<Escape>) },
    Can(&'a [CanFields<'a>]),
}

impl<'a> PartFields<'a> {
    const fn stream(head: &'a [u8], tail: &'a [u8], fields: Fields<'a>) -> Self {
        Self::Stream { head, tail, fields, ends: (Boundary::Fields, None) }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum DraftTrigger<'a> {
    On(SendOn),
    Rising(Var<'a>, u8),
}

impl Recipe {
    /// A recipe of system variables.
    pub const fn realtime(name: &str) -> RecipeBuilder<'_> {
        RecipeBuilder::new(name, Mode::Realtime)
    }

    /// A recipe of user-defined fields.
    ///
    /// It borrows its fields, so write it in the call that adds it:
    ///
    /// ```
    /// use proto_core::config::{CanFields, GatewayConfig, InputField, OutputField, Port, Recipe};
    /// use proto_core::wire::scalar::ScalarType::{Byte, Short, Word};
    ///
    /// // One port, one recipe, 4 fields, 2 commands, no safe values.
    /// let mut config: GatewayConfig<1, 1, 4, 2, 0> = GatewayConfig::empty();
    /// config.set_controller("192.168.12.138")?;
    /// config.add_recipe(
    ///     &Recipe::user("gripper")
    ///         .can_input(&[
    ///             CanFields::standard(0x101, &[InputField::variable(Word, "WordInputReg[1]")]),
    ///             CanFields::standard(
    ///                 0x102,
    ///                 &[InputField::commands(Byte, &[(1, "run(pick.jspf,50)"), (2, "stop()")])],
    ///             ),
    ///         ])
    ///         .can_output(&[CanFields::standard(
    ///             0x201,
    ///             // The pose is in m, the field in mm.
    ///             &[
    ///                 OutputField::variable(Short, "RobotState[8]").scaled(1000.0, 0.0),
    ///                 OutputField::reply(Byte),
    ///             ],
    ///         )]),
    /// )?;
    /// config.add_port(&Port::can("can-1", "gripper").bitrate(250_000))?;
    /// config.validate()?;
    /// # Ok::<(), proto_core::config::ConfigError>(())
    /// ```
    pub const fn user(name: &str) -> RecipeBuilder<'_> {
        RecipeBuilder::new(name, Mode::User)
    }
}

impl<'a> RecipeBuilder<'a> {
    const fn new(name: &'a str, mode: Mode) -> Self {
        let (input, output) = (PartFields::Absent, PartFields::Absent);
        let (on_stale, trigger) = (OnStale::Hold, DraftTrigger::On(SendOn::Period));
        Self { name, mode, input, output, on_stale, trigger, exchanges: &[] }
    }

    /// Sets the input part (user to robot) of a stream: head and tail of at most 8 bytes each, and the fields.
    pub fn stream_input(mut self, head: &'a [u8], tail: &'a [u8], fields: impl Into<Fields<'a>>) -> Self {
        self.input = PartFields::stream(head, tail, fields.into());
        self
    }

    /// Sets the output part (robot to user) of a stream.
    pub fn stream_output(mut self, head: &'a [u8], tail: &'a [u8], fields: impl Into<Fields<'a>>) -> Self {
        self.output = PartFields::stream(head, tail, fields.into());
        self
    }

    /// Sets how the frames of a stream part are separated, if not by their fields. For user-defined recipes; no effect
    /// on other parts.
    pub fn framing(mut self, part: Direction, boundary: Boundary, escape: Option<Escape>) -> Self {
        let part = if part == Direction::Input { &mut self.input } else { &mut self.output };
        if let PartFields::Stream { ends, .. } = part {
            *ends = (boundary, escape);
        }
        self
    }

    /// Sets the input part (user to robot) as CAN frames.
    pub const fn can_input(mut self, frames: &'a [CanFields<'a>]) -> Self {
        self.input = PartFields::Can(frames);
        self
    }

    /// Sets the output part (robot to user) as CAN frames.
    pub const fn can_output(mut self, frames: &'a [CanFields<'a>]) -> Self {
        self.output = PartFields::Can(frames);
        self
    }

    /// Sets the exchanges with devices besides the parts, or instead of parts for Modbus; see [`ExchangeBuilder`]. For
    /// user-defined recipes.
    pub const fn exchanges(mut self, exchanges: &'a [ExchangeBuilder<'a>]) -> Self {
        self.exchanges = exchanges;
        self
    }

    /// Sets what a port does while the sources of its output are stale.
    pub const fn on_stale(mut self, on_stale: OnStale) -> Self {
        self.on_stale = on_stale;
        self
    }

    /// Sets what makes a port send the output part.
    pub const fn send(mut self, send: SendOn) -> Self {
        self.trigger = DraftTrigger::On(send);
        self
    }

    /// Sends the output part when this bit, 0..=7, of a bit variable changes from 0 to 1.
    pub fn send_on_rising(mut self, var: impl Into<Var<'a>>, bit: u8) -> Self {
        self.trigger = DraftTrigger::Rising(var.into(), bit);
        self
    }

    /// Number of fields, commands, exchanges and their frames.
    pub(super) fn counts(&self) -> ListDemand {
        let frames = self.exchanges.iter().map(|ask| ask.all_frames().count()).fold(0, usize::saturating_add);
        let mut counts = ListDemand { exchanges: self.exchanges.len(), frames, ..ListDemand::default() };
        let mut add = |fields: &Fields<'_>| {
            let (fields, commands) = fields.counts();
            counts.fields = counts.fields.saturating_add(fields);
            counts.commands = counts.commands.saturating_add(commands);
        };
        self.exchanges.iter().flat_map(ExchangeBuilder::fields).for_each(|fields| add(&fields));
        for part in [&self.input, &self.output] {
            match part {
                PartFields::Absent => {}
                PartFields::Stream { fields, .. } => add(fields),
                PartFields::Can(frames) => frames.iter().for_each(|frame| add(&frame.fields)),
            }
        }
        counts
    }
}

/// A port under construction: [`Port::rs485`], [`Port::modbus_rtu`], [`Port::modbus_rtu_slave`],
/// [`Port::can`], [`Port::tcp_listen`], [`Port::udp_listen`]. The defaults are those of a file: a cycle of 4 ms, a timeout of 100 ms,
/// stale after 500 ms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PortBuilder<'a, B = Rs485> {
    pub(super) name: &'a str,
    pub(super) recipe: &'a str,
    pub(super) bus: B,
    pub(super) cycle: Option<Duration>,
    pub(super) timeout: Option<Duration>,
    pub(super) stale_after: Option<Duration>,
    pub(super) safe: SafeValues<'a>,
    pub(super) safe_at_start: bool,
    pub(super) refresh: Option<Duration>,
    pub(super) health: PortHealth,
    pub(super) absent: Option<Duration>,
}

/// The bus of a [`PortBuilder`] that listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Listen<'a> {
    is_tcp: bool,
    address: &'a str,
}

/// The bus of a [`PortBuilder`] for Modbus RTU: a serial line, with the silences of Modbus RTU unless set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RtuLine {
    line: Rs485,
    is_slave: bool,
}

impl RtuLine {
    fn new(is_slave: bool) -> Self {
        let line = Rs485 { idle_gap: Duration::ZERO, turnaround: Duration::ZERO, ..Rs485::default() };
        Self { line, is_slave }
    }
}

/// The bus of a [`PortBuilder`] for Modbus TCP: address of the device, or of its gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ModbusTcp<'a> {
    host: &'a str,
    port: u16,
}

/// The bus of a [`PortBuilder`] on CAN: its bit rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Can(u32);

/// The safe values of a port: `&[("DigitalOutputCommand[1]", 0.0)]`, the same with variables, or `&[SafeValue]`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum SafeValues<'a> {
    /// By name.
    Names(&'a [(&'a str, f64)]),
    /// By variable.
    Vars(&'a [(SysVar, f64)]),
    /// As in the configuration.
    Values(&'a [SafeValue]),
}

impl SafeValues<'_> {
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Names(values) => values.len(),
            Self::Vars(values) => values.len(),
            Self::Values(values) => values.len(),
        }
    }
}

macro_rules! safe_values_from {
    ($($item:ty => $variant:ident),* $(,)?) => {$(
        impl<'a> From<&'a [$item]> for SafeValues<'a> {
            fn from(values: &'a [$item]) -> Self {
                Self::$variant(values)
            }
        }

        impl<'a, const N: usize> From<&'a [$item; N]> for SafeValues<'a> {
            fn from(values: &'a [$item; N]) -> Self {
                Self::$variant(values)
            }
        }
    )*};
}

safe_values_from! { (&'a str, f64) => Names, (SysVar, f64) => Vars, SafeValue => Values }

impl Port {
    /// A port on a bus in the configuration's form.
    pub const fn on<'a>(name: &'a str, recipe: &'a str, bus: Bus) -> PortBuilder<'a, Bus> {
        PortBuilder::new(name, recipe, bus)
    }

    /// A half-duplex serial line; by default 115 200 baud, no parity, 1 stop bit.
    pub fn rs485<'a>(name: &'a str, recipe: &'a str) -> PortBuilder<'a, Rs485> {
        PortBuilder::new(name, recipe, Rs485::default())
    }

    /// A serial line with the gateway as Modbus RTU master, for a recipe with Modbus exchanges. The default turnaround
    /// is 3.5 characters, or 1750 µs above 19 200 bit/s.
    pub fn modbus_rtu<'a>(name: &'a str, recipe: &'a str) -> PortBuilder<'a, RtuLine> {
        PortBuilder::new(name, recipe, RtuLine::new(false))
    }

    /// A serial line with the gateway as Modbus RTU slave, for a recipe with Modbus blocks. Idle gap and turnaround are
    /// 3.5 characters by default, or 1750 µs above 19 200 bit/s.
    pub fn modbus_rtu_slave<'a>(name: &'a str, recipe: &'a str) -> PortBuilder<'a, RtuLine> {
        PortBuilder::new(name, recipe, RtuLine::new(true))
    }

    /// Devices with the gateway as Modbus TCP client, for a recipe of a Modbus master; by default at TCP port 502 of
    /// `host`, an IP address or a name.
    pub const fn modbus_tcp<'a>(
        name: &'a str,
        recipe: &'a str,
        host: &'a str,
    ) -> PortBuilder<'a, ModbusTcp<'a>> {
        PortBuilder::new(name, recipe, ModbusTcp { host, port: Bus::MODBUS_TCP })
    }

    /// A CAN bus; by default 500 kbit/s.
    pub const fn can<'a>(name: &'a str, recipe: &'a str) -> PortBuilder<'a, Can> {
        PortBuilder::new(name, recipe, Can(Bus::BITRATE))
    }

    /// A TCP port that the controller's TCP client connects to, such as `0.0.0.0:50000`.
    pub const fn tcp_listen<'a>(
        name: &'a str,
        recipe: &'a str,
        address: &'a str,
    ) -> PortBuilder<'a, Listen<'a>> {
        PortBuilder::new(name, recipe, Listen { is_tcp: true, address })
    }

    /// A UDP port that the controller's UDP client sends to, such as `0.0.0.0:50000`.
    pub const fn udp_listen<'a>(
        name: &'a str,
        recipe: &'a str,
        address: &'a str,
    ) -> PortBuilder<'a, Listen<'a>> {
        PortBuilder::new(name, recipe, Listen { is_tcp: false, address })
    }
}

impl<'a, B> PortBuilder<'a, B> {
    const fn new(name: &'a str, recipe: &'a str, bus: B) -> Self {
        let safe = SafeValues::Values(&[]);
        Self {
            name,
            recipe,
            bus,
            cycle: None,
            timeout: None,
            stale_after: None,
            safe,
            safe_at_start: false,
            refresh: None,
            health: PortHealth::NONE,
            absent: None,
        }
    }

    /// Sets the cycle in which the output part is sent: 4 ms to an hour.
    pub fn cycle(mut self, cycle: Duration) -> Self {
        self.cycle = Some(cycle);
        self
    }

    /// Sets the timeout: after this time without an accepted frame the port's inputs take their safe values.
    /// [`Port::NEVER`](super::Port::NEVER) for a device that sends only on events.
    pub fn timeout(mut self, timeout: Duration) -> Self {
        self.timeout = Some(timeout);
        self
    }

    /// Sets the age of a source from which on outputs are stale.
    pub fn stale_after(mut self, stale_after: Duration) -> Self {
        self.stale_after = Some(stale_after);
        self
    }

    /// Sets the safe values; other variables hold. Refused on listening ports, which own no variable.
    pub fn safe(mut self, values: impl Into<SafeValues<'a>>) -> Self {
        self.safe = values.into();
        self
    }

    /// Applies the safe values from the start until the device sends a frame.
    pub fn safe_at_start(mut self) -> Self {
        self.safe_at_start = true;
        self
    }

    /// Also sends a recipe that is sent on change after this time without a change.
    pub fn refresh(mut self, refresh: Duration) -> Self {
        self.refresh = Some(refresh);
        self
    }

    /// Sets the time without a frame after which a peer of the recipe's exchanges counts as restarted when it is heard
    /// again; 3 s by default.
    pub fn absent(mut self, absent: Duration) -> Self {
        self.absent = Some(absent);
        self
    }

    /// Sets the variables that report the port's health to the robot. Refused on listening ports.
    pub fn health(mut self, health: PortHealth) -> Self {
        self.health = health;
        self
    }
}

impl<B: SerialLine> PortBuilder<'_, B> {
    /// Sets the bit rate, 1200..=4_000_000 bit/s.
    pub fn baud(mut self, baud: u32) -> Self {
        self.bus.line().baud = baud;
        self
    }

    /// Sets the parity.
    pub fn parity(mut self, parity: Parity) -> Self {
        self.bus.line().parity = parity;
        self
    }

    /// Sets the number of stop bits, 1 or 2.
    pub fn stop_bits(mut self, stop_bits: u8) -> Self {
        self.bus.line().stop_bits = stop_bits;
        self
    }

    /// Discards a partial frame after this silence: above 0, at most 1 s.
    pub fn idle_gap(mut self, idle_gap: Duration) -> Self {
        self.bus.line().idle_gap = idle_gap;
        self
    }

    /// Sets the silence before the port sends: at most 1 s; on Modbus RTU above 0.
    pub fn turnaround(mut self, turnaround: Duration) -> Self {
        self.bus.line().turnaround = turnaround;
        self
    }

    /// Sets whether sent bytes are also received; learned by default. [`Echo::Yes`] only with a recipe of exchanges.
    pub fn echo(mut self, echo: Echo) -> Self {
        self.bus.line().echo = echo;
        self
    }
}

impl PortBuilder<'_, Can> {
    /// Sets the bit rate, 10_000..=1_000_000 bit/s.
    pub fn bitrate(mut self, bitrate: u32) -> Self {
        self.bus.0 = bitrate;
        self
    }
}

impl PortBuilder<'_, ModbusTcp<'_>> {
    /// Sets the TCP port.
    pub fn tcp_port(mut self, port: u16) -> Self {
        self.bus.port = port;
        self
    }
}

/// The bus of a [`PortBuilder`]: [`Bus`], [`Rs485`], [`RtuLine`], [`ModbusTcp`], [`Can`], [`Listen`].
pub trait PortBus: sealed::Sealed {}

/// A serial line as the bus of a [`PortBuilder`]: [`Rs485`], [`RtuLine`].
pub trait SerialLine: sealed::SerialBus {}

impl SerialLine for Rs485 {}
impl SerialLine for RtuLine {}
impl PortBus for Bus {}
impl PortBus for Rs485 {}
impl PortBus for RtuLine {}
impl PortBus for ModbusTcp<'_> {}
impl PortBus for Can {}
impl PortBus for Listen<'_> {}

pub(super) mod sealed {
    use super::{Bus, Can, Duration, Kind, Listen, ModbusTcp, Rs485, RtuLine, text};

    /// Conversion to a bus of the configuration.
    pub trait Sealed {
        /// The bus of the configuration.
        ///
        /// # Errors
        /// The error in it: an address that is too long.
        fn bus(&self) -> Result<Bus, Kind>;
    }

    impl Sealed for Bus {
        fn bus(&self) -> Result<Bus, Kind> {
            Ok(self.clone())
        }
    }

    impl Sealed for Rs485 {
        fn bus(&self) -> Result<Bus, Kind> {
            Ok(Bus::Rs485(*self))
        }
    }

    impl Sealed for RtuLine {
        fn bus(&self) -> Result<Bus, Kind> {
            let given = self.line;
            let usual = Rs485 { idle_gap: Rs485::default().idle_gap, ..given };
            let standard = if self.is_slave { usual.with_rtu_silence() } else { usual.with_rtu_turnaround() };
            let or = |given, standard| if given == Duration::ZERO { standard } else { given };
            let idle_gap = or(given.idle_gap, standard.idle_gap);
            let turnaround = or(given.turnaround, standard.turnaround);
            Ok(Bus::Rs485(Rs485 { idle_gap, turnaround, ..given }))
        }
    }

    /// Buses that are serial lines.
    pub trait SerialBus {
        /// The settings of the line.
        fn line(&mut self) -> &mut Rs485;
    }

    impl SerialBus for Rs485 {
        fn line(&mut self) -> &mut Rs485 {
            self
        }
    }

    impl SerialBus for RtuLine {
        fn line(&mut self) -> &mut Rs485 {
            &mut self.line
        }
    }

    impl Sealed for ModbusTcp<'_> {
        fn bus(&self) -> Result<Bus, Kind> {
            Ok(Bus::ModbusTcp { host: text(self.host)?, port: self.port })
        }
    }

    impl Sealed for Can {
        fn bus(&self) -> Result<Bus, Kind> {
            Ok(Bus::Can { bitrate: self.0 })
        }
    }

    impl Sealed for Listen<'_> {
        fn bus(&self) -> Result<Bus, Kind> {
            let listen = text(self.address)?;
            Ok(if self.is_tcp { Bus::TcpListen { listen } } else { Bus::UdpListen { listen } })
        }
    }
}
