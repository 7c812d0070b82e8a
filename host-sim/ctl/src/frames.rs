//! Frames from a gateway's stream.
//!
//! In: the data of an event `frames`. Out: frames as recorded at the ports, with the names given by the gateway.

use std::fmt::Write;

use proto_core::engine::{PortId, Rejection, TapDirection, TapPlace, TapVerdict};
use proto_core::wire::can::CanId;
use recipe_capture::Frame;
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::{Error, StrDeserializer};
use serde_json::{Map, Value};

use crate::reading::number;
use crate::shown;

#[derive(Debug, Clone, Deserialize)]
pub(crate) struct FramesDocument {
    pub(crate) frames: Vec<FrameDocument>,
    /// Number of frames that this client missed before these.
    #[serde(default)]
    pub(crate) lost: u64,
}

#[derive(Debug, Clone, Deserialize)]
pub(crate) struct FrameDocument {
    pub(crate) time_us: u64,
    /// The field port of the frame.
    pub(crate) port: String,
    direction: Direction,
    /// `frame`, or why it was rejected.
    verdict: String,
    /// The rejection in words.
    text: Option<String>,
    /// Hexadecimal digits.
    bytes: String,
    /// The id on CAN.
    id: Option<u32>,
    #[serde(default)]
    extended: bool,
    /// Length in bytes, if not all bytes are present.
    len: Option<usize>,
    /// The name of the frame.
    name: Option<String>,
    values: Option<Map<String, Value>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Direction {
    In,
    Out,
}

impl FrameDocument {
    pub(crate) fn is_in(&self) -> bool {
        self.direction == Direction::In
    }

    /// The bytes; `None` if the text is not hexadecimal.
    pub(crate) fn bytes(&self) -> Option<Vec<u8>> {
        let digits: Option<Vec<u8>> =
            self.bytes.chars().map(|c| c.to_digit(16).map(|digit| digit as u8)).collect();
        let (pairs, rest) = digits.as_deref()?.as_chunks::<2>();
        rest.is_empty().then(|| pairs.iter().map(|[high, low]| high << 4 | low).collect())
    }

    pub(crate) fn can_id(&self) -> Option<CanId> {
        let id = self.id?;
        match self.extended {
            true => Some(CanId::Extended(id & 0x1FFF_FFFF)),
            false => u16::try_from(id).ok().map(CanId::Standard),
        }
    }

    /// Why the frame was rejected; a reason unknown to this program is replaced by a known one.
    fn rejection(&self) -> Option<Rejection> {
        if self.verdict == "frame" {
            return None;
        }
        Some(self.known_rejection().unwrap_or(Rejection::Malformed))
    }

    fn known_rejection(&self) -> Option<Rejection> {
        let name: StrDeserializer<'_, Error> = self.verdict.as_str().into_deserializer();
        Rejection::deserialize(name).ok()
    }

    /// The frame as the engine's tap records it; `None` if it is not valid.
    pub(crate) fn frame(&self, port: PortId) -> Option<Frame> {
        let bytes = self.bytes()?;
        Some(Frame {
            place: TapPlace::Port(port),
            direction: if self.is_in() { TapDirection::In } else { TapDirection::Out },
            verdict: self.rejection().map_or(TapVerdict::Taken, TapVerdict::Rejected),
            can_id: self.can_id(),
            len: self.len.unwrap_or(bytes.len()).max(bytes.len()),
            bytes: bytes.into(),
        })
    }

    /// One line: the direction, names and values or the rejection, and the bytes.
    pub(crate) fn line(&self, decoded: Option<(&str, &Value)>) -> String {
        let mut line = String::from(if self.is_in() { "in   " } else { "out  " });
        let own = self.values.as_ref().map(|values| (self.name.as_deref().unwrap_or_default(), values));
        let decoded = decoded.and_then(|(name, values)| Some((name, values.as_object()?)));
        // Writing to a `String` never fails.
        let _ = match own.or(decoded) {
            Some((name, values)) => {
                let part = name.split_once('/').map_or(name, |(_, rest)| rest);
                let part = part.split_once('/').map_or(part, |(_, rest)| rest);
                let mut words = shown::line(part).into_owned();
                for (name, value) in values {
                    let _ = write!(words, "  {}={}", shown::line(name), shown::line(&number(value)));
                }
                write!(line, "{words}")
            }
            None => {
                let why = match (self.verdict.as_str(), &self.text) {
                    ("frame", _) => String::new(),
                    (_, Some(text)) => format!("rejected: {}: ", shown::line(text)),
                    (_, None) => match self.known_rejection() {
                        Some(why) => format!("rejected: {}: ", why.text()),
                        None => format!("rejected: {}: ", shown::line(&self.verdict)),
                    },
                };
                write!(line, "{why}{}", self.hex())
            }
        };
        line
    }

    /// The bytes in the form that `host-sim decode` takes.
    fn hex(&self) -> String {
        let Some(bytes) = self.bytes() else { return "no bytes".into() };
        match self.can_id() {
            Some(id) => {
                let digits = match id {
                    CanId::Standard(id) => format!("{id:03X}"),
                    CanId::Extended(id) => format!("{id:08X}"),
                };
                bytes.iter().fold(digits + "#", |text, byte| text + &format!("{byte:02X}"))
            }
            None => recipe_doctor::HexBytes(&bytes).to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn frame(json: &str) -> FrameDocument {
        serde_json::from_str(json).unwrap()
    }

    #[test]
    fn frames_are_shown_with_names_or_with_what_was_wrong() {
        let line = |json| frame(json).line(None);
        assert_eq!(
            line(
                r#"{"time_us":7,"port":"a","direction":"in","verdict":"frame","bytes":"ffff01eeee","name":"/a/input","values":{"x":1.5,"y":2}}"#
            ),
            "in   input  x=1.5  y=2"
        );
        assert_eq!(
            line(
                r#"{"time_us":7,"port":"a","direction":"in","verdict":"no_frame","text":"no frame found","bytes":"aa48"}"#
            ),
            "in   rejected: no frame found: AA 48"
        );
        let can =
            frame(r#"{"time_us":7,"port":"a","direction":"out","verdict":"frame","bytes":"ef54","id":2}"#);
        assert_eq!(can.line(None), "out  002#EF54");
        let tapped = can.frame(PortId(3)).unwrap();
        assert_eq!((tapped.can_id, tapped.verdict), (Some(CanId::Standard(2)), TapVerdict::Taken));
        let board = frame(
            r#"{"time_us":7,"port":"a","direction":"in","verdict":"foreign_id","id":1282,"extended":true,"bytes":"01"}"#,
        );
        assert_eq!(board.can_id(), Some(CanId::Extended(0x502)));
        assert_eq!(board.line(None), "in   rejected: a CAN id that the recipe does not have: 00000502#01");
        let newer =
            frame(r#"{"time_us":7,"port":"a","direction":"in","verdict":"new\u001b","bytes":"","len":9}"#);
        assert_eq!(newer.line(None), "in   rejected: new\\u{1b}: ");
        assert_eq!(newer.frame(PortId(0)).unwrap().len, 9);
        for odd in ["0", "xx", "é"] {
            let json =
                format!(r#"{{"time_us":7,"port":"a","direction":"in","verdict":"frame","bytes":"{odd}"}}"#);
            assert!(frame(&json).frame(PortId(0)).is_none());
        }
    }
}
