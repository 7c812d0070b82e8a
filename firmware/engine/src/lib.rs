//! The engine of `proto-core` with the capacities of a board.
//!
//! A type of its own, so that its code is generated in this crate, with its optimisation level: the firmware is
//! compiled for the smallest size (`z`). Each method only calls the engine's.
#![no_std]
#![forbid(unsafe_code)]

use proto_core::config::GatewayConfig;
use proto_core::engine::{
    BuildError, Engine as AnyEngine, Handled, Input, LinkId, LinkInfo, OUTPUT_BUFFER, Output, PortCounters,
    PortId, Status, Tap,
};
use proto_core::time::Instant;

/// Number of field ports that a board can have.
pub const MAX_FIELD_PORTS: usize = 4;
/// Number of recipe links that a board can have.
pub const MAX_UPLINKS: usize = 2;
/// User-defined fields in one direction, over all ports.
pub const MAX_FIELDS: usize = 128;
/// Exchanges with devices, over all ports.
pub const MAX_EXCHANGES: usize = 32;
/// Capacity of the frame tap in bytes: 25 ms of 960 sensor frames and 500 CAN frames a second.
pub const MAX_TAP: usize = 4096;
/// Recipe links, and command, urgent commands, state and Modbus.
pub const MAX_LINKS: usize = SizedEngine::MAX_LINKS;

/// The generic engine.
pub type SizedEngine = AnyEngine<MAX_FIELD_PORTS, MAX_UPLINKS, MAX_FIELDS, MAX_TAP, MAX_EXCHANGES>;

/// The engine with the capacities of a board. Its methods are those of [`proto_core::engine::Engine`].
#[derive(Debug)]
pub struct Engine(SizedEngine);

impl Engine {
    /// An engine without a configuration; all zeros.
    pub const fn idle() -> Self {
        Self(SizedEngine::idle())
    }

    /// Applies a configuration.
    ///
    /// # Errors
    /// The engine refuses it and is idle.
    #[inline]
    pub fn configure(&mut self, config: &GatewayConfig) -> Result<(), BuildError> {
        self.0.configure(config)
    }

    /// Reports an event, or that time has passed.
    pub fn handle(&mut self, now: Instant, input: Input<'_>) -> Handled {
        self.0.handle(now, input)
    }

    /// The next output for the driver.
    pub fn poll_output<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        self.0.poll_output(now, buf)
    }

    /// A snapshot of the whole gateway.
    pub fn status(&self, now: Instant) -> Status<'_> {
        self.0.status(now)
    }

    /// The field ports, in configuration order.
    pub fn field_ports(&self) -> impl Iterator<Item = PortId> + '_ {
        self.0.field_ports()
    }

    /// The links that the configuration needs.
    pub fn links(&self) -> impl Iterator<Item = LinkInfo<'_>> + '_ {
        self.0.links()
    }

    /// When the engine wants to be called next.
    pub fn deadline(&self) -> Instant {
        self.0.deadline()
    }

    /// The counters of a field port; `None` if no such port is configured.
    pub fn port_counters(&self, port: PortId) -> Option<&PortCounters> {
        self.0.port_counters(port)
    }

    /// Whether a datagram is a frame of the link.
    pub fn is_frame(&self, link: LinkId, datagram: &[u8]) -> bool {
        self.0.is_frame(link, datagram)
    }

    /// Number of sleeps of the gateway.
    pub fn sleeps(&self) -> u32 {
        self.0.sleeps()
    }

    /// Prepares the end of the engine: sends the safe values.
    pub fn make_safe(&mut self) {
        self.0.make_safe();
    }

    /// Whether the controller shows every safe value.
    pub fn is_safe(&self) -> bool {
        self.0.is_safe()
    }

    /// The frame tap.
    pub fn tap(&mut self) -> &mut Tap<MAX_TAP> {
        self.0.tap()
    }
}
