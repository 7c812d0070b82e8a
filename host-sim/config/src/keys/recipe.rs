//! `[[recipe]]` of both kinds of files, and its parts.

use proto_core::config::OnStale;
use proto_core::recipe::model::{MAX_CAN_IDS, Mode};

use super::frame::{
    AFTER, EXTENDED, FRAME_NAME, HEAD, ID, INPUT_FIELDS, OF_FRAME, OF_STREAM, OUTPUT_FIELDS, PLAIN_FIELDS,
    TAIL, VARIABLES,
};
use super::gateway::NAME;
use super::{Case, Key, KeyTable, Rule, Shape, TextKind, When, exchange, words};

const ANY: usize = usize::MAX;

/// What carries a recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RecipeKind {
    Stream,
    Can,
    ModbusMaster,
    ModbusSlave,
}

/// The words of `kind`.
pub(crate) const KINDS: [(&str, RecipeKind); 4] = [
    ("stream", RecipeKind::Stream),
    ("can", RecipeKind::Can),
    ("modbus-rtu", RecipeKind::ModbusMaster),
    ("modbus-rtu-slave", RecipeKind::ModbusSlave),
];

impl RecipeKind {
    /// As files have it.
    pub(crate) fn name(self) -> &'static str {
        KINDS.iter().find(|(_, kind)| *kind == self).map_or("", |(name, _)| name)
    }

    pub(crate) fn is_modbus(self) -> bool {
        matches!(self, Self::ModbusMaster | Self::ModbusSlave)
    }
}
/// What carries a recipe of a gateway.
pub const KIND: Key = Key::words("kind", words!(KINDS)).required().tells(
    "`\"stream\"`, `\"can\"`; in gateway files also `\"modbus-rtu\"` and `\"modbus-rtu-slave\"` (section 4)",
);
const KIND_OF_CONTROLLER: Key =
    Key { shape: Shape::Words(|| KINDS.iter().take(2).map(|kind| kind.0).collect()), ..KIND };
/// The words of `mode`.
pub(crate) const MODES: [(&str, Mode); 2] = [("realtime", Mode::Realtime), ("user", Mode::User)];
/// Whether the controller or the user says what fields mean.
pub const MODE: Key = Key::words("mode", words!(MODES)).required().tells(
    "`\"realtime\"`: fields are system variables; `\"user\"`: fields of your own. Of Modbus always `\"user\"`, and may \
     be left out",
);
// A gateway's recipe of Modbus may leave it out.
const MODE_OF_ANY: Key = Key { need: super::Need::Absent("required"), ..MODE };
const MODE_OF_MODBUS: Key = Key { shape: Shape::Words(|| vec!["user"]), ..MODE.or_word("user") };

const fn input(table: &'static KeyTable) -> Key {
    Key::new("input", Shape::Table(table)).absent("absent").tells("user to robot")
}

const fn output(table: &'static KeyTable) -> Key {
    Key::new("output", Shape::Table(table))
        .absent("absent")
        .tells("robot to user; at least one of the two, or an exchange")
}

const fn exchanges(item: &'static Shape, least: usize) -> Key {
    Key::new("exchange", Shape::List(item, least, ANY)).tells(
        "what is asked of devices: `[[recipe.exchange]]`, `mode = \"user\"` in gateway files only (section 4)",
    )
}

/// What a recipe consists of.
pub(crate) const PARTS: &[Key] =
    &[input(&USER_IN), output(&USER_OUT), exchanges(&Shape::Table(&exchange::OF_STREAM), 0)];

/// The words of `on_stale`.
pub(crate) const ON_STALES: [(&str, OnStale); 2] = [("hold", OnStale::Hold), ("stop", OnStale::Stop)];
/// What is sent while a value is stale.
pub const ON_STALE: Key = Key::words("on_stale", words!(ON_STALES))
    .or_word("hold")
    .tells("`\"hold\"`: keep sending the last values; `\"stop\"`: send nothing");
/// The same of a recipe with exchanges and without an output part.
pub const ON_STALE_OF_RECIPE: Key = ON_STALE
    .tells("of a recipe with exchanges and without an output part: `\"hold\"` or `\"stop\"`, as there");
/// The address of a slave.
pub const ADDRESS: Key = Key::integer("address", 1, 247)
    .required()
    .is("of `kind = \"modbus-rtu-slave\"`: the gateway's own address on the line");
/// The blocks of a slave.
pub const BLOCK: Key = Key::new("block", Shape::List(&Shape::Table(&exchange::BLOCK), 1, ANY))
    .required()
    .tells("of `kind = \"modbus-rtu-slave\"`: `[[recipe.block]]` (section 4)");

/// When an output part is sent.
pub const SEND: Key = Key::new(
    "send",
    Shape::Text(TextKind::Pattern("^(period|change|frame|rising:.+)$")),
)
.or_word("period")
.tells(
    "`\"period\"`: each cycle; `\"change\"`: each cycle in which a value changed; `\"frame\"`: for each accepted input \
     frame; `\"rising:BitOutputReg[3].0\"`: when that bit goes from 0 to 1. A realtime recipe has `\"period\"` only",
);
const SEND_PERIOD: Key = Key { shape: Shape::Words(|| vec!["period"]), ..SEND };

/// How an output part is sent.
pub(crate) const SENDING: &[Key] = &[ON_STALE, SEND];

const STREAM: &str = " in a stream recipe";
const CAN: &str = " in a CAN recipe";

const fn always(keys: &'static [&'static [Key]]) -> Case {
    Case { when: &[], keys }
}

const PART_RULES: &[Rule] =
    &[Rule::NotBoth("framing", "escape"), Rule::Needs("framing", &["tail"], &["tail"])];

pub(crate) const REALTIME: KeyTable =
    KeyTable::of("realtime stream part", &[HEAD, TAIL, VARIABLES]).at(STREAM);
const REALTIME_OUT: KeyTable =
    KeyTable::of("realtime stream output", &[HEAD, TAIL, VARIABLES, ON_STALE, SEND_PERIOD]).at(STREAM);
const PLAIN: KeyTable = KeyTable::of("stream part of a controller", &[HEAD, TAIL, PLAIN_FIELDS]).at(STREAM);
const USER_IN: KeyTable = KeyTable::of("stream input", &[HEAD, TAIL, INPUT_FIELDS])
    .at(STREAM)
    .cases(&[always(&[OF_STREAM])])
    .rules(PART_RULES);
const USER_OUT: KeyTable = KeyTable::of("stream output", &[HEAD, TAIL, OUTPUT_FIELDS])
    .at(STREAM)
    .cases(&[always(&[OF_STREAM, SENDING])])
    .rules(PART_RULES);

const fn frames(item: &'static Shape) -> Key {
    Key::new("frame", Shape::List(item, 1, MAX_CAN_IDS))
        .required()
        .tells("of a CAN part: its frames, `[[recipe.input.frame]]`, at most 32")
}

/// The frames of a CAN part.
pub const FRAME: Key = frames(&Shape::Table(&CAN_IN));

pub(crate) const CAN_REALTIME: KeyTable = KeyTable::of("realtime CAN frame", &[ID, EXTENDED, VARIABLES]);
const CAN_PLAIN: KeyTable = KeyTable::of("CAN frame of a controller", &[ID, EXTENDED, PLAIN_FIELDS]);
const CAN_IN: KeyTable =
    KeyTable::of("CAN input frame", &[ID, EXTENDED, INPUT_FIELDS]).cases(&[always(&[OF_FRAME])]);
const CAN_OUT: KeyTable = KeyTable::of("CAN output frame", &[ID, EXTENDED, FRAME_NAME, AFTER, OUTPUT_FIELDS])
    .cases(&[always(&[OF_FRAME])]);

pub(crate) const CAN_PART: KeyTable =
    KeyTable::of("realtime CAN part", &[frames(&Shape::Table(&CAN_REALTIME))]).at(CAN);
const CAN_PART_OUT: KeyTable =
    KeyTable::of("realtime CAN output", &[frames(&Shape::Table(&CAN_REALTIME)), ON_STALE, SEND_PERIOD])
        .at(CAN);
const CAN_PART_PLAIN: KeyTable =
    KeyTable::of("CAN part of a controller", &[frames(&Shape::Table(&CAN_PLAIN))]).at(CAN);
const CAN_PART_IN: KeyTable = KeyTable::of("CAN input", &[FRAME]).at(CAN);
const CAN_PART_USER_OUT: KeyTable =
    KeyTable::of("CAN output", &[frames(&Shape::Table(&CAN_OUT)), ON_STALE, SEND]).at(CAN);

/// `[[recipe]]` of a gateway file.
pub const OF_GATEWAY: KeyTable = KeyTable::of("recipe", &[NAME, KIND, MODE_OF_ANY])
    .rules(&[Rule::Needs("kind", &["stream", "can"], &["mode"])])
    .cases(&[
        Case {
            when: &[When::Is("kind", &["stream"], &[]), When::Is("mode", &["realtime"], &[])],
            keys: &[&[input(&REALTIME), output(&REALTIME_OUT)]],
        },
        Case {
            when: &[When::Is("kind", &["stream"], &[]), When::Is("mode", &["user"], &[])],
            keys: &[&[
                input(&USER_IN),
                output(&USER_OUT),
                ON_STALE_OF_RECIPE,
                exchanges(&Shape::Table(&exchange::OF_STREAM), 0),
            ]],
        },
        Case {
            when: &[When::Is("kind", &["can"], &[]), When::Is("mode", &["realtime"], &[])],
            keys: &[&[input(&CAN_PART), output(&CAN_PART_OUT)]],
        },
        Case {
            when: &[When::Is("kind", &["can"], &[]), When::Is("mode", &["user"], &[])],
            keys: &[&[
                input(&CAN_PART_IN),
                output(&CAN_PART_USER_OUT),
                ON_STALE_OF_RECIPE,
                exchanges(&Shape::Table(&exchange::OF_CAN), 0),
            ]],
        },
        Case {
            when: &[When::Is("kind", &["modbus-rtu"], &[])],
            keys: &[&[
                MODE_OF_MODBUS,
                ON_STALE_OF_RECIPE,
                exchanges(&Shape::Table(&exchange::OF_MODBUS), 1).required(),
            ]],
        },
        Case {
            when: &[When::Is("kind", &["modbus-rtu-slave"], &[])],
            keys: &[&[MODE_OF_MODBUS, ON_STALE_OF_RECIPE, ADDRESS, BLOCK]],
        },
    ]);

/// `[[recipe]]` of a controller file.
pub const OF_CONTROLLER: KeyTable = KeyTable::of("recipe of a controller", &[NAME, KIND_OF_CONTROLLER, MODE])
    .cases(&[
        Case {
            when: &[When::Is("kind", &["stream"], &[]), When::Is("mode", &["realtime"], &[])],
            keys: &[&[input(&REALTIME), output(&REALTIME)]],
        },
        Case {
            when: &[When::Is("kind", &["stream"], &[]), When::Is("mode", &["user"], &[])],
            keys: &[&[input(&PLAIN), output(&PLAIN)]],
        },
        Case {
            when: &[When::Is("kind", &["can"], &[]), When::Is("mode", &["realtime"], &[])],
            keys: &[&[input(&CAN_PART), output(&CAN_PART)]],
        },
        Case {
            when: &[When::Is("kind", &["can"], &[]), When::Is("mode", &["user"], &[])],
            keys: &[&[input(&CAN_PART_PLAIN), output(&CAN_PART_PLAIN)]],
        },
    ]);
