//! `[controller]`, `[network]` and `[[port]]` of gateway files.

use proto_core::config::{
    Bus, Echo, MAX_ADDRESS, MAX_LINE_TIME, MAX_LISTEN, MIN_CYCLE, Parity, Port, PortValue, Rs485,
};
use proto_core::wire::dialect::Dialect;

use super::{Case, HOUR_MS, Key, KeyTable, Limits, Shape, TextKind, When, ms, words};

/// The controller's dialect.
pub const DIALECT: Key = Key::words("dialect", || Dialect::NAMES.to_vec())
    .or_word("v2.3")
    .is("the dialect of the state stream and of Modbus");
const ADDRESS: Key = Key::text_of("address", TextKind::Length(1, MAX_ADDRESS)).required().tells(
    "IP address or host name; listening ports accept only this address and the host they are on. A name whose last \
     part is a number is no host name, so it must be an address",
);

pub(crate) const COMMAND: Key = server("command", 2000, "the server of commands");
pub(crate) const STATE: Key = server("state", 2001, "the state stream");
pub(crate) const MODBUS: Key = server("modbus", 502, "Modbus TCP");
pub(crate) const UDP2011: Key = server(
    "udp2011",
    2011,
    "the UDP server of recipes. Refused if `recipe_link.udp` is another one, unless one of the two is given with `--set`",
);

const fn server(name: &'static str, port: i64, text: &'static str) -> Key {
    Key::integer(name, 1, 65_535).or(port).is(text)
}

/// The controller's ports.
pub const PORTS: KeyTable = KeyTable::of("ports", &[COMMAND, STATE, MODBUS, UDP2011]);

/// The recipe of a link.
pub const LINK_RECIPE: Key = Key::text_of("recipe", TextKind::Any)
    .required()
    .tells("the realtime stream recipe that is set for the controller's UDP server");
/// The port of a link.
pub const LINK_UDP: Key =
    Key::integer("udp", 1, 65_535).absent("that of `ports.udp2011`").is("the UDP server's port");

/// The link to the controller's UDP server.
pub const RECIPE_LINK: KeyTable = KeyTable::of("recipe link", &[LINK_UDP, LINK_RECIPE]);

/// `[controller]`.
pub const CONTROLLER: KeyTable = KeyTable::of(
    "controller",
    &[
        ADDRESS,
        DIALECT,
        Key::new("ports", Shape::Table(&PORTS)).absent("").tells("the controller's ports, see below"),
        Key::new("recipe_link", Shape::Table(&RECIPE_LINK)).tells("a fast way up, see below"),
    ],
);

const IPV4: TextKind = TextKind::Pattern("^[0-9]+\\.[0-9]+\\.[0-9]+\\.[0-9]+$");

/// `[network]`.
pub const NETWORK: KeyTable = KeyTable::of(
    "network",
    &[
        Key::text_of("address", TextKind::Pattern("^[0-9]+\\.[0-9]+\\.[0-9]+\\.[0-9]+/[0-9]+$"))
            .required()
            .tells("the board's IPv4 address and network prefix length, 1..=30: `\"192.168.12.20/24\"`"),
        Key::text_of("router", IPV4)
            .tells("the gateway to other networks; required if the controller or `dns` is in another one"),
        Key::text_of("dns", IPV4).tells("the name server; required if the controller's `address` is a name"),
    ],
);

/// The name of a recipe or port.
pub const NAME: Key = Key::text_of("name", TextKind::Name).required().tells(
    "1..=32 bytes without blanks, quotes, `=` and control characters; unique. `--bind` and `--set` use it",
);
/// What a port of a gateway is.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum BusKind {
    Rs485,
    ModbusMaster,
    ModbusSlave,
    ModbusTcp,
    Can,
    TcpListen,
    UdpListen,
}

/// The words of `bus`.
pub(crate) const BUSES: [(&str, BusKind); 7] = [
    ("rs485", BusKind::Rs485),
    ("modbus-rtu", BusKind::ModbusMaster),
    ("modbus-rtu-slave", BusKind::ModbusSlave),
    ("modbus-tcp", BusKind::ModbusTcp),
    ("can", BusKind::Can),
    ("tcp-listen", BusKind::TcpListen),
    ("udp-listen", BusKind::UdpListen),
];

impl BusKind {
    /// As files have it.
    pub(crate) fn name(self) -> &'static str {
        BUSES.iter().find(|(_, bus)| *bus == self).map_or("", |(name, _)| name)
    }
}
/// What a port is.
pub const BUS: Key = Key::words("bus", words!(BUSES)).required().tells(
    "`\"rs485\"`, `\"can\"`: devices; `\"modbus-rtu\"`, `\"modbus-rtu-slave\"`: a serial line for a recipe of this \
     `kind`, with the keys of `rs485`; `\"modbus-tcp\"`: devices that the gateway connects to, for a recipe with `kind = \
     \"modbus-rtu\"`; `\"tcp-listen\"`, `\"udp-listen\"`: what the controller's TCP or UDP client \
     connects to",
);
/// The recipe of a port.
pub const RECIPE: Key =
    Key::text_of("recipe", TextKind::Any).required().tells("name of a recipe of this file");
/// The period of the output.
pub const CYCLE: Key = Key::millis("cycle_ms", Limits::Within(ms(MIN_CYCLE), HOUR_MS))
    .or_time(MIN_CYCLE)
    .is("how often the output part is sent");
/// When inputs are overdue.
pub const TIMEOUT: Key =
    Key::new("timeout_ms", Shape::Either(&[Shape::Number(Limits::AboveZero(HOUR_MS)), Shape::Words(|| vec!["never"])]))
        .unit("ms")
        .or_time(Port::TIMEOUT)
        .is("after this time without a valid frame the port's inputs take their safe values. `\"never\"`: for devices \
             that send only events, as scanners do; see below");
/// When outputs are stale.
pub const STALE_AFTER: Key = Key::millis("stale_after_ms", Limits::AboveZero(HOUR_MS))
    .or_time(Port::STALE_AFTER)
    .is("an output with an older source is stale");
/// What inputs become.
pub const ON_TIMEOUT: Key = Key::new(
    "on_timeout",
    Shape::Either(&[
        Shape::Words(|| vec!["hold"]),
        Shape::Map(&Shape::Either(&[Shape::Number(Limits::Any), Shape::Bool]), 0),
    ]),
)
.or_word("hold")
.tells(
    "`\"hold\"`, or safe values such as `{ \"DigitalOutputCommand[1]\" = 0 }`, of bits 0, 1, `false` or `true`: \
     `{ \"BitInputReg[3].4\" = 0 }`; other variables and bits hold. Not on listening ports",
);
/// Safe values before the first frame.
pub const SAFE_AT_START: Key = Key::bool("safe_at_start").tells(
    "`true`: the safe values are written from the start until the device speaks, also if it never does. Needs \
     `on_timeout` with values",
);
/// Outputs that are sent again.
pub const REFRESH: Key = Key::millis("refresh_ms", Limits::AboveZero(HOUR_MS)).is(
    "an output part with `send = \"change\"` is sent again after this time without a change, for a device that is \
     powered later",
);
/// The variables of a port's health.
pub const HEALTH_TABLE: KeyTable = KeyTable::of(
    "health",
    &[
        health(PortValue::NAMES[0].0, "1 while the device is there and no frame is overdue"),
        health(PortValue::NAMES[1].0, "frames accepted"),
        health(PortValue::NAMES[2].0, "milliseconds since the newest one"),
        health(PortValue::NAMES[3].0, "frames rejected"),
        health(PortValue::NAMES[4].0, "frames with a text that is ignored"),
    ],
);
/// Where a port's health goes.
pub const HEALTH: Key = Key::new("health", Shape::Table(&HEALTH_TABLE)).tells(
    "variables that tell the robot the port's health: `{ alive = \"WordInputReg[20]\", frames = ..., age_ms = ..., \
     rejected = ..., ignored = ... }`; `WordInputReg` and `FloatInputReg` only. The port owns them. Not on listening ports",
);

const fn health(name: &'static str, text: &'static str) -> Key {
    Key::text_of(name, TextKind::Variable).is(text)
}

/// Speed of a serial line.
pub const BAUD: Key = Key::integer("baud", *Rs485::BAUD.start() as i64, *Rs485::BAUD.end() as i64)
    .unit("bit/s")
    .or(Rs485::DEFAULT.baud as i64)
    .is("(`rs485`)");
/// The words of `parity`.
pub(crate) const PARITIES: [(&str, Parity); 3] =
    [("none", Parity::None), ("even", Parity::Even), ("odd", Parity::Odd)];
/// Parity.
pub const PARITY: Key = Key::words("parity", words!(PARITIES)).or_word("none").is("(`rs485`)");
/// Stop bits.
pub const STOP_BITS: Key =
    Key::integer("stop_bits", *Rs485::STOP_BITS.start() as i64, *Rs485::STOP_BITS.end() as i64)
        .or(Rs485::DEFAULT.stop_bits as i64)
        .is("(`rs485`)");
/// The silence that drops a partial frame.
pub const IDLE_GAP: Key = Key::millis("idle_gap_ms", Limits::AboveZero(ms(MAX_LINE_TIME))).or_time(Rs485::DEFAULT.idle_gap).is(
    "a partial frame is dropped after this silence (`rs485`). Of a Modbus slave it ends each request, and the default \
     is 3.5 characters, or 1.75 above 19200 bit/s",
);
/// The silence before sending.
pub const TURNAROUND: Key =
    Key::new("turnaround_us", Shape::Number(Limits::Within(0.0, MAX_LINE_TIME.as_micros() as f64))).unit("µs").or(Rs485::DEFAULT.turnaround.as_micros() as i64).is(
        "silence before the port sends (`rs485`). On lines of Modbus the default is 3.5 characters, or 1750 above \
         19200 bit/s",
    );
/// Whether the adapter hears itself.
pub const ECHO: Key = Key::new("echo", Shape::Either(&[Shape::Bool, Shape::Words(words!(ECHOES))])).or_word("auto").tells(
    "`true`: the adapter gives back what is sent, as one with two wires does whose receiver is always on. Only with a \
     recipe of exchanges. `\"auto\"`: learned from an exchange whose reply differs from its request, each time that the \
     line is opened; until then a reply that equals its request confirms nothing (`rs485`)",
);
/// The words of `echo`.
pub(crate) const ECHOES: [(&str, Echo); 1] = [("auto", Echo::Auto)];
/// When a device has started anew.
pub const ABSENT: Key = Key::millis("absent_ms", Limits::AboveZero(HOUR_MS)).or_time(Port::ABSENT).is(
    "a device of the recipe's exchanges that answered nothing for this long has started anew when it answers again: what \
     is asked at its start is asked",
);
/// Speed of a CAN bus.
pub const BITRATE: Key = Key::integer("bitrate", *Bus::BITRATES.start() as i64, *Bus::BITRATES.end() as i64)
    .unit("bit/s")
    .or(Bus::BITRATE as i64)
    .is("(`can`)");
/// Where a listening port is.
pub const LISTEN: Key = Key::text_of("listen", TextKind::Length(1, MAX_LISTEN))
    .required()
    .tells("IP address and port, such as `\"0.0.0.0:50000\"` (`tcp-listen`, `udp-listen`)");

/// Where the devices of Modbus TCP are.
pub const TO: Key = Key::text_of("to", TextKind::Any).required().tells(
    "IP address or host name of the device, or of the gateway before it, with a TCP port if it is not 502: \
     `\"192.168.1.50\"`, `\"plc.cell:1502\"` (`modbus-tcp`)",
);

/// The keys of a serial line.
pub(crate) const LINE: &[Key] = &[BAUD, PARITY, STOP_BITS, IDLE_GAP, TURNAROUND];
/// The keys of a field port, on any bus.
pub(crate) const FIELD: &[Key] = &[ON_TIMEOUT, SAFE_AT_START, REFRESH, HEALTH, ABSENT];

/// `[[port]]` of a gateway file.
pub const PORT: KeyTable = KeyTable::of("port", &[NAME, BUS, RECIPE, CYCLE, TIMEOUT, STALE_AFTER]).cases(&[
    Case {
        when: &[When::Is("bus", &["rs485", "modbus-rtu", "modbus-rtu-slave"], &[])],
        keys: &[LINE, &[ECHO], FIELD],
    },
    Case { when: &[When::Is("bus", &["modbus-tcp"], &[])], keys: &[&[TO], FIELD] },
    Case { when: &[When::Is("bus", &["can"], &[])], keys: &[&[BITRATE], FIELD] },
    Case { when: &[When::Is("bus", &["tcp-listen", "udp-listen"], &[])], keys: &[&[LISTEN]] },
]);
