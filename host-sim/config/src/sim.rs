//! The configuration of the simulated controller: a checked controller file.

use std::net::{IpAddr, Ipv4Addr};

use proto_core::config::Rs485;
use proto_core::recipe::model;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;

use super::{Functions, InitialTarget};

/// A whole controller file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SimConfig {
    /// The addresses to listen on.
    pub listen: Listen,
    /// The robot's state at the start.
    pub robot: Robot,
    /// Values at the start, in file order.
    pub initial: Vec<Initial>,
    /// What functional inputs do and functional outputs show.
    pub functions: Functions,
    /// Every recipe, in file order.
    pub recipes: Vec<SimRecipe>,
    /// Every recipe port, in file order.
    pub ports: Vec<SimPort>,
    /// The programs for `run(NAME)`.
    pub programs: Vec<SimProgram>,
}

/// Addresses of the controller's servers; port 0 means any free port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Listen {
    /// The address of all servers.
    pub address: IpAddr,
    /// Command port, 2000.
    pub command: u16,
    /// State stream, 2001.
    pub state: u16,
    /// Modbus TCP, 502.
    pub modbus: u16,
    /// UDP recipe server, 2011.
    pub udp2011: u16,
    /// Control socket, any free port; always at 127.0.0.1.
    pub control: u16,
}

impl Default for Listen {
    fn default() -> Self {
        let address = IpAddr::V4(Ipv4Addr::LOCALHOST);
        Self { address, command: 2000, state: 2001, modbus: 502, udp2011: 2011, control: 0 }
    }
}

/// The robot at the start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Robot {
    /// Name of the controller's dialect, one of `proto_core::wire::dialect`.
    pub dialect: String,
    /// Power.
    pub power: Power,
    /// Operation mode.
    pub mode: RobotMode,
    /// How many clients port 2000 accepts.
    pub command_clients: CommandClients,
}

impl Default for Robot {
    fn default() -> Self {
        Self {
            dialect: "v2.3".to_owned(),
            power: Power::Enabled,
            mode: RobotMode::Remote,
            command_clients: CommandClients::Many,
        }
    }
}

/// How far the robot is powered up at the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Power {
    /// The controller was just switched on: it boots to powered off.
    Boot,
    /// Powered off.
    Off,
    /// Powered on, not enabled.
    On,
    /// Powered on and enabled.
    Enabled,
}

/// The operation mode at the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RobotMode {
    /// Manual.
    Manual,
    /// Automatic.
    Auto,
    /// Remote.
    Remote,
}

/// What port 2000 does with further clients: controllers may differ (D26).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CommandClients {
    /// It accepts them, up to its limit.
    #[default]
    Many,
    /// While it has a client, it closes every other connection at once.
    RefuseSecond,
    /// It closes its connection when another client connects.
    DropFirst,
}

/// One value at the start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Initial {
    /// The target.
    pub target: InitialTarget,
    /// The value, which fits the target; a bit is 0 or 1.
    pub value: f64,
}

/// One recipe of the controller.
#[derive(Debug, Clone, PartialEq)]
pub struct SimRecipe {
    /// Its name.
    pub name: String,
    /// System variables, or user-defined fields.
    pub mode: model::Mode,
    /// Stream or CAN, with the parts.
    pub parts: SimParts,
}

/// A recipe's two parts; either may be absent.
#[derive(Debug, Clone, PartialEq)]
pub enum SimParts {
    /// Byte streams and datagrams.
    Stream {
        /// User to robot.
        input: Option<SimStreamPart>,
        /// Robot to user.
        output: Option<SimStreamPart>,
    },
    /// CAN; an absent part has no frames.
    Can {
        /// User to robot.
        input: Vec<SimCanFrame>,
        /// Robot to user.
        output: Vec<SimCanFrame>,
    },
}

/// One part of a stream recipe.
#[derive(Debug, Clone, PartialEq)]
pub struct SimStreamPart {
    /// Bytes before the fields.
    pub head: Vec<u8>,
    /// Bytes after the fields.
    pub tail: Vec<u8>,
    /// The fields.
    pub fields: Vec<SimField>,
}

/// One frame id of a CAN recipe's part.
#[derive(Debug, Clone, PartialEq)]
pub struct SimCanFrame {
    /// The frame's id.
    pub id: CanId,
    /// The fields, at most 8 bytes together.
    pub fields: Vec<SimField>,
}

/// One field.
#[derive(Debug, Clone, PartialEq)]
pub struct SimField {
    /// The user's name for it, or the system variable's.
    pub name: String,
    /// What it is.
    pub field: model::Field,
}

/// One recipe port of the controller.
#[derive(Debug, Clone, PartialEq)]
pub struct SimPort {
    /// Its name, as `--bind`, `--stats` and programs use it.
    pub name: String,
    /// Its bus or connection.
    pub bus: SimBus,
    /// Index into [`SimConfig::recipes`]; a port without a recipe is idle.
    pub recipe: Option<usize>,
    /// How often a realtime recipe's output part is sent; at least 4 ms.
    pub cycle: Duration,
}

/// Kind of a recipe port of the controller.
#[derive(Debug, Clone, PartialEq)]
pub enum SimBus {
    /// Half-duplex serial line.
    Rs485(Rs485),
    /// CAN bus.
    Can {
        /// Bit/s, 10_000..=1_000_000.
        bitrate: u32,
    },
    /// The UDP server at [`Listen::udp2011`].
    UdpServer,
    /// Connects to `HOST:PORT` and reconnects when the connection is lost.
    TcpClient {
        /// `HOST:PORT`.
        to: String,
    },
    /// Sends to `HOST:PORT`.
    UdpClient {
        /// `HOST:PORT`.
        to: String,
    },
}

/// One program of the controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SimProgram {
    /// The name that `run(NAME)` uses.
    pub name: String,
    /// Its Rhai text.
    pub script: String,
}
