//! Explains in words why a condition does not hold, for waits that time out.

use proto_core::modbus::server::RegisterBank;
use serde_json::{Value, json};

use super::Controller;
use super::common::{number, snake};
use super::condition::Condition;

impl Controller {
    /// The parts of the condition that do not hold, each with the actual value, such as `DO[1] is 0, not 1`. An
    /// event counts if its number is `since` or later.
    pub fn unmet(&self, condition: &Condition, since: u64) -> Vec<String> {
        let Ok(Value::Object(wanted)) = serde_json::to_value(condition) else { return Vec::new() };
        let part = |key: &str, value: &Value| {
            let part = json!({ key: value });
            serde_json::from_value::<Condition>(part).is_ok_and(|part| self.holds(&part, since) != Ok(true))
        };
        let mut unmet = Vec::new();
        for (key, value) in &wanted {
            match value {
                Value::Object(event) if key == "event" && part(key, value) => {
                    unmet.push(format!("there was no event {}", Value::Object(event.clone())));
                }
                Value::Object(_) if key == "event" => {}
                Value::Object(places) => {
                    for (place, value) in
                        places.iter().filter(|(at, value)| part(key, &json!({ *at: value })))
                    {
                        let name = if key == "items" { place.clone() } else { format!("{key} {place}") };
                        unmet.push(format!("{name} is {}, not {}", self.value_at(key, place), plain(value)));
                    }
                }
                value if part(key, value) => {
                    unmet.push(format!("{key} is {}, not {}", self.state_of(key), plain(value)));
                }
                _ => {}
            }
        }
        unmet
    }

    fn state_of(&self, key: &str) -> String {
        let machine = self.machine();
        match key {
            "robot" => snake(machine.robot().name()),
            "program_state" => snake(machine.program().name()),
            "safety" => snake(machine.safety().name()),
            "mode" => snake(machine.mode().name()),
            _ => self.program_name().unwrap_or("none").to_owned(),
        }
    }

    fn value_at(&self, key: &str, place: &str) -> Value {
        let address = place.parse().unwrap_or(0);
        match key {
            "coil" => {
                let mut bits = [0];
                let read = self.registers().read_coils(address, 1, &mut bits);
                read.map_or(Value::Null, |()| json!(bits[0] & 1))
            }
            "register" => {
                let mut words = [[0; 2]];
                let read = self.registers().read_holding(address, &mut words);
                read.map_or(Value::Null, |()| json!(u16::from_be_bytes(words[0])))
            }
            _ => place.parse().map_or(Value::Null, |target| number(self.registers().value(target))),
        }
    }
}

/// The value as text: a name without quotes, `none` for null.
fn plain(value: &Value) -> String {
    match value {
        Value::String(name) => name.clone(),
        Value::Null => "none".to_owned(),
        Value::Number(value) => number(value.as_f64().unwrap_or(f64::NAN)).to_string(),
        other => other.to_string(),
    }
}
