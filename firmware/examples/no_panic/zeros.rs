//! Configurations of several sizes as a board keeps them: statics that can change, are all zeros at first and
//! take no flash. `.ci/run no-panic` looks where they lie and prints how much RAM they take.

use core::cell::Cell;
use core::hint::black_box;

use critical_section::Mutex;
use proto_core::config::GatewayConfig;

/// One port, one recipe, 32 fields, 4 safe values.
static CONFIG_SMALL: Mutex<Cell<GatewayConfig<1, 1, 32, 0, 4, 0>>> =
    Mutex::new(Cell::new(GatewayConfig::empty()));
/// Two ports and a way up, a panel's commands.
static CONFIG_MEDIUM: Mutex<Cell<GatewayConfig<3, 3, 128, 8, 16, 0>>> =
    Mutex::new(Cell::new(GatewayConfig::empty()));
/// What a file can have.
static CONFIG_FULL: Mutex<Cell<GatewayConfig>> = Mutex::new(Cell::new(GatewayConfig::empty()));

pub(crate) fn all() {
    black_box((&CONFIG_SMALL, &CONFIG_MEDIUM, &CONFIG_FULL));
}
