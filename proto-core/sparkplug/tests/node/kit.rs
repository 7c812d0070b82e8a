//! A plant with two devices, and a server that reads every packet of its node with a reader of its own.

use std::collections::BTreeMap;

use proto_core::time::{Duration, Instant};
use recipe_sparkplug::catalog::{Catalog, Metric, Owner, Report};
use recipe_sparkplug::node::{Credential, EdgeNode, Input, NodeOutput, Settings};
use recipe_sparkplug::topic::Id;
use recipe_sparkplug::value::{DataType, Value};

/// Metrics: of the node `oil` (with a dead band of 0.5) and `count` (at most once a second), of each device `force` and
/// `state`.
#[derive(Debug, Clone)]
pub(crate) struct Plant {
    pub(crate) devices: Vec<&'static str>,
    /// Further metrics of the node, for long births.
    pub(crate) more: usize,
}

impl Default for Plant {
    fn default() -> Self {
        Self { devices: vec!["left", "right"], more: 0 }
    }
}

impl Plant {
    fn name(&self, place: usize) -> (String, DataType) {
        let of_node = 2 + self.more;
        match place {
            0 => ("oil".into(), DataType::Float),
            1 => ("count".into(), DataType::UInt32),
            _ if place < of_node => (format!("more/{place}"), DataType::Double),
            _ if (place - of_node).is_multiple_of(2) => ("force".into(), DataType::Float),
            _ => ("state".into(), DataType::String),
        }
    }

    pub(crate) fn len(&self) -> usize {
        2 + self.more + 2 * self.devices.len()
    }
}

impl Catalog for Plant {
    fn devices(&self) -> usize {
        self.devices.len()
    }

    fn device(&self, nth: usize) -> &str {
        self.devices[nth]
    }

    fn metrics(&self, owner: Owner) -> usize {
        match owner {
            Owner::Node => 2 + self.more,
            Owner::Device(_) => 2,
        }
    }

    fn metric(&self, place: usize) -> Option<Metric<'_>> {
        let (name, data_type) = self.name(place);
        let name = heapless::String::try_from(&*name).unwrap();
        let (unit, range) = if place == 0 { ("°C", Some((-10.0, 150.0))) } else { ("", None) };
        (place < self.len()).then_some(Metric { name, data_type, unit, range, description: "of the press" })
    }

    fn report(&self, place: usize) -> Report {
        match place {
            0 => Report { dead_band: 0.5, ..Report::ALL },
            1 => Report { min_interval: Duration::from_secs(1), ..Report::ALL },
            _ => Report::ALL,
        }
    }
}

/// What a node did.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Did {
    Open,
    Keep(u8),
    Close,
    Connect(Connect),
    Subscribe(Vec<(String, u8)>),
    Publish(Message),
    PubAck(u16),
    Ping,
    Disconnect,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Connect {
    pub(crate) level: u8,
    pub(crate) is_clean: bool,
    pub(crate) client: String,
    pub(crate) keep_alive_s: u16,
    pub(crate) will: Message,
    pub(crate) login: Option<(String, String)>,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Message {
    pub(crate) topic: String,
    pub(crate) qos: u8,
    pub(crate) is_retained: bool,
    pub(crate) payload: Payload,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Payload {
    pub(crate) timestamp: Option<u64>,
    pub(crate) seq: Option<u64>,
    pub(crate) metrics: Vec<Told>,
}

/// A metric that was told.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Told {
    pub(crate) name: Option<String>,
    pub(crate) alias: Option<u64>,
    pub(crate) timestamp: Option<u64>,
    pub(crate) data_type: Option<u64>,
    pub(crate) is_historical: bool,
    pub(crate) is_null: bool,
    pub(crate) properties: BTreeMap<String, String>,
    pub(crate) value: Option<String>,
}

/// A node, its plant, and the time.
pub(crate) struct Rig {
    pub(crate) node: EdgeNode<256, 16>,
    pub(crate) plant: Plant,
    pub(crate) now: Instant,
    pub(crate) until: Instant,
    pub(crate) values: Vec<Option<Value>>,
    pub(crate) alive: u32,
    pub(crate) buffer: usize,
    /// Pieces that were sent at the last drain.
    pub(crate) pieces: usize,
    received: Vec<u8>,
}

pub(crate) fn settings() -> Settings {
    let mut settings = Settings::new(Id::new("hall").unwrap(), Id::new("press").unwrap());
    settings.keep_alive = Duration::from_secs(20);
    settings
}

pub(crate) fn text(text: &str) -> Credential {
    Credential::new(text).unwrap()
}

impl Rig {
    pub(crate) fn new(settings: Settings, plant: Plant) -> Self {
        let node = EdgeNode::new(settings, &plant, None, 7).unwrap();
        let mut values = vec![Some(Value::Float(20.0)), Some(Value::UInt32(1))];
        values.extend(vec![Some(Value::Double(0.25)); plant.more]);
        for _ in &plant.devices {
            values.extend([Some(Value::Float(1.5)), Some(Value::Word("working"))]);
        }
        let (now, alive) = (Instant::from_millis(1_000), (1 << plant.devices.len()) - 1);
        let until = Instant::ZERO;
        let mut rig =
            Self { node, plant, now, until, values, alive, buffer: 4096, pieces: 0, received: vec![] };
        rig.handle(Input::Time { utc_ms: UTC });
        rig.sample();
        rig
    }

    /// A node that is online, after everything that it did for that was looked at.
    pub(crate) fn online() -> Self {
        let mut rig = Self::new(settings(), Plant::default());
        rig.connect();
        rig.subscribed();
        rig
    }

    pub(crate) fn handle(&mut self, input: Input<'_>) {
        self.node.handle(self.now, input, &self.plant);
    }

    pub(crate) fn sample(&mut self) {
        let values = self.values.clone();
        let alive = self.alive;
        self.handle(Input::Sample { values: &values, alive });
    }

    /// Sets a value, and samples.
    pub(crate) fn set(&mut self, place: usize, value: impl Into<Option<Value>>) {
        self.values[place] = value.into();
        self.sample();
    }

    pub(crate) fn wait_ms(&mut self, ms: u64) {
        self.now += Duration::from_millis(ms);
    }

    pub(crate) fn receive(&mut self, bytes: &[u8]) {
        self.handle(Input::Bytes(bytes));
    }

    pub(crate) fn connect(&mut self) -> Connect {
        self.now = self.now.max(self.until);
        assert_eq!(self.drain(), [Did::Open]);
        self.handle(Input::Opened);
        let did = self.drain();
        let [Did::Keep(_), Did::Connect(connect)] = &did[..] else { panic!("{did:?}") };
        self.receive(&[0x20, 2, 0, 0]);
        connect.clone()
    }

    /// From SUBSCRIBE to the births, or to waiting for a host.
    pub(crate) fn subscribed(&mut self) -> Vec<Message> {
        let did = self.drain();
        let [Did::Subscribe(topics)] = &did[..] else { panic!("{did:?}") };
        let mut answer = vec![0x90, 2 + u8::try_from(topics.len()).unwrap(), 0, 1];
        answer.extend(topics.iter().map(|_| 1));
        self.receive(&answer);
        self.messages()
    }

    /// Publications; nothing else may be done.
    #[track_caller]
    pub(crate) fn messages(&mut self) -> Vec<Message> {
        let did = self.drain();
        did.into_iter()
            .map(|did| match did {
                Did::Publish(message) => message,
                other => panic!("{other:?}"),
            })
            .collect()
    }

    pub(crate) fn command(&mut self, topic: &str, metrics: &[(&str, bool)]) {
        let mut payload = vec![0x08, 1];
        for (name, value) in metrics {
            let mut metric = vec![0x0A, u8::try_from(name.len()).unwrap()];
            metric.extend_from_slice(name.as_bytes());
            metric.extend_from_slice(&[0x20, 11, 0x70, (*value).into()]);
            payload.extend_from_slice(&[0x12, u8::try_from(metric.len()).unwrap()]);
            payload.extend_from_slice(&metric);
        }
        self.publication(topic, None, &payload);
    }

    pub(crate) fn publication(&mut self, topic: &str, id: Option<u16>, payload: &[u8]) {
        let mut body = u16::try_from(topic.len()).unwrap().to_be_bytes().to_vec();
        body.extend_from_slice(topic.as_bytes());
        body.extend(id.iter().flat_map(|id| id.to_be_bytes()));
        body.extend_from_slice(payload);
        let mut packet = vec![if id.is_some() { 0x32 } else { 0x30 }];
        let mut len = body.len();
        while len > 127 {
            packet.push(u8::try_from(len & 127).unwrap() | 128);
            len >>= 7;
        }
        packet.push(u8::try_from(len).unwrap());
        packet.extend_from_slice(&body);
        self.receive(&packet);
    }

    /// Everything that it does until it sleeps.
    #[track_caller]
    pub(crate) fn drain(&mut self) -> Vec<Did> {
        let mut done = Vec::new();
        self.pieces = 0;
        for _ in 0..10_000 {
            let mut buf = vec![0xA5; self.buffer];
            match self.node.poll_output(self.now, &self.plant, &mut buf) {
                NodeOutput::Sleep { until } => {
                    assert!(self.received.is_empty(), "a packet that is not whole");
                    assert!(until > self.now, "sleeps until {until:?} at {:?}", self.now);
                    self.until = until;
                    return done;
                }
                NodeOutput::Open => done.push(Did::Open),
                NodeOutput::Keep { bd_seq } => done.push(Did::Keep(bd_seq)),
                NodeOutput::Close => {
                    self.received.clear();
                    done.push(Did::Close);
                }
                // Others run meanwhile.
                NodeOutput::Busy => self.now += Duration::from_millis(1),
                NodeOutput::Send(bytes) => {
                    self.pieces += 1;
                    self.received.extend_from_slice(bytes);
                    while let Some((first, body, len)) = packet(&self.received) {
                        done.push(read(first, body));
                        self.received.drain(..len);
                    }
                }
            }
        }
        panic!("it never sleeps");
    }
}

/// UTC at the beginning.
pub(crate) const UTC: u64 = 1_750_000_000_000;

fn packet(bytes: &[u8]) -> Option<(u8, &[u8], usize)> {
    let (mut len, mut at) = (0, 1);
    loop {
        let byte = *bytes.get(at)?;
        len |= usize::from(byte & 127) << (7 * (at - 1));
        at += 1;
        if byte < 128 {
            break;
        }
    }
    Some((bytes[0], bytes.get(at..at + len)?, at + len))
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, len: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(len);
        self.0 = rest;
        taken
    }

    fn word(&mut self) -> u16 {
        u16::from_be_bytes(self.take(2).try_into().unwrap())
    }

    fn field(&mut self) -> &'a [u8] {
        let len = self.word();
        self.take(len.into())
    }

    fn text(&mut self) -> String {
        String::from_utf8(self.field().to_vec()).unwrap()
    }

    fn varint(&mut self) -> u64 {
        let (mut value, mut shift) = (0, 0);
        loop {
            let byte = self.take(1)[0];
            value |= u64::from(byte & 127) << shift;
            shift += 7;
            if byte < 128 {
                return value;
            }
        }
    }
}

fn read(first: u8, body: &[u8]) -> Did {
    let mut reader = Reader(body);
    let did = match first {
        0x10 => {
            assert_eq!(reader.text(), "MQTT");
            let (level, flags) = (reader.take(1)[0], reader.take(1)[0]);
            let keep_alive_s = reader.word();
            let client = reader.text();
            assert!(flags & 4 != 0, "it has a will");
            let (topic, payload) = (reader.text(), payload(reader.field()));
            let will = Message { topic, qos: flags >> 3 & 3, is_retained: flags & 0x20 != 0, payload };
            let login = (flags & 0xC0 == 0xC0).then(|| (reader.text(), reader.text()));
            Did::Connect(Connect { level, is_clean: flags & 2 != 0, client, keep_alive_s, will, login })
        }
        0x82 => {
            reader.word();
            let mut topics = Vec::new();
            while !reader.0.is_empty() {
                topics.push((reader.text(), reader.take(1)[0]));
            }
            Did::Subscribe(topics)
        }
        0x30..=0x3F => {
            let topic = reader.text();
            let (qos, is_retained) = (first >> 1 & 3, first & 1 != 0);
            assert_eq!(qos, 0);
            let payload = payload(reader.take(reader.0.len()));
            Did::Publish(Message { topic, qos, is_retained, payload })
        }
        0x40 => Did::PubAck(reader.word()),
        0xC0 => Did::Ping,
        0xE0 => Did::Disconnect,
        other => panic!("a packet {other:#x}"),
    };
    assert!(reader.0.is_empty(), "{did:?} has {} bytes more", reader.0.len());
    did
}

enum Field<'a> {
    Number(u64),
    Bytes(&'a [u8]),
    Four([u8; 4]),
    Eight([u8; 8]),
}

fn fields(bytes: &[u8]) -> Vec<(u64, Field<'_>)> {
    let mut reader = Reader(bytes);
    let mut fields = Vec::new();
    while !reader.0.is_empty() {
        let key = reader.varint();
        let field = match key & 7 {
            0 => Field::Number(reader.varint()),
            1 => Field::Eight(reader.take(8).try_into().unwrap()),
            2 => {
                let len = reader.varint();
                Field::Bytes(reader.take(usize::try_from(len).unwrap()))
            }
            5 => Field::Four(reader.take(4).try_into().unwrap()),
            other => panic!("form {other}"),
        };
        fields.push((key >> 3, field));
    }
    fields
}

fn string(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

fn payload(bytes: &[u8]) -> Payload {
    let mut payload = Payload::default();
    for field in fields(bytes) {
        match field {
            (1, Field::Number(timestamp)) => assert!(payload.timestamp.replace(timestamp).is_none()),
            (2, Field::Bytes(bytes)) => payload.metrics.push(metric(bytes)),
            (3, Field::Number(seq)) => assert!(payload.seq.replace(seq).is_none()),
            (other, _) => panic!("field {other} of a payload"),
        }
    }
    payload
}

fn metric(bytes: &[u8]) -> Told {
    let mut told = Told::default();
    for field in fields(bytes) {
        match field {
            (1, Field::Bytes(name)) => told.name = Some(string(name)),
            (2, Field::Number(alias)) => told.alias = Some(alias),
            (3, Field::Number(timestamp)) => told.timestamp = Some(timestamp),
            (4, Field::Number(data_type)) => told.data_type = Some(data_type),
            (5, Field::Number(1)) => told.is_historical = true,
            (7, Field::Number(1)) => told.is_null = true,
            (9, Field::Bytes(set)) => told.properties = properties(set),
            (10 | 11, Field::Number(value)) => told.value = Some(value.to_string()),
            (12, Field::Four(value)) => told.value = Some(f32::from_le_bytes(value).to_string()),
            (13, Field::Eight(value)) => told.value = Some(f64::from_le_bytes(value).to_string()),
            (14, Field::Number(value)) => told.value = Some((value != 0).to_string()),
            (15, Field::Bytes(value)) => told.value = Some(string(value)),
            (other, _) => panic!("field {other} of a metric"),
        }
    }
    told
}

fn properties(bytes: &[u8]) -> BTreeMap<String, String> {
    let (mut keys, mut values) = (Vec::new(), Vec::new());
    for field in fields(bytes) {
        match field {
            (1, Field::Bytes(key)) => keys.push(string(key)),
            (2, Field::Bytes(value)) => values.push(match &fields(value)[..] {
                [(1, Field::Number(12)), (8, Field::Bytes(text))] => string(text),
                [(1, Field::Number(10)), (6, Field::Eight(number))] => {
                    f64::from_le_bytes(*number).to_string()
                }
                _ => panic!("a property of another form"),
            }),
            (other, _) => panic!("field {other} of properties"),
        }
    }
    assert_eq!(keys.len(), values.len());
    keys.into_iter().zip(values).collect()
}

impl Message {
    /// Its metrics as `name or alias = value`.
    pub(crate) fn values(&self) -> Vec<String> {
        let shown = |told: &Told| {
            let name = told.name.clone().or(told.alias.map(|alias| format!("#{alias}"))).unwrap();
            let value = told.value.clone().unwrap_or_else(|| "null".into());
            let past = if told.is_historical { " then" } else { "" };
            format!("{name}={value}{past}")
        };
        self.payload.metrics.iter().map(shown).collect()
    }

    pub(crate) fn metric(&self, name: &str) -> &Told {
        let found = self.payload.metrics.iter().find(|told| told.name.as_deref() == Some(name));
        found.unwrap_or_else(|| panic!("{name} in {self:?}"))
    }
}

pub(crate) fn topics(messages: &[Message]) -> Vec<&str> {
    messages.iter().map(|message| message.topic.as_str()).collect()
}

pub(crate) fn seqs(messages: &[Message]) -> Vec<u64> {
    messages.iter().map(|message| message.payload.seq.unwrap()).collect()
}
