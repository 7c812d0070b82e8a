//! Every mistake in an exchange or a block gets one message that says where, what, and what is allowed.
//!
//! Each case is one edit of a good file; see `wrong_files`.

use super::wrong_files::{CONTROLLER, Case, messages};

const LINE: &str = include_str!("good/line.toml");

const fn line(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (LINE, from, to) }
}

const fn controller(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (CONTROLLER, from, to) }
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    // Where there are no exchanges.
    controller("an exchange in a controller's file", "[recipe.output]\n", "[[recipe.exchange]]\npeer = 1\n[recipe.output]\n"),
    controller("Modbus in a controller's file", "kind = \"stream\"", "kind = \"modbus-rtu\""),
    line("an exchange of a realtime recipe", "kind = \"stream\"\nmode = \"user\"", "kind = \"stream\"\nmode = \"realtime\""),
    line("a part beside Modbus", "kind = \"modbus-rtu\"", "kind = \"modbus-rtu\"\ninput = {}"),
    line("a realtime recipe of Modbus", "kind = \"modbus-rtu\"", "kind = \"modbus-rtu\"\nmode = \"realtime\""),
    line("a key of a slave in a master", "kind = \"modbus-rtu\"", "kind = \"modbus-rtu\"\naddress = 3"),
    line("a master without an exchange", "[[recipe]]\nname = \"plc\"", "[[recipe]]\nname = \"empty\"\nkind = \"modbus-rtu\"\n[[recipe]]\nname = \"plc\""),
    line("a slave without a block", "[[recipe]]\nname = \"plc\"", "[[recipe]]\nname = \"empty\"\nkind = \"modbus-rtu-slave\"\naddress = 4\n[[recipe]]\nname = \"plc\""),
    line("an exchange that is no table", "[[recipe]]\nname = \"plc\"", "[[recipe]]\nname = \"empty\"\nkind = \"modbus-rtu\"\nexchange = 3\n[[recipe]]\nname = \"plc\""),
    // Ports.
    line("a master's recipe on a plain line", "bus = \"modbus-rtu\"\n", "bus = \"rs485\"\n"),
    line("Modbus ASCII", "bus = \"modbus-rtu\"\n", "bus = \"modbus-ascii\"\n"),
    line("a master's recipe on a slave's line", "bus = \"modbus-rtu\"\n", "bus = \"modbus-rtu-slave\"\n"),
    line("a plain recipe on a master's line", "bus = \"rs485\"", "bus = \"modbus-rtu\""),
    line("a CAN recipe on a slave's line", "bus = \"can\"", "bus = \"modbus-rtu-slave\""),
    line("an unknown key of a line of Modbus", "parity = \"even\"", "parity = \"even\"\nbitrate = 500000"),
    line("an echo without exchanges", "[[port]]\nname = \"plc\"", "[[recipe]]\nname = \"old\"\nkind = \"stream\"\nmode = \"user\"\n[recipe.input]\nhead = [1]\nfields = [{ name = \"x\", type = \"byte\" }]\n[[port]]\nname = \"old\"\nbus = \"rs485\"\nrecipe = \"old\"\necho = true\n[[port]]\nname = \"plc\""),
    line("an echo that is no bool", "echo = true", "echo = 1"),
    line("an echo on CAN", "bus = \"can\"", "bus = \"can\"\necho = true"),
    // A master.
    line("no slave", "slave = 9\n", ""),
    line("slave 248", "slave = 9", "slave = 248"),
    line("no function", "function = \"read-input-registers\"\n", ""),
    line("an unknown function", "\"read-input-registers\"", "\"read-input-register\""),
    line("a function that is far from all others", "\"read-input-registers\"", "\"poll\""),
    line("an unknown function code", "function = 23", "function = 43"),
    line("a function that is a bool", "function = 23", "function = true"),
    line("an unknown key of an exchange", "every_ms = 100\n", "evry_ms = 100\n"),
    line("no address", "address = 0x07D0\n", ""),
    line("an address beyond 16 bits", "address = 0x07D0", "address = 0x10000"),
    line("registers behind the last one", "address = 0x07D0", "address = 0xFFFC"),
    line("written registers behind the last one", "write_address = 0x20", "write_address = 0xFFFF"),
    line("a write address of a read", "address = 0x07D0", "address = 0x07D0\nwrite_address = 1"),
    line("no write address", "write_address = 0x20\n", ""),
    line("a read without read", "read = [\n    { name = \"total\"", "write = [\n    { name = \"total\""),
    line("a write that reads", "write = [{ name = \"speed\"", "read = [{ name = \"speed\""),
    line("no list of what is written", "write = [{ name = \"wanted\", type = \"short\", from = \"WordOutputReg[1]\" }, { pad = 2, fill = 0xFF }]\n", ""),
    line("no list of coils", "write = [{ name = \"lamp\", from = \"WordOutputReg[2]\" }]\n", ""),
    line("a list that is no list", "write = [{ name = \"lamp\", from = \"WordOutputReg[2]\" }]", "write = 5"),
    line("a read of all slaves", "slave = 5\nfunction = \"read-coils\"", "slave = 0\nfunction = \"read-coils\""),
    line("a timeout where nobody answers", "slave = 0\n", "slave = 0\ntimeout_ms = 10\n"),
    line("all bits of a register with function 22", "function = \"write-register\"", "function = 22"),
    line("bits of two registers", "function = \"write-register\"\naddress = 1\nevery_ms = 500\nwrite = [{ name = \"speed\", type = \"word\",", "function = 22\naddress = 1\nevery_ms = 500\nwrite = [{ name = \"speed\", type = \"dword\", bits = 3,"),
    line("an exchange that is never asked", "every_ms = 500\n", ""),
    line("half a register", "    { pad = 1 },\n    { type = \"word\", equals = 7 }", "    { type = \"word\", equals = 7 }"),
    line("a text without a length in registers", "{ name = \"order\", type = \"word\", bits = \"4..7\" },", "{ name = \"order\", type = \"text\", to = \"WordInputReg[20..21]\" },"),
    line("a length in registers", "{ name = \"order\", type = \"word\", bits = \"4..7\" },", "{ type = \"word\", length = true },"),
    line("no registers", "read = [{ name = \"position\", type = \"float\", word_order = \"high-first\", to = \"WordInputReg[3]\" }]", "read = []"),
    line("126 registers", "{ pad = 1 },\n    { type", "{ pad = 243 },\n    { type"),
    line("124 written registers", "function = \"write-register\"\naddress = 1\nevery_ms = 500\nwrite = [", "function = \"write-registers\"\naddress = 1\nevery_ms = 500\nwrite = [{ pad = 246 }, "),
    line("122 registers that are written and read", "write = [{ name = \"wanted\"", "write = [{ pad = 240 }, { name = \"wanted\""),
    line("two registers of one", "write = [{ name = \"speed\", ", "write = [{ pad = 2 }, { name = \"speed\", "),
    line("an unknown type in a register", "{ name = \"position\", type = \"float\"", "{ name = \"position\", type = \"real\""),
    line("a checksum of registers", "word_order = \"low-first\"\nread", "checksum = { kind = \"sum8\" }\nread"),
    line("an output of the robot that is written", "to = \"WordInputReg[3]\"", "to = \"WordOutputReg[3]\""),
    line("a variable that two exchanges write", "to = \"WordInputReg[4]\"", "to = \"WordInputReg[2]\""),
    line("a value to send in a reply", "{ name = \"order\", type = \"word\"", "{ name = \"order\", value = 1, type = \"word\""),
    line("a scale of 0 in an exchange", "from = \"WordOutputReg[3]\"", "from = \"WordOutputReg[3]\", scale = 0"),
    // Coils.
    line("a coil with a type", "{ name = \"ready\", to", "{ name = \"ready\", type = \"byte\", to"),
    line("a coil with bits", "{ name = \"ready\", to", "{ name = \"ready\", bits = 1, to"),
    line("a coil with an order", "{ name = \"ready\", to", "{ name = \"ready\", endian = \"big\", to"),
    line("a coil without a name", "{ name = \"ready\", to", "{ to"),
    line("padding of no coils", "{ pad = 3 }", "{ pad = 0 }"),
    line("padding of coils that is filled", "{ pad = 3 }", "{ pad = 3, fill = 1 }"),
    line("2001 coils", "{ pad = 12 }", "{ pad = 1985 }"),
    line("two coils of one", "write = [{ name = \"lamp\", ", "write = [{ pad = 1 }, { name = \"lamp\", "),
    line("a coil that must be 2", "{ equals = 1 }", "{ equals = 2 }"),
    line("a coil that is 2", "{ name = \"on\", value = 1 }", "{ name = \"on\", value = 2 }"),
    line("a command for a coil that is 2", "commands = { rising = \"run(pick.jspf,50)\" }", "commands = { 2 = \"stop\" }"),
    line("a constant coil with a binding", "{ equals = 1 }", "{ equals = 1, to = \"WordInputReg[20]\" }"),
    line("a coil that is no table", "{ name = \"last\" }", "\"last\""),
    // When.
    line("no period", "every_ms = 100\n", "every_ms = 0\n"),
    line("a period of two hours", "every_ms = 100\n", "every_ms = 7200000\n"),
    line("no timeout", "timeout_ms = 50", "timeout_ms = 0"),
    line("256 repetitions", "retries = 2", "retries = 256"),
    line("a pause of a minute", "pause_ms = 5", "pause_ms = 60000"),
    line("a negative pause", "pause_ms = 5", "pause_ms = -1"),
    line("a trigger that is no list", "on = [\"start\", \"change\"", "on = \"start\" #"),
    line("an empty list of triggers", "on = [\"start\"]", "on = []"),
    line("an unknown trigger", "\"start\", \"change\"", "\"begin\", \"change\""),
    line("a trigger twice", "\"start\", \"change\"", "\"change\", \"change\""),
    line("two bits that trigger", "\"start\", \"change\"", "\"rising:BitOutputReg[1].1\""),
    line("a trigger of a word", "\"start\", \"change\", \"rising:BitOutputReg[3].0\"", "\"rising:WordOutputReg[3].0\""),
    line("a trigger of a ninth bit", "\"start\", \"change\", \"rising:BitOutputReg[3].0\"", "\"rising:BitOutputReg[3].8\""),
    // A slave.
    line("a slave without an address", "address = 5\n", ""),
    line("a slave that is all slaves", "address = 5\n", "address = 0\n"),
    line("a stale value that is unknown", "address = 5\n", "address = 5\non_stale = \"wait\"\n"),
    line("a block without a table", "table = \"discrete-inputs\"\n", ""),
    line("an unknown table", "table = \"discrete-inputs\"", "table = \"discreet-inputs\""),
    line("an unknown key of a block", "word_order = \"low-first\"\nfields", "wordorder = \"low-first\"\nfields"),
    line("a block that is asked", "table = \"coils\"", "table = \"coils\"\nevery_ms = 100"),
    line("a block without fields", "address = 7\nfields = [{ name = \"stop\", commands = { rising = \"stop\" } }]", "address = 7"),
    line("a block of both kinds", "{ name = \"y\", type = \"word\", value = 1 }", "{ name = \"y\", type = \"word\", to = \"WordInputReg[16]\" }"),
    line("a master that writes an input", "{ name = \"running\", value = 1 }", "{ name = \"running\", to = \"WordInputReg[16]\" }"),
    line("blocks that overlap", "address = 100", "address = 2"),
    line("a block behind the last register", "address = 100", "address = 65535"),
    line("a field that a master reads without a value", "{ name = \"y\", type = \"word\", value = 1 }", "{ name = \"y\", type = \"word\" }"),
    // Frames of a device's own.
    line("no frame at all", "peer = 3\nevery_ms = 50\nrequest", "every_ms = 50\n[[recipe.exchange]]\nrequest"),
    line("an unknown peer", "peer = 3", "peer = 256"),
    line("a request that is never sent", "on = [\"start\"]\nrequest", "request"),
    line("a period without a request", "[[recipe.exchange]]\nreply", "[[recipe.exchange]]\nevery_ms = 10\nreply"),
    line("a timeout without a reply", "pause_ms = 10", "timeout_ms = 10"),
    line("a refusal without a reply", "pause_ms = 10", "refusal = { head = [7], fields = [{ pad = 1 }] }"),
    line("a refusal that picks a command", "{ name = \"code\", type = \"byte\" }", "{ name = \"code\", type = \"byte\", commands = { 1 = \"stop\" } }"),
    line("a frame that is no table", "reply = { head = [0xFE], fields = [{ name = \"event\", type = \"byte\", to = \"WordInputReg[12]\" }] }", "reply = \"OK\""),
    line("an unknown key of a request", "request = { head = [2]", "request = { haed = [2]"),
    line("a key of CAN in a stream's request", "request = { head = [2]", "request = { id = 2, head = [2]"),
    line("a framing of a reply", "reply = { head = [0xFE]", "reply = { framing = \"tail\", head = [0xFE]"),
    line("a reply that cannot be found", "reply = { head = [0xFE], ", "reply = { "),
    line("a request without fields", "head = [0xFD], fields = [{ name = \"light\", type = \"byte\", from = \"WordOutputReg[4]\" }]", "fields = []"),
    line("a field without a value in a request", "{ name = \"light\", type = \"byte\", from = \"WordOutputReg[4]\" }", "{ name = \"light\", type = \"byte\" }"),
    line("a key of a stream in a CAN reply", "reply = { id = 0x701", "reply = { head = [1], id = 0x701"),
    line("no id in a CAN reply", "reply = { id = 0x701, ", "reply = { "),
    line("an id beyond 11 bits in a request", "request = { id = 0x601", "request = { id = 0x801"),
    line("nine bytes in a CAN reply", "{ pad = 3 }, { name = \"serial\"", "{ pad = 4 }, { name = \"serial\""),
    line("a remote reply", "reply = { id = 0x701, ", "reply = { id = 0x701, remote = true, "),
    line("a remote request with fields", "remote = true }", "remote = true, fields = [{ pad = 1 }] }"),
];

#[test]
fn every_wrong_exchange_says_what_is_wrong_with_it() {
    insta::assert_snapshot!(
        "wrong_exchanges",
        messages(CASES, |good| if good == LINE { "line.toml" } else { "robot.toml" })
    );
}
