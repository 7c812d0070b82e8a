//! `[[recipe.exchange]]` and `[[recipe.block]]`.

use proto_core::config::{DEFAULT_REPLY_TIMEOUT, LONGEST_TRIGGER, MAX_PAUSE};
use proto_core::modbus::rtu::Table;

use super::device::WORD_ORDER_OF_REGISTERS;
use super::frame::{EXTENDED, HEAD, ID, INPUT_FIELDS, OF_FRAME, OUTPUT_FIELDS, TAIL};
use super::{Case, HOUR_MS, Key, KeyTable, Limits, Need, Shape, TextKind, When, field, ms, words};

/// The device that is asked.
pub const PEER: Key = Key::integer("peer", 0, 255).or(0).is(
    "the device. The exchanges of one device share what is known of it: one that does not answer is asked less often. \
     At most 32 on a port",
);
/// The period.
pub const EVERY: Key = Key::millis("every_ms", Limits::AboveZero(HOUR_MS)).is("asked with this period");
/// What triggers it.
pub const ON: Key = Key::new(
    "on",
    Shape::List(&Shape::Text(TextKind::Pattern("^(start|change|rising:.+)$")), 1, usize::MAX),
)
.tells(
    "`\"start\"`: asked at the start, and again when the device has started anew; `\"change\"`: when a value of the \
     request has changed, looked at each `cycle_ms`; `\"rising:BitOutputReg[3].0\"`: when this bit goes from 0 to 1, an \
     event that is sent once and in time, or not at all",
);
/// How long a reply may take.
pub const TIMEOUT: Key = Key::millis("timeout_ms", Limits::AboveZero(HOUR_MS))
    .or_time(DEFAULT_REPLY_TIMEOUT)
    .is("from the end of the request to the end of the reply");
/// How often a request is repeated.
pub const RETRIES: Key = Key::integer("retries", 0, 255).absent("1; of an event 0").is(
    "how often a request without a good reply is repeated at once. An event, or what is only asked at the start, may be \
     carried out twice by a device when it is repeated",
);
/// How long after an event it may be sent.
pub const TRIGGER: Key = Key::millis("trigger_ms", Limits::AboveZero(ms(LONGEST_TRIGGER)))
    .absent("`timeout_ms` of the port, at most 1000")
    .is("how long after an event its request may still be sent");
/// How late a reply may come.
pub const LATE: Key = Key::millis("late_ms", Limits::Within(0.0, HOUR_MS))
    .absent("3 × `timeout_ms`, at least 1000")
    .is("how long after its request a reply may come. Until then nothing is asked of the device whose reply could be \
         taken for it");
/// It stops the device.
pub const STOP: Key = Key::bool("stop").tells(
    "`true`: it stops the device. It goes before everything else on the line, cancels the device's events that wait, \
     and is repeated until it is confirmed",
);
/// What other exchanges call it.
pub const NAME: Key = Key::text_of("name", TextKind::Length(1, 32))
    .absent("none")
    .is("what `follow` of another exchange calls it");
/// The exchange before it.
pub const FOLLOW: Key = Key::text_of("follow", TextKind::Length(1, 32)).absent("none").is(
    "the name of an exchange of the recipe: this one is sent after each good answer to that one, as an event",
);
/// Where the outcome of an event goes.
pub const OUTCOME_TABLE: KeyTable = KeyTable::of(
    "outcome",
    &[
        Key::text_of("to", TextKind::Variable)
            .is("becomes what the newest event came to, as a number; see below"),
        Key::text_of("code_to", TextKind::Variable)
            .is("becomes the code with which the device refused it, such as a Modbus exception, or 0"),
        Key::text_of("count_to", TextKind::Variable).is("the number of events that have ended, wrapping"),
    ],
);
/// What the robot is told of events.
pub const OUTCOME: Key = Key::new("outcome", Shape::Table(&OUTCOME_TABLE)).absent("none").tells(
    "variables that tell the robot what became of an event: `{ to = \"WordInputReg[20]\", code_to = ..., count_to = ... \
     }`; `WordInputReg` and `FloatInputReg` only. The port owns them",
);
/// Whether the reply comes steadily.
pub const EXPECT: Key = Key::words("expect", words!(EXPECTATIONS)).absent("steadily").tells(
    "`\"event\"`: it comes only when something happens; its values hold, and the port is not silent without it",
);
/// When the values of a reply are overdue.
pub const OVERDUE: Key = Key::millis("overdue_ms", Limits::AboveZero(HOUR_MS))
    .absent("`timeout_ms` of the port")
    .is("after this time without a good reply its variables take their safe values");
const REPLY_TIMEOUT: Key = Key::millis("timeout_ms", Limits::AboveZero(HOUR_MS))
    .absent("`timeout_ms` of the port")
    .is("of a reply: after this time without a good one its variables take their safe values");
/// The words of `expect`.
pub(crate) const EXPECTATIONS: [(&str, ()); 1] = [("event", ())];
/// The rest behind it.
pub const PAUSE: Key =
    Key::millis("pause_ms", Limits::Within(0.0, ms(MAX_PAUSE))).or(0).is("how long the line rests after it");
pub(crate) const TIMING: &[Key] =
    &[EVERY, ON, TIMEOUT, RETRIES, PAUSE, TRIGGER, LATE, STOP, NAME, FOLLOW, OUTCOME];
/// Of a reply in a device's own frames, beside those of its frame.
pub(crate) const OF_REPLY_FRAME: &[Key] = &[REPLY_TIMEOUT, EXPECT];
/// Of a reply of Modbus, which has no table of its own.
pub(crate) const OF_REPLY: &[Key] = &[EXPECT, OVERDUE];
const ASKED: &[&str] = &["request"];
const TIMING_OF_FRAMES: &[Key] = &[
    EVERY.beside(ASKED),
    ON.beside(ASKED),
    TIMEOUT.beside(ASKED),
    RETRIES.beside(ASKED),
    PAUSE.beside(ASKED),
    TRIGGER.beside(ASKED),
    LATE.beside(ASKED),
    STOP.beside(ASKED),
    NAME.beside(ASKED),
    FOLLOW.beside(ASKED),
    OUTCOME.beside(ASKED),
];

const fn request(table: &'static KeyTable) -> Key {
    Key::new("request", Shape::Table(table)).tells("the frame that asks. Needs `every_ms`, `on` or `follow`")
}

const fn reply(table: &'static KeyTable) -> Key {
    Key::new("reply", Shape::Table(table))
        .tells("the frame that answers. Without a `request` it may come at any time")
}

const fn refusal(table: &'static KeyTable) -> Key {
    Key::new("refusal", Shape::Table(table))
        .beside(&["reply"])
        .tells("the frame with which the device refuses the request")
}

const fn pending(table: &'static KeyTable) -> Key {
    Key::new("pending", Shape::Table(table)).beside(&["reply"]).tells(
        "the frame with which the device says that it is at it, and that its answer follows: the wait for it begins anew, up \
         to 16 times `timeout_ms` behind the request",
    )
}

/// A remote frame of CAN.
pub const REMOTE: Key = Key::bool("remote").tells("of a request on CAN: it has no data, and no `fields`");
// A remote request has none.
const SENT_FIELDS: Key = Key { need: Need::Absent("none"), ..OUTPUT_FIELDS };

pub(crate) const STREAM_REQUEST: KeyTable = frame("stream request", &[HEAD, TAIL, OUTPUT_FIELDS]);
pub(crate) const STREAM_REPLY: KeyTable =
    frame("stream reply", &[HEAD, TAIL, INPUT_FIELDS, REPLY_TIMEOUT, EXPECT]);
pub(crate) const CAN_REQUEST: KeyTable = frame("CAN request", &[ID, EXTENDED, SENT_FIELDS, REMOTE]);
pub(crate) const CAN_REPLY: KeyTable =
    frame("CAN reply", &[ID, EXTENDED, INPUT_FIELDS, REPLY_TIMEOUT, EXPECT]);
pub(crate) const STREAM_REFUSAL: KeyTable = frame("stream refusal", &[HEAD, TAIL, INPUT_FIELDS]);
pub(crate) const CAN_REFUSAL: KeyTable = frame("CAN refusal", &[ID, EXTENDED, INPUT_FIELDS]);

const fn frame(name: &'static str, keys: &'static [Key]) -> KeyTable {
    KeyTable::of(name, keys).cases(&[Case { when: &[], keys: &[OF_FRAME] }])
}

/// The frames of an exchange.
pub(crate) const FRAMES: &[Key] =
    &[request(&STREAM_REQUEST), reply(&STREAM_REPLY), pending(&STREAM_REFUSAL), refusal(&STREAM_REFUSAL)];

/// An exchange of frames on a line.
pub const OF_STREAM: KeyTable = KeyTable::of(
    "exchange",
    &[
        PEER,
        request(&STREAM_REQUEST),
        reply(&STREAM_REPLY),
        pending(&STREAM_REFUSAL),
        refusal(&STREAM_REFUSAL),
    ],
)
.at(" of an exchange")
.cases(&[Case { when: &[], keys: &[TIMING_OF_FRAMES] }]);
/// An exchange of frames on CAN.
pub const OF_CAN: KeyTable = KeyTable::of(
    "exchange on CAN",
    &[PEER, request(&CAN_REQUEST), reply(&CAN_REPLY), pending(&CAN_REFUSAL), refusal(&CAN_REFUSAL)],
)
.at(" of an exchange")
.cases(&[Case { when: &[], keys: &[TIMING_OF_FRAMES] }]);

/// The slave that is asked.
pub const SLAVE: Key = Key::integer("slave", 0, 255)
    .required()
    .tells("1..=247; 0 writes to all slaves, and nobody answers. After it nothing is sent for 100 ms. Over Modbus TCP the unit \
     id, 1..=255");
/// The names and the numbers of `function`.
pub(crate) const FUNCTIONS: [(&str, u8); 10] = [
    ("read-coils", 1),
    ("read-discrete-inputs", 2),
    ("read-holding-registers", 3),
    ("read-input-registers", 4),
    ("write-coil", 5),
    ("write-register", 6),
    ("write-coils", 15),
    ("write-registers", 16),
    ("mask-write-register", 22),
    ("read-write-registers", 23),
];
/// What is asked of it.
pub const FUNCTION: Key = Key::new(
    "function",
    Shape::Either(&[Shape::Words(words!(FUNCTIONS)), Shape::Codes(&[1, 2, 3, 4, 5, 6, 15, 16, 22, 23])]),
)
.required()
.tells("a name or a number, see below");
/// The first register or coil.
pub const ADDRESS: Key = Key::integer("address", 0, 0xFFFF).required().is(
    "the first register or coil, as on the line. Manuals that count from 1 call them coil 1, input 10001, input \
     register 30001 and holding register 40001, which are all 0 here; 40108 is 107",
);
/// The first register that is written.
pub const WRITE_ADDRESS: Key = Key::integer("write_address", 0, 0xFFFF)
    .required()
    .is("of function 23: the first register that it writes; `address` is what it reads");

const fn read(item: &'static Shape) -> Key {
    Key::new("read", Shape::List(item, 0, usize::MAX))
        .required()
        .tells("of functions that read: the fields of the reply, as in an input part")
}

const fn write(item: &'static Shape) -> Key {
    Key::new("write", Shape::List(item, 0, usize::MAX))
        .required()
        .tells("of functions that write: the fields of the request, as in an output part")
}

pub(crate) const READ: Key = read(&Shape::Table(&field::INPUT));
pub(crate) const WRITE: Key = write(&Shape::Table(&field::OUTPUT));

/// An exchange of Modbus.
pub const OF_MODBUS: KeyTable =
    KeyTable::of("exchange of Modbus", &[SLAVE, FUNCTION, ADDRESS]).at(" of an exchange of Modbus").cases(&[
        Case {
            when: &[When::Is("function", &["read-write-registers"], &[23])],
            keys: &[&[WRITE_ADDRESS, WORD_ORDER_OF_REGISTERS, READ, WRITE], TIMING, OF_REPLY],
        },
        Case {
            when: &[When::Is("function", &["read-holding-registers", "read-input-registers"], &[3, 4])],
            keys: &[&[WORD_ORDER_OF_REGISTERS, READ], TIMING, OF_REPLY],
        },
        Case {
            when: &[When::Is(
                "function",
                &["write-register", "write-registers", "mask-write-register"],
                &[6, 16, 22],
            )],
            keys: &[&[WORD_ORDER_OF_REGISTERS, WRITE], TIMING],
        },
        Case {
            when: &[When::Is("function", &["read-coils", "read-discrete-inputs"], &[1, 2])],
            keys: &[&[WORD_ORDER_OF_REGISTERS, read(&Shape::Table(&field::COIL_IN))], TIMING, OF_REPLY],
        },
        Case {
            when: &[When::Is("function", &["write-coil", "write-coils"], &[5, 15])],
            keys: &[&[WORD_ORDER_OF_REGISTERS, write(&Shape::Table(&field::COIL_OUT))], TIMING],
        },
    ]);

/// The words of `table`.
pub(crate) const TABLES: [(&str, Table); 4] = [
    ("coils", Table::Coils),
    ("discrete-inputs", Table::DiscreteInputs),
    ("holding-registers", Table::HoldingRegisters),
    ("input-registers", Table::InputRegisters),
];
/// What a block holds.
pub const TABLE: Key = Key::words("table", words!(TABLES)).required();
pub(crate) const BLOCK_FIELDS: Key = block_fields(&Shape::Table(&field::IN_BLOCK));

const fn block_fields(item: &'static Shape) -> Key {
    Key::new("fields", Shape::List(item, 0, usize::MAX))
        .required()
        .tells("as in `read` and `write` of a master; blocks of a table must not overlap")
}

const BLOCK_ADDRESS: Key = ADDRESS.is("the first register or coil");

/// A block of a slave.
pub const BLOCK: KeyTable =
    KeyTable::of("block", &[TABLE, BLOCK_ADDRESS, WORD_ORDER_OF_REGISTERS]).at(" of a block").cases(&[
        Case { when: &[When::Is("table", &["holding-registers"], &[])], keys: &[&[BLOCK_FIELDS]] },
        Case {
            when: &[When::Is("table", &["input-registers"], &[])],
            keys: &[&[block_fields(&Shape::Table(&field::OUTPUT))]],
        },
        Case {
            when: &[When::Is("table", &["coils"], &[])],
            keys: &[&[block_fields(&Shape::Table(&field::COIL_IN_BLOCK))]],
        },
        Case {
            when: &[When::Is("table", &["discrete-inputs"], &[])],
            keys: &[&[block_fields(&Shape::Table(&field::COIL_OUT))]],
        },
    ]);
