//! The cells that a soak run uses by default.

use std::fmt::Write;
use std::path::Path;

use proto_core::config::GatewayConfig;

use recipe_config::SimConfig;
use recipe_config::file::{self, FileError, Text};

use crate::oracle::unmodelled::unmodelled;

/// A gateway and a controller configuration.
#[derive(Debug, Clone)]
pub struct Scenario {
    /// The cell's name.
    pub name: String,
    /// The gateway's configuration.
    pub gateway: Box<GatewayConfig>,
    /// The controller's configuration.
    pub controller: SimConfig,
    /// The device that is judged by its own log; `None` if the model watches the gateway.
    pub judged: Option<crate::judge::Kind>,
}

struct Embedded {
    name: &'static str,
    gateway: &'static str,
    controller: &'static str,
}

macro_rules! embedded {
    ($folder:literal, $name:literal, $controller:literal) => {
        Embedded {
            name: $name,
            gateway: include_str!(concat!(env!("CARGO_MANIFEST_DIR"), $folder, $name, ".toml")),
            controller: include_str!(concat!(
                env!("CARGO_MANIFEST_DIR"),
                $folder,
                $controller,
                "-controller.toml"
            )),
        }
    };
}

/// A seed selects a cell by position, so the order must not change. If the controller of an example has field ports of
/// its own, the controller is replaced, since no device would be connected to them.
const EMBEDDED: [Embedded; 22] = [
    embedded!("/../configs/", "rs485-system", "can-hand"),
    embedded!("/../configs/", "udp-server", "udp-server"),
    embedded!("/../configs/", "client", "client"),
    embedded!("/../configs/", "force-sensor", "force-sensor"),
    embedded!("/../configs/", "request-response", "request-response"),
    embedded!("/../configs/", "can-hand", "can-hand"),
    embedded!("/../configs/", "can-system", "can-hand"),
    embedded!("/src/soak/cells/", "several-ports", "several-ports"),
    embedded!("/src/soak/cells/", "two-clients", "two-clients"),
    embedded!("/src/soak/cells/", "orders", "orders"),
    embedded!("/src/soak/cells/", "witness", "witness"),
    embedded!("/src/soak/cells/", "panels", "panels"),
    embedded!("/src/soak/cells/", "modbus-line", "modbus-line"),
    embedded!("/src/soak/cells/", "gripper-line", "gripper-line"),
    embedded!("/src/soak/cells/", "can-frames", "can-frames"),
    embedded!("/src/soak/cells/", "panel-line", "panel-line"),
    embedded!("/src/soak/cells/", "scanner-line", "scanner-line"),
    embedded!("/src/soak/cells/", "judged-gripper", "judged"),
    embedded!("/src/soak/cells/", "judged-axis", "judged"),
    embedded!("/src/soak/cells/", "judged-rfid", "judged"),
    embedded!("/src/soak/cells/", "judged-drive", "judged"),
    embedded!("/src/soak/cells/", "judged-modbus-tcp", "judged"),
];

impl Scenario {
    /// The names of the embedded cells.
    pub fn names() -> impl Iterator<Item = &'static str> {
        EMBEDDED.iter().map(|cell| cell.name)
    }

    /// All embedded cells.
    ///
    /// # Errors
    /// Never: a test parses the embedded files.
    pub fn all() -> Result<Vec<Self>, FileError> {
        EMBEDDED.iter().map(Self::parse).collect()
    }

    /// The embedded cell of this name; `None` if there is none.
    ///
    /// # Errors
    /// The errors of [`Scenario::all`].
    pub fn named(name: &str) -> Result<Option<Self>, FileError> {
        EMBEDDED.iter().find(|cell| cell.name == name).map(Self::parse).transpose()
    }

    /// A cell from two configuration files.
    ///
    /// # Errors
    /// [`FileError`] if one of them cannot be used.
    pub fn load(gateway: &Path, controller: &Path) -> Result<Self, FileError> {
        let name = gateway.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
        let config = file::load_gateway(gateway, &[])?;
        if let Some(reason) = unmodelled(&config) {
            let source = file::Source::WholeFile { file: gateway.display().to_string() };
            return Err(FileError { source, key: String::new(), message: reason.to_owned() });
        }
        Ok(Self { name, gateway: config, controller: file::load_controller(controller, &[])?, judged: None })
    }

    /// A hash of both configurations, the same on every machine.
    pub(super) fn hash(&self) -> u64 {
        let mut hash = Fnv(0xCBF2_9CE4_8422_2325);
        // Cannot fail: the hasher accepts everything.
        let _ = write!(hash, "{:?} {:?}", self.gateway, self.controller);
        hash.0
    }

    fn parse(cell: &Embedded) -> Result<Self, FileError> {
        let Embedded { name, gateway, controller } = *cell;
        let gateway = file::parse_gateway(Text { name, toml: gateway }, &[])?;
        let controller = file::parse_controller(Text { name, toml: controller }, &[])?;
        Ok(Self { name: name.to_owned(), gateway, controller, judged: crate::judge::Kind::of(name) })
    }
}

/// FNV-1a over the written text.
struct Fnv(u64);

impl Write for Fnv {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        for byte in text.bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proto_core::config::{FieldSpec, Parts, Restarted};
    use proto_core::device::{Ignored, Text, TextWidth};

    use super::*;
    use crate::Cell;

    #[test]
    fn every_embedded_cell_can_run() {
        for scenario in Scenario::all().unwrap() {
            Cell::new(&scenario.gateway, &scenario.controller, 1).unwrap();
        }
        assert!(Scenario::named("no-such-cell").unwrap().is_none());
    }

    #[test]
    fn a_cell_that_the_model_does_not_know_is_refused() {
        let mut config = Scenario::named("can-hand").unwrap().unwrap().gateway;
        assert_eq!(unmodelled(&config), None);
        let Parts::Can { input, .. } = &config.recipes[0].parts else { panic!("a recipe on CAN") };
        let first = &input.iter().next().unwrap().fields.of(&config.fields)[0];
        let nth = config.fields.iter().position(|field| std::ptr::eq(field, first)).unwrap();
        let text = Text { width: TextWidth::Fixed(4), fill: None };
        let ignored = Ignored::NONE;
        let field = FieldSpec::TextInput { text, to: None, length_to: None, count_to: None, ignored };
        config.fields[nth] = field;
        assert!(unmodelled(&config).unwrap().contains("texts"));
        let mut config = Scenario::named("modbus-line").unwrap().unwrap().gateway;
        assert_eq!(unmodelled(&config), None);
        config.exchanges[0].restarted = Some(Restarted { field: 0, value: 0.0 });
        assert!(unmodelled(&config).unwrap().contains("restart"));
        let mut config = Scenario::named("modbus-line").unwrap().unwrap().gateway;
        config.ports[0].bus =
            Scenario::named("judged-modbus-tcp").unwrap().unwrap().gateway.ports[0].bus.clone();
        assert!(unmodelled(&config).unwrap().contains("Modbus TCP"));
    }
}
