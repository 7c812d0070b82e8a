//! A broker, a time server and a device simulated by the test; the first two have the controller's address. Messages
//! are parsed here independently of `recipe-sparkplug`.

use recipe_chip_model::device::{MILLI, Picos};
use recipe_chip_model::models::line::Format;
use smoltcp::iface::SocketHandle;
use smoltcp::socket::{tcp, udp};

use crate::Bench;
use crate::client::connection;

const FORMAT: Format = Format { baud: 115_200, odd_parity: None, stop_bits: 1 };

/// How a broker behaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BrokerMode {
    /// It follows the protocol.
    Well,
    /// It refuses CONNECT with this code.
    Refuses(u8),
    /// It accepts everything and never replies.
    Silent,
    /// It replies with bytes that are not MQTT.
    Garbage,
    /// It refuses connections.
    Gone,
    /// It accepts connections and reads nothing.
    Full,
}

/// A publication.
#[derive(Debug, Clone)]
pub(crate) struct EdgeMessages {
    pub(crate) topic: String,
    pub(crate) metrics: Vec<Metric>,
    pub(crate) seq: Option<u64>,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Metric {
    pub(crate) name: Option<String>,
    pub(crate) alias: Option<u64>,
    pub(crate) is_historical: bool,
    pub(crate) is_null: bool,
    /// A number, the bits of a float, or true and false.
    pub(crate) value: Option<u64>,
    pub(crate) text: Option<String>,
}

pub(crate) struct Broker {
    listening: SocketHandle,
    datagrams: SocketHandle,
    pub(crate) mood: BrokerMode,
    bytes: Vec<u8>,
    pub(crate) told: Vec<EdgeMessages>,
    /// User, password and bdSeq of the will of each CONNECT.
    pub(crate) connects: Vec<(String, String, u64)>,
    pub(crate) pings: usize,
    /// Time of the server in milliseconds since 1970; `None`: it does not reply.
    pub(crate) utc_ms: Option<u64>,
    /// What the device on the line sends every 17 ms; `None`: nothing.
    pub(crate) device: Option<u8>,
    device_at: Picos,
}

impl Broker {
    pub(crate) fn new(bench: &mut Bench) -> Self {
        let robot = bench.robot.as_mut().expect("there is one");
        Self {
            listening: robot.add_server(),
            datagrams: robot.add_datagrams(123),
            mood: BrokerMode::Well,
            bytes: Vec::new(),
            told: Vec::new(),
            connects: Vec::new(),
            pings: 0,
            utc_ms: None,
            device: None,
            device_at: 0,
        }
    }

    /// Resets the connection, like a killed broker.
    pub(crate) fn kill(&mut self, bench: &mut Bench) {
        connection(bench, self.listening).abort();
        self.bytes.clear();
    }

    pub(crate) fn is_connected(&self, bench: &mut Bench) -> bool {
        connection(bench, self.listening).may_send()
    }

    /// Sends a publication at QoS 1.
    pub(crate) fn publish(&self, bench: &mut Bench, topic: &str, payload: &[u8]) {
        let mut body = (topic.len() as u16).to_be_bytes().to_vec();
        body.extend(topic.as_bytes());
        body.extend([0, 7]);
        body.extend(payload);
        let mut packet = vec![0x32, body.len() as u8];
        packet.extend(body);
        connection(bench, self.listening).send_slice(&packet).expect("there is a connection");
    }

    pub(crate) fn go_on(&mut self, bench: &mut Bench) {
        self.tell_time(bench);
        let now = bench.now();
        if let Some(value) = self.device.filter(|_| now >= self.device_at) {
            bench.chip.devices().usart2.line.send(now, &[255, 255, value, 0, 7, 238, 238], FORMAT);
            // No multiple of the 4 ms in which the board speaks on the same line.
            self.device_at = now + 17 * MILLI;
        }
        let mood = self.mood;
        let socket = connection(bench, self.listening);
        if !socket.is_open() {
            self.bytes.clear();
            if mood != BrokerMode::Gone {
                socket.listen(1883).expect("it is closed");
            }
            return;
        }
        if !socket.may_recv()
            && socket.state() != tcp::State::Listen
            && socket.state() != tcp::State::SynReceived
        {
            socket.abort();
            return;
        }
        match mood {
            BrokerMode::Full => return,
            BrokerMode::Garbage if socket.can_recv() => {
                let _ = socket.recv(|bytes| (bytes.len(), ()));
                let _ = socket.send_slice(&[0xA5; 700]);
                return;
            }
            _ => {}
        }
        let mut bytes = [0; 4096];
        let count = socket.recv_slice(&mut bytes).unwrap_or(0);
        self.bytes.extend_from_slice(&bytes[..count]);
        while let Some((first, body)) = packet(&mut self.bytes) {
            let answer: &[u8] = match first >> 4 {
                1 => {
                    self.connects.push(connect(&body));
                    match mood {
                        BrokerMode::Refuses(code) => &[0x20, 2, 0, code],
                        _ => &[0x20, 2, 0, 0],
                    }
                }
                8 => &[0x90, 3, body[0], body[1], 1],
                12 => {
                    self.pings += 1;
                    &[0xD0, 0]
                }
                3 => {
                    self.told.push(told(&body));
                    &[]
                }
                _ => &[],
            };
            if mood != BrokerMode::Silent {
                let _ = connection(bench, self.listening).send_slice(answer);
            }
        }
    }

    fn tell_time(&self, bench: &mut Bench) {
        let socket: &mut udp::Socket<'_> = bench.robot.as_mut().expect("there is one").udp(self.datagrams);
        let mut request = [0; 128];
        while let Ok((len, from)) = socket.recv_slice(&mut request) {
            let Some(utc_ms) = self.utc_ms.filter(|_| len == 48) else { continue };
            let mut reply = [0; 48];
            (reply[0], reply[1]) = (0x24, 1);
            reply[24..32].copy_from_slice(&request[40..48]);
            let seconds = (utc_ms / 1_000 + 2_208_988_800) as u32;
            reply[40..44].copy_from_slice(&seconds.to_be_bytes());
            socket.send_slice(&reply, from).expect("there is room");
        }
    }
}

/// The next whole packet.
fn packet(bytes: &mut Vec<u8>) -> Option<(u8, Vec<u8>)> {
    let (mut len, mut at) = (0_usize, 1);
    loop {
        let byte = *bytes.get(at)?;
        len |= usize::from(byte & 0x7F) << (7 * (at - 1));
        at += 1;
        if byte & 0x80 == 0 {
            break;
        }
    }
    let body = bytes.get(at..at + len)?.to_vec();
    let first = bytes[0];
    bytes.drain(..at + len);
    Some((first, body))
}

fn text<'b>(rest: &mut &'b [u8]) -> &'b [u8] {
    let len = usize::from(u16::from_be_bytes([rest[0], rest[1]]));
    let text = &rest[2..2 + len];
    *rest = &rest[2 + len..];
    text
}

fn connect(body: &[u8]) -> (String, String, u64) {
    let mut rest = body;
    assert_eq!(text(&mut rest), b"MQTT");
    assert_eq!(rest[0], 4);
    let has_login = rest[1] & 0xC0 == 0xC0;
    rest = &rest[4..];
    text(&mut rest);
    assert!(text(&mut rest).starts_with(b"spBv1.0/hall/NDEATH/"));
    let (metrics, _) = payload(text(&mut rest));
    let number = metrics[0].value.expect("it has a number");
    let mut word = || String::from_utf8(text(&mut rest).to_vec()).expect("a text");
    let (user, password) = if has_login { (word(), word()) } else { Default::default() };
    (user, password, number)
}

fn told(body: &[u8]) -> EdgeMessages {
    let mut rest = body;
    let topic = String::from_utf8(text(&mut rest).to_vec()).expect("a text");
    let (metrics, seq) = payload(rest);
    EdgeMessages { topic, metrics, seq }
}

fn payload(bytes: &[u8]) -> (Vec<Metric>, Option<u64>) {
    let (mut metrics, mut seq) = (Vec::new(), None);
    for (field, value) in fields(bytes) {
        match (field, value) {
            (2, Field::Bytes(bytes)) => {
                let mut metric = Metric::default();
                for field in fields(bytes) {
                    let word = |bytes: &[u8]| Some(String::from_utf8(bytes.to_vec()).expect("a text"));
                    match field {
                        (1, Field::Bytes(name)) => metric.name = word(name),
                        (2, Field::Number(alias)) => metric.alias = Some(alias),
                        (5, Field::Number(1)) => metric.is_historical = true,
                        (7, Field::Number(1)) => metric.is_null = true,
                        (10..=14, Field::Number(value)) => metric.value = Some(value),
                        (15, Field::Bytes(text)) => metric.text = word(text),
                        _ => {}
                    }
                }
                metrics.push(metric);
            }
            (3, Field::Number(number)) => seq = Some(number),
            _ => {}
        }
    }
    (metrics, seq)
}

enum Field<'b> {
    Number(u64),
    Bytes(&'b [u8]),
}

fn fields(mut rest: &[u8]) -> Vec<(u64, Field<'_>)> {
    let mut all = Vec::new();
    while !rest.is_empty() {
        let key = varint(&mut rest);
        let field = match key & 7 {
            0 => Field::Number(varint(&mut rest)),
            form @ (1 | 5) => {
                let (bytes, behind) = rest.split_at(if form == 1 { 8 } else { 4 });
                rest = behind;
                Field::Number(bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte)))
            }
            2 => {
                let len = varint(&mut rest) as usize;
                let (bytes, behind) = rest.split_at(len);
                rest = behind;
                Field::Bytes(bytes)
            }
            form => panic!("form {form}"),
        };
        all.push((key >> 3, field));
    }
    all
}

fn varint(rest: &mut &[u8]) -> u64 {
    let mut value = 0;
    for shift in (0..).step_by(7) {
        let byte = rest[0];
        *rest = &rest[1..];
        value |= u64::from(byte & 0x7F) << shift;
        if byte & 0x80 == 0 {
            break;
        }
    }
    value
}
