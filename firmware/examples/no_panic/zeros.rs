//! Configurations of several sizes, as mutable statics. They are all zeros, so they take no flash: `.ci/run no-panic`
//! checks their sections and prints their sizes.

use core::cell::Cell;
use core::hint::black_box;

use critical_section::Mutex;
use proto_core::config::GatewayConfig;

/// One port, one recipe, 32 fields, 4 safe values.
static CONFIG_SMALL: Mutex<Cell<GatewayConfig<1, 1, 32, 0, 4, 0>>> =
    Mutex::new(Cell::new(GatewayConfig::empty()));
/// Two ports, a route to the controller, the commands of a panel.
static CONFIG_MEDIUM: Mutex<Cell<GatewayConfig<3, 3, 128, 8, 16, 0>>> =
    Mutex::new(Cell::new(GatewayConfig::empty()));
/// The largest configuration that a file can contain.
static CONFIG_FULL: Mutex<Cell<GatewayConfig>> = Mutex::new(Cell::new(GatewayConfig::empty()));

pub(crate) fn all() {
    black_box((&CONFIG_SMALL, &CONFIG_MEDIUM, &CONFIG_FULL));
}
