//! Conditions of `wait`, as words: `robot=enable DO[1]=1 coil:192=1`.

use serde_json::{Map, Value, json};

/// The JSON of a condition.
///
/// # Errors
/// What is wrong with a word.
pub(super) fn parse(words: &[String]) -> Result<Value, String> {
    let mut condition = Map::new();
    for word in words {
        let Some((key, value)) = word.split_once('=') else {
            return Err(format!("{word:?}: no '='; write robot=enable, program=none, DO[1]=1, coil:192=1"));
        };
        let mut put = |group: &str, name: &str, value: Value| {
            let place = condition.entry(group).or_insert_with(|| json!({}));
            place[name] = value;
        };
        match (key, key.split_once([':', '.'])) {
            ("robot" | "safety" | "mode", _) => drop(condition.insert(key.to_owned(), json!(value))),
            ("program-state" | "program_state", _) => {
                condition.insert("program_state".to_owned(), json!(value));
            }
            ("program", _) => {
                let program = if value == "none" { Value::Null } else { json!(value) };
                condition.insert(key.to_owned(), program);
            }
            ("event", _) => put("event", "event", json!(value)),
            (_, Some(("event", name))) => put("event", name, text_or_number(value)),
            (_, Some((group @ ("coil" | "register"), address))) => {
                put(group, address, number(value).map_err(|error| format!("{word}: {error}"))?);
            }
            _ => put("items", key, number(value).map_err(|error| format!("{word}: {error}"))?),
        }
    }
    Ok(Value::Object(condition))
}

/// A number, or a bit as a word.
pub(super) fn number(text: &str) -> Result<Value, String> {
    match text {
        "true" | "on" => Ok(json!(true)),
        "false" | "off" => Ok(json!(false)),
        _ => match text.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(json!(number)),
            _ => Err(format!("{text:?} is not a number, on or off")),
        },
    }
}

fn text_or_number(text: &str) -> Value {
    serde_json::from_str(text).ok().filter(|value: &Value| !value.is_object()).unwrap_or_else(|| json!(text))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(words: &[&str]) -> Result<Value, String> {
        parse(&words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn words_become_a_condition() {
        assert_eq!(
            words(&[
                "robot=enable",
                "program=none",
                "program-state=running",
                "DO[1]=on",
                "BitInputReg[3].4=1"
            ]),
            Ok(json!({ "robot": "enable", "program": null, "program_state": "running",
                "items": { "DO[1]": true, "BitInputReg[3].4": 1.0 } }))
        );
        assert_eq!(
            words(&["coil:192=1", "register:5=17", "event=program_ended", "event.run=2", "event.program=a"]),
            Ok(json!({ "coil": { "192": 1.0 }, "register": { "5": 17.0 },
                "event": { "event": "program_ended", "run": 2, "program": "a" } }))
        );
        for wrong in ["robot", "DO[1]=x", "coil:1=nan", "DI[1]="] {
            assert!(words(&[wrong]).is_err(), "{wrong}");
        }
    }
}
