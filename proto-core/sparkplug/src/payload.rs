//! Payloads of Sparkplug B: writes metrics with their properties, and reads commands and the state of a host.
//!
//! The format is message `Payload` of `sparkplug_b.proto`, with its field numbers.

use crate::bytes::ByteWriter;
use crate::protobuf::{self, Malformed, ProtobufField, ProtobufFields};
use crate::value::{DataType, Value};

/// What a birth says about a metric in addition to its name and type.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Details<'a> {
    /// Property `engUnit`, unless it is empty.
    pub unit: &'a str,
    /// Properties `engLow` and `engHigh`.
    pub range: Option<(f64, f64)>,
    /// Property `documentation`, unless it is empty.
    pub description: &'a str,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct PayloadMetric<'a> {
    /// The name, in births only.
    pub name: Option<&'a str>,
    pub alias: Option<u64>,
    /// When the value was sampled, in milliseconds.
    pub timestamp: u64,
    /// The type, in births only.
    pub data_type: Option<DataType>,
    /// Whether the value is historical.
    pub is_historical: bool,
    /// The value; `None` if it is unknown.
    pub value: Option<Value>,
    /// The properties, in births only.
    pub details: Details<'a>,
}

pub(crate) fn begin(out: &mut ByteWriter<'_>, timestamp: u64) {
    protobuf::number(out, 1, timestamp);
}

pub(crate) fn metric(out: &mut ByteWriter<'_>, shown: &PayloadMetric<'_>) {
    protobuf::message(out, 2, |out| body(out, shown));
}

/// Writes the end of a payload: its sequence number.
pub(crate) fn end(out: &mut ByteWriter<'_>, seq: u8) {
    protobuf::number(out, 3, seq.into());
}

pub(crate) fn death(out: &mut ByteWriter<'_>, timestamp: u64, bd_seq: u8) {
    begin(out, timestamp);
    metric(out, &bd_seq_metric(timestamp, bd_seq));
}

/// The metric `bdSeq`, which links a birth to its death.
pub(crate) fn bd_seq_metric(timestamp: u64, bd_seq: u8) -> PayloadMetric<'static> {
    let value = Value::Int64(bd_seq.into());
    plain("bdSeq", timestamp, value)
}

/// A metric of a birth without an alias.
pub(crate) fn plain(name: &'static str, timestamp: u64, value: Value) -> PayloadMetric<'static> {
    PayloadMetric {
        name: Some(name),
        alias: None,
        timestamp,
        data_type: Some(value.data_type()),
        is_historical: false,
        value: Some(value),
        details: Details::default(),
    }
}

fn body(out: &mut ByteWriter<'_>, shown: &PayloadMetric<'_>) {
    if let Some(name) = shown.name {
        protobuf::bytes(out, 1, name.as_bytes());
    }
    if let Some(alias) = shown.alias {
        protobuf::number(out, 2, alias);
    }
    protobuf::number(out, 3, shown.timestamp);
    if let Some(data_type) = shown.data_type {
        protobuf::number(out, 4, data_type as u64);
    }
    if shown.is_historical {
        protobuf::number(out, 5, 1);
    }
    if shown.value.is_none() {
        protobuf::number(out, 7, 1);
    }
    let Details { unit, range, description } = shown.details;
    if !unit.is_empty() || range.is_some() || !description.is_empty() {
        protobuf::message(out, 9, |out| properties(out, &shown.details));
    }
    if let Some(value) = shown.value {
        write_value(out, value);
    }
}

fn write_value(out: &mut ByteWriter<'_>, value: Value) {
    match value {
        // In two's complement.
        Value::Int64(value) => protobuf::number(out, 11, value as u64),
        Value::UInt8(value) => protobuf::number(out, 10, value.into()),
        Value::UInt16(value) => protobuf::number(out, 10, value.into()),
        Value::UInt32(value) => protobuf::number(out, 10, value.into()),
        Value::UInt64(value) => protobuf::number(out, 11, value),
        Value::Float(value) => protobuf::float(out, 12, value),
        Value::Double(value) => protobuf::double(out, 13, value),
        Value::Boolean(value) => protobuf::number(out, 14, value.into()),
        Value::Word(value) => protobuf::bytes(out, 15, value.as_bytes()),
    }
}

/// Writes message `PropertySet`: first all keys, then all values.
fn properties(out: &mut ByteWriter<'_>, details: &Details<'_>) {
    let Details { unit, range, description } = *details;
    let texts = [("engUnit", unit), ("documentation", description)];
    let texts = texts.iter().filter(|(_, text)| !text.is_empty());
    let limits = range.map(|(low, high)| [("engLow", low), ("engHigh", high)]);
    let limits = limits.iter().flatten();
    for (name, _) in texts.clone() {
        protobuf::bytes(out, 1, name.as_bytes());
    }
    for (name, _) in limits.clone() {
        protobuf::bytes(out, 1, name.as_bytes());
    }
    for (_, text) in texts {
        protobuf::message(out, 2, |out| {
            protobuf::number(out, 1, DataType::String as u64);
            protobuf::bytes(out, 8, text.as_bytes());
        });
    }
    for (_, limit) in limits {
        protobuf::message(out, 2, |out| {
            protobuf::number(out, 1, DataType::Double as u64);
            protobuf::double(out, 6, *limit);
        });
    }
}

/// What a command requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Asked {
    pub is_rebirth: bool,
    /// Number of other metrics in the command; none of them is writable.
    pub others: u32,
}

/// Parses the payload of NCMD.
pub(crate) fn command(payload: &[u8]) -> Result<Asked, Malformed> {
    let mut asked = Asked::default();
    for field in ProtobufFields::of(payload) {
        let (2, ProtobufField::Bytes(metric)) = field? else { continue };
        let (mut name, mut is_true) = (None, false);
        for field in ProtobufFields::of(metric) {
            match field? {
                (1, ProtobufField::Bytes(text)) => name = Some(text),
                (14, ProtobufField::Number(value)) => is_true = value != 0,
                _ => {}
            }
        }
        if name == Some(REBIRTH.as_bytes()) {
            asked.is_rebirth |= is_true;
        } else {
            asked.others = asked.others.saturating_add(1);
        }
    }
    Ok(asked)
}

/// The state of a primary host, as it publishes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct HostState {
    /// Whether the host is online.
    pub is_online: bool,
    /// Time stamp of the state in milliseconds.
    pub timestamp: u64,
}

/// Parses the payload of STATE: a JSON object with `online` and `timestamp`. Nested objects and arrays, and escapes in
/// keys, are refused.
pub(crate) fn host_state(payload: &[u8]) -> Option<HostState> {
    let text = core::str::from_utf8(payload).ok()?.trim_ascii();
    let mut rest = text.strip_prefix('{')?.strip_suffix('}')?;
    let (mut is_online, mut timestamp) = (None, None);
    loop {
        let (key, behind) = rest.trim_ascii_start().strip_prefix('"')?.split_once('"')?;
        let behind = behind.trim_ascii_start().strip_prefix(':')?.trim_ascii_start();
        let (value, behind) = match behind.strip_prefix('"') {
            Some(inside) => inside.split_once('"').map(|(_, behind)| ("", behind))?,
            None => {
                let end = behind.find([',', ' ', '\t', '\n', '\r']).unwrap_or(behind.len());
                behind.split_at_checked(end)?
            }
        };
        match key {
            "online" => {
                is_online = Some(match value {
                    "true" => true,
                    "false" => false,
                    _ => return None,
                });
            }
            "timestamp" => timestamp = Some(value.parse().ok()?),
            _ if value.contains(['{', '[', '"']) => return None,
            _ => {}
        }
        let behind = behind.trim_ascii_start();
        match behind.strip_prefix(',') {
            Some(next) => rest = next,
            None if behind.is_empty() => break,
            None => return None,
        }
    }
    Some(HostState { is_online: is_online?, timestamp: timestamp? })
}

/// The one command that is obeyed.
pub(crate) const REBIRTH: &str = "Node Control/Rebirth";

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    fn written(write: impl Fn(&mut ByteWriter<'_>)) -> Vec<u8> {
        let mut buf = [0xA5; 256];
        let mut out = ByteWriter::new(&mut buf);
        write(&mut out);
        out.finish().unwrap().to_vec()
    }

    #[test]
    fn a_death_has_its_bytes() {
        let bytes = written(|out| death(out, 1, 7));
        assert_eq!(bytes, b"\x08\x01\x12\x0d\x0a\x05bdSeq\x18\x01\x20\x04\x58\x07");
    }

    #[test]
    fn an_unknown_value_is_null_and_has_none() {
        let shown = PayloadMetric { value: None, alias: Some(300), ..plain("a", 2, Value::Float(0.0)) };
        let bytes = written(|out| metric(out, &shown));
        assert_eq!(bytes, b"\x12\x0c\x0a\x01a\x10\xac\x02\x18\x02\x20\x09\x38\x01");
    }

    #[test]
    fn properties_have_as_many_keys_as_values() {
        let details = Details { unit: "rad", range: Some((-1.0, 1.0)), description: "joint" };
        let bytes = written(|out| properties(out, &details));
        let fields: Vec<u64> = ProtobufFields::of(&bytes).map(|field| field.unwrap().0).collect();
        assert_eq!(fields, [1, 1, 1, 1, 2, 2, 2, 2]);
    }

    #[test]
    fn only_a_rebirth_that_is_true_is_obeyed() {
        let payload = |name: &'static str, value| {
            written(move |out| {
                begin(out, 5);
                metric(out, &plain(name, 5, value));
            })
        };
        let asked = |bytes: &[u8]| command(bytes).map(|asked| (asked.is_rebirth, asked.others));
        assert_eq!(asked(&payload(REBIRTH, Value::Boolean(true))), Ok((true, 0)));
        assert_eq!(asked(&payload(REBIRTH, Value::Boolean(false))), Ok((false, 0)));
        assert_eq!(asked(&payload(REBIRTH, Value::UInt8(1))), Ok((false, 0)));
        assert_eq!(asked(&payload("Node Control/Reboot", Value::Boolean(true))), Ok((false, 1)));
        assert_eq!(asked(&[]), Ok((false, 0)));
        assert_eq!(asked(&[0x12, 9]), Err(Malformed));
    }

    #[test]
    fn states_of_hosts_are_read_strictly() {
        let read = |text: &str| host_state(text.as_bytes()).map(|state| (state.is_online, state.timestamp));
        assert_eq!(read(r#"{"online":true,"timestamp":17}"#), Some((true, 17)));
        assert_eq!(read("{ \"timestamp\" : 17 ,\n \"online\" : false }"), Some((false, 17)));
        assert_eq!(read(r#"{"name":"a,b","online":true,"timestamp":17}"#), Some((true, 17)));
        for wrong in [
            "",
            "{}",
            "OFFLINE",
            r#"{"online":true}"#,
            r#"{"online":"true","timestamp":17}"#,
            r#"{"online":true,"timestamp":-1}"#,
            r#"{"online":true,"timestamp":17"#,
            r#"{"online":true "timestamp":17}"#,
            r#"{"a":{"online":true,"timestamp":17},"online":false,"timestamp":17}"#,
            r#"{"online":true,"timestamp":17}}"#,
            r#"{"online":true,"timestamp":17,}"#,
        ] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
    }
}
