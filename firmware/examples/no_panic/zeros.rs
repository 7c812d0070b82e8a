//! Engines and configurations of several sizes as a board keeps them: statics that are all zeros and take
//! no flash. `.ci/run no-panic` looks where they lie and prints how much RAM they take.

use core::hint::black_box;

use proto_core::config::GatewayConfig;
use static_cell::ConstStaticCell;

/// One port, one recipe, 32 fields, 4 safe values.
static CONFIG_SMALL: ConstStaticCell<GatewayConfig<1, 1, 32, 0, 4>> =
    ConstStaticCell::new(GatewayConfig::empty());
/// Two ports and a way up, a panel's commands.
static CONFIG_MEDIUM: ConstStaticCell<GatewayConfig<3, 3, 128, 8, 16>> =
    ConstStaticCell::new(GatewayConfig::empty());
/// What a file can have.
static CONFIG_FULL: ConstStaticCell<GatewayConfig> = ConstStaticCell::new(GatewayConfig::empty());

pub(crate) fn all() {
    black_box((CONFIG_SMALL.take(), CONFIG_MEDIUM.take(), CONFIG_FULL.take()));
}
