//! One port, whose device sends a byte of outputs and is shown the outputs as they are.

use proto_core::config::{
    Bus, FieldSpec, GatewayConfig, OnStale, Parity, Parts, Port, Recipe, Rs485, SafeValue, SendOn, Span,
    StreamPart,
};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::Duration;
use proto_core::wire::scalar::Scalar;

/// In place: a configuration does not pass over the stack.
pub(crate) fn write(config: &mut GatewayConfig) -> Option<()> {
    let commanded = SysVar::parse("DigitalOutputCommand[1]").ok()?;
    let shown = SysVar::parse("DigitalSignalStatus[4]").ok()?;
    config.controller.address = "192.168.12.138".try_into().ok()?;
    config.controller.dialect = "v2.3".try_into().ok()?;
    config.controller.command_port = 2000;
    config.controller.state_port = 2001;
    config.controller.modbus_port = 502;
    config.fields.extend([commanded, shown].map(FieldSpec::System));
    let part = |tail: u8, start| StreamPart {
        head: [0xFF; 2].into_iter().collect(),
        tail: [tail; 2].into_iter().collect(),
        fields: Span { start, len: 1 },
    };
    config.recipes.extend([Recipe {
        name: "outputs".try_into().ok()?,
        mode: Mode::Realtime,
        parts: Parts::Stream { input: Some(part(0xEE, 0)), output: Some(part(0xFE, 1)) },
        on_stale: OnStale::Stop,
        send: SendOn::Period,
    }]);
    let line = Rs485 {
        baud: 115_200,
        parity: Parity::None,
        stop_bits: 1,
        idle_gap: Duration::from_millis(50),
        turnaround: Duration::from_micros(100),
    };
    config.ports.extend([Port {
        name: "rs485-1".try_into().ok()?,
        bus: Bus::Rs485(line),
        recipe: 0,
        cycle: Duration::from_millis(10),
        timeout: Duration::from_millis(25),
        on_timeout: Span { start: 0, len: 1 },
        stale_after: Duration::from_millis(500),
    }]);
    config.safe_values.extend([SafeValue { var: commanded, value: Scalar::Byte(0) }]);
    Some(())
}
