//! The keys of a Sparkplug file.

use super::{HOUR_MS, Key, KeyTable, Limits, Shape, TextKind};

pub(crate) const ADDRESS: Key = Key::text_of("address", TextKind::Length(1, 255)).required().tells(
    "the broker: a host name or an address, with or without a port: `\"broker.plant.example:8883\"`. Without one: 8883 \
     with TLS, 1883 without",
);
pub(crate) const CA: Key = Key::text_of("ca", TextKind::Length(1, 4_096)).absent("no TLS").tells(
    "TLS, with the authorities in this file (PEM) and no others; relative to this file. Required unless `plain` is `true`",
);
pub(crate) const PLAIN: Key =
    Key::bool("plain").tells("`true`: without TLS. Whoever is on the network reads the password then");
pub(crate) const LOGIN: Key = Key::text_of("login", TextKind::Length(1, 4_096)).absent("no password").tells(
    "the file with two lines, user and password, that nobody else can read (mode 0600); relative to this file",
);
pub(crate) const CLIENT_ID: Key = Key::text_of("client_id", TextKind::Length(1, 128))
    .absent("`group/name`")
    .tells("the name for the broker, which no other client may have");
pub(crate) const KEEP_ALIVE: Key = Key::integer("keep_alive_s", 5, 65_535)
    .or(30)
    .unit("s")
    .is("after one and a half times this without a sign of life the broker says that the node is dead");

/// `[broker]`.
pub const BROKER: KeyTable = KeyTable::of("broker", &[ADDRESS, CA, PLAIN, LOGIN, CLIENT_ID, KEEP_ALIVE]);

pub(crate) const GROUP: Key =
    Key::text_of("group", TextKind::Length(1, 64)).required().tells("the group; without `+`, `/` and `#`");
pub(crate) const NAME: Key = Key::text_of("name", TextKind::Length(1, 64))
    .required()
    .tells("the edge node, unique in its group; without `+`, `/` and `#`");
pub(crate) const PRIMARY_HOST: Key = Key::text_of("primary_host", TextKind::Length(1, 64))
    .tells("the host application without which nothing is told: what changes meanwhile is kept");
pub(crate) const BD_SEQ: Key = Key::text_of("bd_seq", TextKind::Length(1, 4_096))
    .absent("it begins at 0")
    .tells("the file that keeps the number of the session over restarts; relative to this file");

/// `[node]`.
pub const NODE: KeyTable = KeyTable::of("edge node", &[GROUP, NAME, PRIMARY_HOST, BD_SEQ]);

const TIME: Limits = Limits::Within(100.0, HOUR_MS);
pub(crate) const SAMPLE: Key =
    Key::millis("sample_ms", TIME).or(500).is("how often the gateway is looked at");
pub(crate) const INTERVAL: Key =
    Key::millis("interval_ms", TIME).or(500).is("least time between two values of a variable or a state");
pub(crate) const COUNTERS: Key =
    Key::millis("counter_interval_ms", TIME).or(10_000).is("same, for counters and the time since the start");
pub(crate) const VALUES: Key =
    Key::new("values", Shape::List(&Shape::Text(TextKind::Variables), 0, 64)).tells(
        "variables of the controller that are told beside those that field ports send, such as `[\"RobotState[1..6]\"]`",
    );

/// `[report]`.
pub const REPORT: KeyTable = KeyTable::of("report", &[SAMPLE, INTERVAL, COUNTERS, VALUES]);

pub(crate) const RULE_VALUES: Key =
    Key::text_of("values", TextKind::Variables).required().tells("a variable, or a range of them");
pub(crate) const DEAD_BAND: Key = Key::new("dead_band", Shape::Number(Limits::Within(0.0, 1e9)))
    .or(0)
    .is("a number is told when it is further than this from the last one told; in its unit");
pub(crate) const RULE_INTERVAL: Key =
    Key::millis("interval_ms", TIME).absent("that of `[report]`").is("least time between two");

/// `[[rule]]`.
pub const RULE: KeyTable =
    KeyTable::of("report rule", &[RULE_VALUES, DEAD_BAND, RULE_INTERVAL]).at(" of a rule");

pub(crate) const SERVER: Key = Key::text_of("server", TextKind::Length(1, 255))
    .required()
    .tells("of a board: the server of SNTP that it asks for UTC, a host name or an IPv4 address, with or without a port: `\"10.0.0.1\"`");

/// `[time]`.
pub const TIME_TABLE: KeyTable = KeyTable::of("time", &[SERVER]);

/// The file.
pub const FILE: KeyTable = KeyTable::of(
    "Sparkplug file",
    &[
        Key::new("broker", Shape::Table(&BROKER)).required().is("where it is told"),
        Key::new("node", Shape::Table(&NODE)).required().is("what it is called there"),
        Key::new("report", Shape::Table(&REPORT)).is("what is told, and how often"),
        Key::new("time", Shape::Table(&TIME_TABLE)).absent("UTC of the system; on a board unknown").is("UTC"),
        Key::new("rule", Shape::List(&Shape::Table(&RULE), 0, 64))
            .is("exceptions for variables; the last one that has a variable counts"),
    ],
);

/// The tables of docs/fleet.md, by the name that stands before them there.
pub const DOCUMENTED: &[(&str, &[&[Key]])] = &[
    ("broker", &[BROKER.common]),
    ("node", &[NODE.common]),
    ("report", &[REPORT.common]),
    ("rule", &[RULE.common]),
    ("time", &[TIME_TABLE.common]),
];
