//! One port, whose device sends a byte of outputs and is shown the outputs as they are.

use proto_core::config::{ConfigError, GatewayConfig, OnStale, Port, Recipe};
use proto_core::time::Duration;

/// One port, one recipe, two fields, no commands, one safe value.
pub(crate) type CellConfig = GatewayConfig<1, 1, 2, 0, 1, 0>;

/// In place: a configuration does not pass over the stack.
pub(crate) fn write(config: &mut CellConfig) -> Result<(), ConfigError> {
    config.set_controller("192.168.12.138")?;
    config.add_recipe(
        &Recipe::realtime("outputs")
            .stream_input(&[0xFF, 0xFF], &[0xEE, 0xEE], &["DigitalOutputCommand[1]"])
            .stream_output(&[0xFF, 0xFF], &[0xFE, 0xFE], &["DigitalSignalStatus[4]"])
            .on_stale(OnStale::Stop),
    )?;
    config.add_port(
        &Port::rs485("rs485-1", "outputs")
            .turnaround(Duration::from_micros(100))
            .cycle(Duration::from_millis(10))
            .timeout(Duration::from_millis(25))
            .safe(&[("DigitalOutputCommand[1]", 0.0)]),
    )?;
    Ok(())
}
