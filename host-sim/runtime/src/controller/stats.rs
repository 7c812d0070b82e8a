//! The controller's line of statistics.

use proto_core::sysvar::SysVar;
use proto_core::wire::scalar::Scalar;
use serde_json::{Value, json};

use super::{ControllerRuntime, Outward};

impl ControllerRuntime {
    pub(super) fn stats(&self) -> Value {
        let controller = self.controller.borrow();
        let machine = controller.machine();
        let registers: serde_json::Map<_, _> = SysVar::all()
            .map(|var| (var, controller.registers().var(var)))
            .filter(|(_, value)| value.as_f64() != 0.0)
            .map(|(var, value)| (var.to_string(), number(value)))
            .collect();
        let mut stats = json!(controller.counters());
        if let Value::Object(stats) = &mut stats {
            if let Some(Value::Object(ports)) = stats.get_mut("ports") {
                for (name, outward) in self.port_names.iter().zip(&self.ports) {
                    if let (Some(Value::Object(port)), Outward::Device(tx)) = (ports.get_mut(name), outward) {
                        port.insert("device".to_owned(), json!(tx.counters()));
                    }
                }
            }
            stats.insert("time_us".to_owned(), json!(self.clock.now().as_micros()));
            stats.insert("connections".to_owned(), json!(self.counters.get()));
            stats.insert("mode".to_owned(), json!(machine.mode().code()));
            stats.insert("robot".to_owned(), json!(machine.robot().code()));
            stats.insert("program_state".to_owned(), json!(machine.program().code()));
            stats.insert("safety".to_owned(), json!(machine.safety().code()));
            stats.insert("program".to_owned(), json!(controller.program_name()));
            stats.insert("variables".to_owned(), json!(controller.program_variables()));
            stats.insert("registers".to_owned(), Value::Object(registers));
        }
        stats
    }
}

/// The JSON of a register's value; bits and words have no fraction.
fn number(value: Scalar) -> Value {
    match value {
        Scalar::Byte(bits) => json!(bits),
        Scalar::Word(word) => json!(word),
        other => json!(other.as_f64()),
    }
}
