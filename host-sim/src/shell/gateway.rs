//! The gateway's engine on real sockets and devices.

use proto_core::config::GatewayConfig;

use super::{RunOptions, StartError};

/// Runs the gateway until Ctrl-C or SIGTERM.
///
/// # Errors
/// What kept it from starting; nothing is left behind then.
pub fn run(_config: GatewayConfig, _options: RunOptions) -> Result<(), StartError> {
    Err(StartError::new("the gateway does not run yet"))
}
