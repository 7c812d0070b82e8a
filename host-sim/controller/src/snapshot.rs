//! The controller's state as JSON (docs/control.md section 3).

use proto_core::time::Instant;
use serde_json::{Map, Value, json};

use super::Controller;
use super::common::{Link, snake};

impl Controller {
    /// The state, the newest run, the arm, faults, ports and clients.
    pub fn state(&self, now: Instant) -> Value {
        let machine = self.machine();
        let (arm, counters) = (self.registers.arm(), self.counters());
        let ports: Map<String, Value> = self
            .ports
            .iter()
            .zip(&self.config.ports)
            .map(|(port, place)| {
                let recipe = place.recipe.and_then(|recipe| self.config.recipes.get(recipe));
                let counters = port.counters();
                let shown = json!({
                    "up": port.is_up(),
                    "recipe": recipe.map(|recipe| &recipe.name),
                    "cycle_ms": port.cycle().as_micros() as f64 / 1e3,
                    "frames_in": counters.frames_in,
                    "frames_out": counters.frames_out,
                });
                (port.name().to_owned(), shown)
            })
            .collect();
        json!({
            "time_s": self.time_s(now),
            "robot": snake(machine.robot().name()),
            "program_state": snake(machine.program().name()),
            "safety": snake(machine.safety().name()),
            "mode": snake(machine.mode().name()),
            "codes": {
                "robot": machine.robot().code(),
                "program_state": machine.program().code(),
                "safety": machine.safety().code(),
                "mode": machine.mode().code(),
            },
            "speed_percent": machine.speed_percent(),
            "program": self.program_name(),
            "error": machine.error().map(|error| json!({ "code": error.id.code(), "text": error.message })),
            "last_run": self.last_run(),
            "runs": self.runs(),
            "joints_rad": &arm.position[..6],
            "tcp_pose": arm.pose,
            "tcp_speed": arm.tcp_velocity,
            "faults": self.faults(),
            "ports": ports,
            "clients": {
                "command": counters.command.open,
                "state": counters.state.open,
                "modbus": counters.modbus.open,
            },
            "log": self.program_log().collect::<Vec<_>>(),
        })
    }

    fn faults(&self) -> Vec<Value> {
        let faults = &self.faults;
        let mut shown = Vec::new();
        for server in [Link::Command, Link::State, Link::Modbus] {
            let kinds = [
                ("mute", faults.mutes(server)),
                ("refuse", faults.refuses(server)),
                ("garbage", faults.is_garbage(server)),
                ("freeze", server == Link::State && faults.is_frozen()),
            ];
            for (kind, _) in kinds.into_iter().filter(|kind| kind.1) {
                shown.push(json!({ "server": server, "kind": kind }));
            }
            let delay = faults.delay(server).as_micros();
            if delay > 0 {
                shown.push(json!({ "server": server, "kind": "delay", "seconds": delay as f64 / 1e6 }));
            }
        }
        if let Some(exception) = faults.exception() {
            shown.push(json!({ "server": "modbus", "kind": "exception", "code": exception.code() }));
        }
        for (nth, port) in self.ports.iter().enumerate() {
            if faults.mutes_port(nth) {
                shown.push(json!({ "port": port.name(), "kind": "mute" }));
            }
        }
        for (item, value) in faults.corrupted().items() {
            let value = if value.is_finite() {
                json!(value)
            } else if value.is_nan() {
                json!("nan")
            } else {
                json!(if value > 0.0 { "inf" } else { "-inf" })
            };
            shown.push(json!({ "item": item, "kind": "spoil", "value": value }));
        }
        let transitions = faults.transitions().as_micros();
        if transitions > 0 {
            shown.push(json!({ "transitions": transitions as f64 / 1e6 }));
        }
        shown
    }
}
