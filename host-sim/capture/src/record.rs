//! Records of the gateway's engine: frames at its ports and links, and passes of the engine itself.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use proto_core::config::{Bus, GatewayConfig};
use proto_core::engine::{Engine, LinkId, PortId};
use proto_core::time::Instant;

use crate::decode::Decoder;
use crate::frame::Frame;

/// One record.
#[derive(Debug, Clone)]
pub struct Record {
    /// Time on the engine's clock.
    pub at: Instant,
    /// Number of records of the same kind lost before this one for all subscribers.
    pub lost: u32,
    /// The content.
    pub what: What,
}

/// The content of a record.
#[derive(Debug, Clone)]
pub enum What {
    /// An engine starts, with these ports and links. Each subscriber gets this record first.
    Began(Arc<Cell>),
    /// A frame, bytes or a datagram.
    Frame(Frame),
    /// One call of the engine and its effects, as entries of a recording (`proto_core::record`). The first call of an
    /// engine is its start.
    Pass(Box<[u8]>),
}

/// A gateway's ports and links, its frames, and its clock.
#[derive(Debug, Clone)]
pub struct Cell {
    /// Field ports.
    pub ports: Vec<CellPort>,
    /// Links to the controller, by id, with names such as `modbus`.
    pub links: Vec<(LinkId, String)>,
    /// Decodes the frames of its configuration.
    pub decoder: Arc<Decoder>,
    /// The wall clock at an instant of the engine's clock.
    pub epoch: Epoch,
}

/// A field port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CellPort {
    /// Its id.
    pub id: PortId,
    /// Its name.
    pub name: String,
    /// Whether it is a CAN bus.
    pub is_can: bool,
    /// Bit/s.
    pub bit_rate: u32,
}

/// The wall clock at an instant of the engine's clock. All times of a run are relative to it, so setting the clock
/// meanwhile does not change their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Epoch {
    /// The instant.
    pub at: Instant,
    /// The wall clock at that instant.
    pub wall: SystemTime,
}

impl Epoch {
    /// Nanoseconds since 1970 at this instant, with a resolution of microseconds.
    pub fn unix_nanos(&self, at: Instant) -> u64 {
        let wall = self.wall.duration_since(UNIX_EPOCH).unwrap_or_default();
        let (now, then) = (at.as_micros(), self.at.as_micros());
        let nanos = if now >= then {
            wall.saturating_add(Duration::from_micros(now - then))
        } else {
            wall.saturating_sub(Duration::from_micros(then - now))
        };
        u64::try_from(nanos.as_nanos()).unwrap_or(u64::MAX)
    }
}

impl Cell {
    /// The ports and links of an engine with this configuration; `decoder` knows its frames.
    pub fn new<const P: usize, const U: usize, const F: usize, const T: usize, const E: usize>(
        config: &GatewayConfig,
        engine: &Engine<P, U, F, T, E>,
        epoch: Epoch,
        decoder: Arc<Decoder>,
    ) -> Self {
        let ports = config.view().field_ports().map(|(index, port, _)| {
            let (is_can, bit_rate) = match port.bus {
                Bus::Rs485(line) => (false, line.baud),
                Bus::Can { bitrate } => (true, bitrate),
                Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => (false, 0),
            };
            CellPort { id: PortId(index), name: port.name.to_string(), is_can, bit_rate }
        });
        let links = engine.links().map(|link| (link.id, link.name.to_owned()));
        Self { ports: ports.collect(), links: links.collect(), decoder, epoch }
    }

    /// A field port.
    pub fn port(&self, id: PortId) -> Option<&CellPort> {
        self.ports.iter().find(|port| port.id == id)
    }

    /// The name of a link.
    pub fn link(&self, id: LinkId) -> Option<&str> {
        self.links.iter().find(|(other, _)| *other == id).map(|(_, name)| name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instants_before_and_behind_the_epoch_have_their_time() {
        let wall = UNIX_EPOCH + Duration::from_secs(1_000);
        let epoch = Epoch { at: Instant::from_millis(10), wall };
        assert_eq!(epoch.unix_nanos(Instant::from_millis(12)), 1_000_002_000_000);
        assert_eq!(epoch.unix_nanos(Instant::from_millis(9)), 999_999_000_000);
        let early = Epoch { at: Instant::from_millis(10), wall: UNIX_EPOCH };
        assert_eq!(early.unix_nanos(Instant::from_millis(9)), 0);
    }
}
