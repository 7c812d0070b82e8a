//! Decodes frames to values by name, for recordings and live views.
//!
//! In: a frame of a port, and the frames of the file that the gateway runs. Out: the kind of the frame, and its values
//! as JSON. Names are those of `recipe_export::names`.

use proto_core::device::{Element, Kind};
use proto_core::engine::TapDirection;
use proto_core::modbus::adu::HEADER_LEN;
use proto_core::modbus::rtu;
use proto_core::sysvar::Direction;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::{Scalar, ScalarType};
use recipe_export::names::mangle;
use recipe_export::{BusModel, Format, Model, describe_use, unit_of};
use serde_json::{Map, Value, json};

use crate::frame::Frame;

/// Decodes the frames of a file; the default decoder knows no frames.
#[derive(Debug, Clone, Default)]
pub struct Decoder {
    ports: Vec<PortTopics>,
}

#[derive(Debug, Clone)]
struct PortTopics {
    name: String,
    is_modbus_tcp: bool,
    topics: Vec<Topic>,
}

/// Frames of one kind at one port.
#[derive(Debug, Clone)]
pub struct Topic {
    /// Port, part and, on CAN, id: `/rs485__1/input`, `/hand/input/502`.
    pub name: String,
    /// The recipe, and the purpose of the frame.
    pub title: String,
    /// JSON Schema of the values.
    pub schema: Value,
    format: Format,
    names: Vec<Option<String>>,
}

impl Decoder {
    /// A decoder for the frames of this file's ports.
    pub fn new(model: &Model) -> Self {
        let ports = model.ports.iter().map(|port| {
            let recipe = model.recipe_of(port);
            let formats = recipe.map_or(&[][..], |recipe| &recipe.formats);
            let several = |format: &Format| {
                formats.iter().filter(|other| (other.role, other.id) == (format.role, format.id)).count() > 1
            };
            let topics =
                formats.iter().enumerate().filter(|(_, format)| !format.is_remote).map(|(nth, format)| {
                    let mut name = format!("/{}/{}", mangle(&port.name), mangle(&format.role.name()));
                    name += &match format.id {
                        None => String::new(),
                        Some(CanId::Standard(id)) => format!("/{id:03X}"),
                        Some(CanId::Extended(id)) => format!("/{id:08X}"),
                    };
                    // Frames that differ only in constants.
                    if several(format) {
                        name += &format!("/{nth}");
                    }
                    let recipe = recipe.map_or("", |recipe| &recipe.name);
                    Topic::new(name, format!("{recipe} {}", format.role.name()), format)
                });
            PortTopics {
                name: port.name.clone(),
                is_modbus_tcp: matches!(port.bus, BusModel::ModbusTcp),
                topics: topics.collect(),
            }
        });
        Self { ports: ports.collect() }
    }

    /// The values of a frame of a port; `None` if the file has no such frame.
    pub fn decode(&self, port: &str, frame: &Frame) -> Option<(&Topic, Value)> {
        let direction = match frame.direction {
            TapDirection::In => Direction::Input,
            TapDirection::Out => Direction::Output,
        };
        let port = self.ports.iter().find(|own| own.name == port)?;
        let of_line = if port.is_modbus_tcp { Some(as_on_line(frame)?) } else { None };
        let frame = of_line.as_ref().unwrap_or(frame);
        let topics = port.topics.iter().filter(|topic| topic.format.direction == direction);
        topics.filter_map(|topic| Some((topic, topic.values(frame)?))).next()
    }
}

/// A frame of Modbus TCP in the form of a serial line, which the file's frames have.
fn as_on_line(frame: &Frame) -> Option<Frame> {
    let mut bytes = frame.bytes.get(HEADER_LEN - 1..).filter(|_| frame.len == frame.bytes.len())?.to_vec();
    bytes.extend(rtu::checksum(&bytes).to_le_bytes());
    Some(Frame { len: bytes.len(), bytes: bytes.into(), ..frame.clone() })
}

impl Topic {
    fn new(name: String, title: String, format: &Format) -> Self {
        let mut names = vec![None; format.frame.elements.len()];
        let mut properties = Map::new();
        for (field, element) in format.named_values() {
            let identifier = mangle(field.name());
            let mut property = json!({ "title": field.name(), "type": json_type(element) });
            let unit = field.system.map_or("", unit_of);
            let words = [unit.to_owned(), describe_use(field)];
            let words: Vec<_> = words.into_iter().filter(|word| !word.is_empty()).collect();
            if !words.is_empty() {
                property["description"] = words.join("; ").into();
            }
            properties.insert(identifier.clone(), property);
            if let Some(slot) = field.element.and_then(|nth| names.get_mut(nth)) {
                *slot = Some(identifier);
            }
        }
        let schema = json!({ "type": "object", "title": title, "properties": properties });
        Self { name, title, schema, format: format.clone(), names }
    }

    /// The values of a frame, if it has this format.
    fn values(&self, frame: &Frame) -> Option<Value> {
        if frame.len != frame.bytes.len() {
            return None;
        }
        let bytes = self.format.take(frame.can_id, &frame.bytes)?;
        let (layout, elements) = (&self.format.frame.layout, &self.format.frame.elements);
        let mut values = Map::new();
        for (nth, (read, name)) in layout.values(elements, &bytes).zip(&self.names).enumerate() {
            let Some(name) = name else { continue };
            let value = match read.ok()? {
                Some(scalar) => to_json(scalar),
                None => match elements.get(nth)? {
                    Element::Fixed { value, .. } => (*value).into(),
                    _ => match layout.text(elements, &bytes, nth) {
                        Some(text) => String::from_utf8_lossy(text).into_owned().into(),
                        None => continue,
                    },
                },
            };
            values.insert(name.clone(), value);
        }
        Some(values.into())
    }
}

fn json_type(element: &Element) -> &'static str {
    match element.encoding().map(|encoding| encoding.kind) {
        None => "string",
        Some(Kind::Scalar(ScalarType::Float | ScalarType::Double) | Kind::Decimal(_)) => "number",
        Some(_) => "integer",
    }
}

/// A number; null for infinities and NaN.
fn to_json(scalar: Scalar) -> Value {
    match scalar {
        Scalar::Float(_) | Scalar::Double(_) => json!(scalar.as_f64()),
        // All integers are exact in a binary64 float.
        _ => json!(scalar.as_f64() as i64),
    }
}

#[cfg(test)]
mod tests {
    use proto_core::engine::{PortId, TapPlace, TapVerdict};
    use recipe_test_kit::{example, repository};

    use super::*;

    #[track_caller]
    fn decoded(file: &str, port: &str, direction: TapDirection, id: Option<u16>, bytes: &[u8]) -> String {
        let path = match file.strip_prefix("templates/") {
            Some(file) => repository().join("host-sim/templates").join(file),
            None => example(file),
        };
        let model = Model::load(&path, &[]).unwrap();
        let frame = Frame {
            place: TapPlace::Port(PortId(0)),
            direction,
            verdict: TapVerdict::Taken,
            can_id: id.map(CanId::Standard),
            len: bytes.len(),
            bytes: bytes.into(),
        };
        let decoder = Decoder::new(&model);
        let found = decoder.decode(port, &frame);
        found.map_or("none".into(), |(topic, values)| format!("{} {values}", topic.name))
    }

    #[test]
    fn frames_of_every_kind_have_their_values_by_name() {
        use TapDirection::{In, Out};
        assert_eq!(
            decoded("can-hand.toml", "hand", In, Some(0x502), &[1, 2, 0x10, 0x27]),
            r#"/hand/input/502 {"error":2,"grip":10000,"state":1}"#
        );
        assert_eq!(
            decoded("can-hand.toml", "hand", Out, Some(0x501), &[1, 2, 3, 4, 5, 6]),
            r#"/hand/output/501 {"index":3,"little":6,"middle":4,"ring":5,"thumb":1,"thumb__turn":2}"#
        );
        assert_eq!(
            decoded("rs485-system.toml", "rs485-1", In, None, &[0xFF, 0xFF, 1, 0xEE, 0xEE]),
            r#"/rs485__1/input {"DigitalOutputCommand_1_":1}"#
        );
        assert_eq!(decoded("rs485-system.toml", "rs485-1", In, None, &[0xFF, 0xFF, 1, 0xEE]), "none");
        assert_eq!(decoded("can-hand.toml", "hand", In, Some(0x501), &[1, 2, 3, 4, 5, 6]), "none", "its own");
    }

    #[test]
    fn a_slave_sends_refusals_and_a_master_receives_them() {
        use TapDirection::{In, Out};
        let refused = [0x05, 0x90, 0x02, 0x8C, 0x00];
        assert_eq!(
            decoded("templates/siemens-s7-1200.toml", "plc", Out, None, &refused),
            r#"/plc/refusal__1 {"code":2,"function":144,"slave":5}"#
        );
        assert_eq!(decoded("templates/siemens-s7-1200.toml", "plc", In, None, &refused), "none", "its own");
    }
}
