//! The simulated controller on real sockets and devices.

use super::{RunOptions, StartError};
use crate::config::SimConfig;

/// Runs the simulated controller until Ctrl-C or SIGTERM.
///
/// # Errors
/// What kept it from starting; nothing is left behind then.
pub fn run(_config: SimConfig, _options: RunOptions) -> Result<(), StartError> {
    Err(StartError::new("the simulated controller does not run yet"))
}
