//! The boards that the firmware runs on, as far as a configuration has to fit them.
//!
//! In: a checked configuration. Out: the first thing that exceeds this board. What no board supports is refused when
//! the file is read or its image is made.

use std::fmt;
use std::str::FromStr;

use proto_core::config::{Bus, GatewayConfig, image};
use proto_core::engine::Engine;

/// The bytes of a configuration's image (docs/configuration.md section 6).
///
/// # Errors
/// The text for people, if it is longer than [`image::MAX_IMAGE`].
pub fn encoded(config: &GatewayConfig) -> Result<Vec<u8>, String> {
    let mut bytes = vec![0; image::MAX_IMAGE];
    let len = image::encode(config, &mut bytes).map_err(|error| error.to_string())?;
    bytes.truncate(len);
    Ok(bytes)
}

/// Same as [`encoded`], and decoded again: what a board would refuse is never stored or sent.
///
/// # Errors
/// The text for people: it is too long, or a board would refuse it.
pub fn image_of(config: &GatewayConfig) -> Result<Vec<u8>, String> {
    let bytes = encoded(config)?;
    image::decode(&bytes).map_err(|error| error.to_string())?;
    Ok(bytes)
}

/// A board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Board {
    /// Its name, as in the features of the firmware.
    pub name: &'static str,
    /// Number of RS-485 lines.
    pub serial_ports: usize,
    /// Number of CAN buses.
    pub can_ports: usize,
}

/// All boards.
pub const BOARDS: [Board; 2] = [
    Board { name: "nucleo-h743zi", serial_ports: 2, can_ports: 1 },
    Board { name: "mps2-an500", serial_ports: 2, can_ports: 1 },
];

const PORTS: usize = 4;
const LINKS: usize = 2;
/// In one direction.
const FIELDS: usize = 128;
const EXCHANGES: usize = 32;

/// The engine in the size of a board, but without a ring of frames.
type SizedEngine = Engine<PORTS, LINKS, FIELDS, 0, EXCHANGES>;

/// Something that a configuration needs and a board does not have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unfit {
    /// Where in the file: names of tables and keys.
    pub key: Vec<String>,
    /// What is wrong there.
    pub message: String,
}

impl Board {
    /// Whether this board can run a configuration: the same checks as at its start.
    ///
    /// # Errors
    /// The first thing that the board does not have.
    pub fn check(&self, config: &GatewayConfig) -> Result<(), Unfit> {
        let (mut lines, mut buses) = (self.serial_ports, self.can_ports);
        for (_, port, _) in config.view().field_ports() {
            let (left, bus, available) = match port.bus {
                Bus::Rs485(_) => (&mut lines, "RS-485", self.serial_ports),
                Bus::Can { .. } => (&mut buses, "CAN", self.can_ports),
                Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => continue,
            };
            let Some(rest) = left.checked_sub(1) else {
                let message =
                    format!("the board {} has {available} {bus} ports, and this is one more", self.name);
                return Err(Unfit { key: vec!["port".into(), port.name.to_string(), "bus".into()], message });
            };
            *left = rest;
        }
        match SizedEngine::new(config) {
            Ok(_) => Ok(()),
            Err(error) => {
                let message = format!("the board {} has no room for it: {error}", self.name);
                Err(Unfit { key: vec!["port".into()], message })
            }
        }
    }
}

impl fmt::Display for Board {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

impl FromStr for Board {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let known = BOARDS.into_iter().find(|board| board.name == name);
        known.ok_or_else(|| format!("no such board; there are {}", BOARDS.map(|board| board.name).join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_what_the_firmware_has() {
        for board in BOARDS {
            let folder = board.name.replace('-', "_");
            let path = format!("{}/../../firmware/src/board/{folder}/mod.rs", env!("CARGO_MANIFEST_DIR"));
            let source = std::fs::read_to_string(&path).unwrap();
            for (name, count) in [("SERIAL_PORTS", board.serial_ports), ("CAN_PORTS", board.can_ports)] {
                let line = format!("const {name}: usize = {count};");
                assert!(source.contains(&line), "{path} has no {line:?}");
            }
        }
    }

    #[test]
    fn the_engine_has_the_size_of_the_firmwares() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../firmware/src/tasks/gateway.rs");
        let source = std::fs::read_to_string(path).unwrap();
        for (name, size) in
            [("FIELD_PORTS", PORTS), ("UPLINKS", LINKS), ("FIELDS", FIELDS), ("EXCHANGES", EXCHANGES)]
        {
            let line = format!("const MAX_{name}: usize = {size};");
            assert!(source.contains(&line), "{path} has no {line:?}");
        }
    }

    #[test]
    fn every_board_of_the_firmware_is_in_the_table() {
        // Each board has a folder.
        let path = format!("{}/../../firmware/src/board", env!("CARGO_MANIFEST_DIR"));
        let entries = std::fs::read_dir(path).unwrap().map(Result::unwrap);
        let known: Vec<_> = entries.filter(|entry| entry.path().is_dir()).collect();
        assert_eq!(known.len(), BOARDS.len(), "{known:?}");
    }
}
