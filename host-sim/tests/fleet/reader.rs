//! A reader that knows nothing of this repository: messages come by mosquitto's own client, and are decoded by prost
//! with the fields of `sparkplug_b.proto`. It checks every message of every node against those before.

use std::collections::BTreeMap;

use prost::Message;
use recipe_test_kit::{Process, until};

use crate::broker::Plant;

/// Message `Payload` of `sparkplug_b.proto`, without what nobody here sends.
#[derive(Clone, PartialEq, Message)]
pub(crate) struct Payload {
    #[prost(uint64, optional, tag = "1")]
    pub(crate) timestamp: Option<u64>,
    #[prost(message, repeated, tag = "2")]
    pub(crate) metrics: Vec<Metric>,
    #[prost(uint64, optional, tag = "3")]
    pub(crate) seq: Option<u64>,
}

#[derive(Clone, PartialEq, Message)]
pub(crate) struct Metric {
    #[prost(string, optional, tag = "1")]
    pub(crate) name: Option<String>,
    #[prost(uint64, optional, tag = "2")]
    pub(crate) alias: Option<u64>,
    #[prost(uint64, optional, tag = "3")]
    pub(crate) timestamp: Option<u64>,
    #[prost(uint32, optional, tag = "4")]
    pub(crate) datatype: Option<u32>,
    #[prost(bool, optional, tag = "5")]
    pub(crate) is_historical: Option<bool>,
    #[prost(bool, optional, tag = "7")]
    pub(crate) is_null: Option<bool>,
    #[prost(message, optional, tag = "9")]
    pub(crate) properties: Option<PropertySet>,
    #[prost(oneof = "Value", tags = "10, 11, 12, 13, 14, 15")]
    pub(crate) value: Option<Value>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
pub(crate) enum Value {
    #[prost(uint32, tag = "10")]
    Int(u32),
    #[prost(uint64, tag = "11")]
    Long(u64),
    #[prost(float, tag = "12")]
    Float(f32),
    #[prost(double, tag = "13")]
    Double(f64),
    #[prost(bool, tag = "14")]
    Boolean(bool),
    #[prost(string, tag = "15")]
    Text(String),
}

#[derive(Clone, PartialEq, Message)]
pub(crate) struct PropertySet {
    #[prost(string, repeated, tag = "1")]
    pub(crate) keys: Vec<String>,
    #[prost(message, repeated, tag = "2")]
    pub(crate) values: Vec<PropertyValue>,
}

#[derive(Clone, PartialEq, Message)]
pub(crate) struct PropertyValue {
    #[prost(uint32, optional, tag = "1")]
    pub(crate) kind: Option<u32>,
    #[prost(oneof = "PropertyKind", tags = "6, 8")]
    pub(crate) value: Option<PropertyKind>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
pub(crate) enum PropertyKind {
    #[prost(double, tag = "6")]
    Double(f64),
    #[prost(string, tag = "8")]
    Text(String),
}

/// A message of a node.
#[derive(Debug, Clone)]
pub(crate) struct Told {
    pub(crate) verb: String,
    pub(crate) node: String,
    pub(crate) device: Option<String>,
    pub(crate) payload: Payload,
    /// Its metrics by name, those of data by the names of their births; with whether they are historical.
    pub(crate) values: Vec<(String, Option<Value>, bool)>,
}

impl Told {
    pub(crate) fn value(&self, name: &str) -> Option<&Value> {
        self.values.iter().find(|(other, ..)| other == name).and_then(|(_, value, _)| value.as_ref())
    }

    pub(crate) fn metric(&self, name: &str) -> &Metric {
        let metric = self.payload.metrics.iter().find(|metric| metric.name.as_deref() == Some(name));
        metric.unwrap_or_else(|| panic!("{name} in {self:?}"))
    }
}

/// What is known of a node.
#[derive(Debug, Default)]
struct Known {
    seq: Option<u64>,
    bd_seq: Option<u64>,
    /// It does not know UTC: its dates are of 1970.
    is_without_utc: bool,
    /// By alias: the owner, the name and the type.
    aliases: BTreeMap<u64, (Option<String>, String, u32)>,
    alive: Vec<Option<String>>,
}

/// The reader.
pub(crate) struct Reader {
    client: Process,
    read: usize,
    /// Nodes may have been born before it came; it looks at them from their next birth on.
    is_late: bool,
    known: BTreeMap<String, Known>,
    pub(crate) told: Vec<Told>,
}

impl Reader {
    /// A reader whose subscription the broker has accepted.
    #[track_caller]
    pub(crate) fn new(plant: &Plant) -> Self {
        Self::start(plant, false)
    }

    /// Same, of one that comes when nodes are there.
    #[track_caller]
    pub(crate) fn late(plant: &Plant) -> Self {
        Self::start(plant, true)
    }

    #[track_caller]
    fn start(plant: &Plant, is_late: bool) -> Self {
        let mut command = plant.client("mosquitto_sub");
        command.args(["-d", "-V", "mqttv311", "-q", "1", "-t", "spBv1.0/#", "-F", "%t %q %r %x"]);
        let client = Process::start(&mut command);
        until("the reader has subscribed", || {
            client.lines().iter().any(|line| line.starts_with("Subscribed")).then_some(())
        });
        Self { client, read: 0, is_late, known: BTreeMap::new(), told: Vec::new() }
    }

    /// Reads what has come.
    pub(crate) fn read(&mut self) {
        let lines: Vec<_> = self.client.lines().iter().skip(self.read).cloned().collect();
        self.read += lines.len();
        for line in lines.iter().filter(|line| line.starts_with("spBv1.0/")) {
            let parts: Vec<_> = line.split(' ').collect();
            let [topic, qos, retain, hex] = parts[..] else { panic!("{line}") };
            let bytes: Vec<u8> = (0..hex.len())
                .step_by(2)
                .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
                .collect();
            let levels: Vec<_> = topic.split('/').collect();
            if levels[1] == "STATE" || levels[2].ends_with("CMD") {
                continue;
            }
            let payload = Payload::decode(&bytes[..]).unwrap_or_else(|error| panic!("{error}: {line}"));
            // What another program writes of it is the same, so nothing was skipped.
            assert_eq!(payload.encode_to_vec().len(), bytes.len(), "{payload:?}");
            let [_, _, verb, node] = levels[..4] else { panic!("{topic}") };
            let device = levels.get(4).map(|device| (*device).to_owned());
            assert_eq!(
                (levels.len(), device.is_some()),
                (4 + usize::from(device.is_some()), verb.starts_with('D'))
            );
            assert_eq!(retain, "0", "{topic}");
            assert!(qos == "0" || verb == "NDEATH", "{topic} at QoS {qos}");
            let known = self.known.entry(node.to_owned()).or_default();
            if self.is_late && known.bd_seq.is_none() && verb != "NBIRTH" {
                continue;
            }
            let values = known.look(verb, device.clone(), &payload);
            self.told.push(Told { verb: verb.into(), node: node.into(), device, payload, values });
        }
    }

    /// The first message from the `from`th on that satisfies `found`, and its number.
    #[track_caller]
    pub(crate) fn next(&mut self, from: usize, what: &str, found: impl Fn(&Told) -> bool) -> (usize, Told) {
        until(what, || {
            self.read();
            let told = self.told.iter().enumerate().skip(from);
            let mut told = told.filter(|(_, told)| found(told));
            told.next().map(|(at, told)| (at, told.clone()))
        })
    }

    /// Same, for a message with this verb.
    #[track_caller]
    pub(crate) fn verb(&mut self, from: usize, verb: &str) -> (usize, Told) {
        self.next(from, verb, |told| told.verb == verb)
    }
}

impl Known {
    /// Checks a message against those before, and names its values.
    fn look(
        &mut self,
        verb: &str,
        device: Option<String>,
        payload: &Payload,
    ) -> Vec<(String, Option<Value>, bool)> {
        let now =
            std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_millis() as u64;
        let sent = payload.timestamp.expect("a timestamp");
        let utc = payload.metrics.iter().find(|metric| metric.name.as_deref() == Some("Node Info/UTC"));
        let is_without_utc = match (verb, utc) {
            // It was made before the session.
            ("NDEATH", _) => sent < A_DAY_MS,
            (_, Some(utc)) => utc.value == Some(Value::Boolean(false)),
            _ => self.is_without_utc,
        };
        match is_without_utc {
            true => assert!(sent < A_DAY_MS, "{sent} without UTC"),
            false => assert!(sent <= now + 1_000 && sent + 120_000 > now, "{sent} at {now}"),
        }
        if verb == "NDEATH" {
            assert_eq!((payload.seq, payload.metrics.len()), (None, 1));
            if let (Some(born), Some(Value::Long(died))) = (self.bd_seq, &payload.metrics[0].value) {
                // The broker may tell the death of a session after the birth of the next.
                if born == *died {
                    *self = Self::default();
                }
            }
            return named(&payload.metrics);
        }
        let seq = payload.seq.expect("a sequence number");
        if verb == "NBIRTH" {
            assert_eq!(seq, 0);
            *self = Self { is_without_utc, ..Self::default() };
            let bd_seq = payload.metrics.iter().find(|metric| metric.name.as_deref() == Some("bdSeq"));
            let Some(Value::Long(bd_seq)) = bd_seq.unwrap().value else { panic!("bdSeq is no Int64") };
            self.bd_seq = Some(bd_seq);
        } else {
            assert_eq!(Some(seq), self.seq.map(|last| (last + 1) % 256), "{verb} {device:?}");
        }
        self.seq = Some(seq);
        match verb {
            "NBIRTH" | "DBIRTH" => {
                self.alive.push(device.clone());
                for metric in &payload.metrics {
                    let name = metric.name.clone().expect("a name");
                    let datatype = metric.datatype.expect("a type");
                    assert_eq!(metric.is_null == Some(true), metric.value.is_none(), "{metric:?}");
                    assert!(metric.value.iter().all(|value| fits(datatype, value)), "{metric:?}");
                    if let Some(properties) = &metric.properties {
                        assert_eq!(properties.keys.len(), properties.values.len());
                        assert!(
                            properties
                                .values
                                .iter()
                                .all(|value| value.kind.is_some() && value.value.is_some())
                        );
                    }
                    if let Some(alias) = metric.alias {
                        let before = self.aliases.insert(alias, (device.clone(), name, datatype));
                        // A device may be born again.
                        assert!(before.is_none_or(|(owner, ..)| owner == device && device.is_some()));
                    }
                }
                named(&payload.metrics)
            }
            "DDEATH" => {
                assert!(self.alive.contains(&device));
                self.alive.retain(|other| *other != device);
                Vec::new()
            }
            "NDATA" | "DDATA" => {
                assert!(self.alive.contains(&device), "{device:?} tells without a birth");
                let of = |metric: &Metric| {
                    assert!(metric.name.is_none() && metric.datatype.is_none() && metric.timestamp.is_some());
                    let (owner, name, datatype) = &self.aliases[&metric.alias.expect("an alias")];
                    assert_eq!(*owner, device);
                    assert!(metric.value.iter().all(|value| fits(*datatype, value)), "{metric:?}");
                    (name.clone(), metric.value.clone(), metric.is_historical == Some(true))
                };
                payload.metrics.iter().map(of).collect()
            }
            other => panic!("{other}"),
        }
    }
}

fn named(metrics: &[Metric]) -> Vec<(String, Option<Value>, bool)> {
    let of = |metric: &Metric| (metric.name.clone().unwrap(), metric.value.clone(), false);
    metrics.iter().map(of).collect()
}

/// More than a machine runs in a test.
const A_DAY_MS: u64 = 86_400_000;

/// Whether a value is in the field for its type.
fn fits(datatype: u32, value: &Value) -> bool {
    match datatype {
        1..=3 | 5..=7 => matches!(value, Value::Int(_)),
        4 | 8 => matches!(value, Value::Long(_)),
        9 => matches!(value, Value::Float(_)),
        10 => matches!(value, Value::Double(_)),
        11 => matches!(value, Value::Boolean(_)),
        12 => matches!(value, Value::Text(_)),
        _ => false,
    }
}
