//! Every mistake a file can have gets one message that says where, what, and what is allowed.
//!
//! Each case is one edit of a good file. The messages are frozen in `snapshots/`; review a change
//! there as you would review the text on a screen.

use std::collections::HashSet;
use std::fmt::Write;

use proto_core::config::{FieldSpec, LinkSource, OutputBinding, PortValue, StateValue};
use recipe_config::file::{Config, Text, parse, parse_controller, parse_gateway};

const GATEWAY: &str = include_str!("good/cell.toml");
pub(super) const CONTROLLER: &str = include_str!("good/robot.toml");

/// One wrong file.
pub(super) struct Case {
    /// What is wrong with it.
    pub(super) what: &'static str,
    /// The good text, what to look for in it, and what to put there.
    pub(super) edit: (&'static str, &'static str, &'static str),
}

const fn gateway(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (GATEWAY, from, to) }
}

const fn controller(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (CONTROLLER, from, to) }
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    // The text itself.
    gateway("not TOML", "[controller]", "[controller"),
    gateway("a hexadecimal byte without its mark", "head = [255, 255]", "head = [48, AA]"),
    gateway("a hexadecimal byte that begins with a digit", "head = [255, 255]", "head = [0x48, 0D]"),
    gateway("a key twice", "baud = 115200", "baud = 115200\nbaud = 9600"),
    gateway("neither kind of file", GATEWAY, "[[port]]\nname = \"x\"\n"),
    gateway("both kinds of file", "[controller]", "[robot]\n[controller]"),
    gateway("an unknown section", "[controller]", "[controler]\n[controller]"),
    gateway("a section that is no table", GATEWAY, "controller = 5\n"),
    gateway("one port instead of several", GATEWAY, "port = 5\n[controller]\naddress = \"a\"\n"),
    // [network]
    gateway("a network without an address", "[controller]", "[network]\nrouter = \"192.168.12.1\"\n[controller]"),
    gateway("an unknown key of the network", "[controller]", "[network]\naddress = \"192.168.12.20/24\"\nmask = 24\n[controller]"),
    gateway("an address without its network", "[controller]", "[network]\naddress = \"192.168.12.20\"\n[controller]"),
    gateway("a network of 31 bits", "[controller]", "[network]\naddress = \"192.168.12.20/31\"\n[controller]"),
    gateway("a network's own address", "[controller]", "[network]\naddress = \"192.168.12.0/24\"\n[controller]"),
    gateway("a router that is no address", "[controller]", "[network]\naddress = \"192.168.12.20/24\"\nrouter = \"router\"\n[controller]"),
    gateway("a router in another network", "[controller]", "[network]\naddress = \"192.168.12.20/24\"\nrouter = \"192.168.13.1\"\n[controller]"),
    gateway("a router that is the board", "[controller]", "[network]\naddress = \"192.168.12.20/24\"\nrouter = \"192.168.12.20\"\n[controller]"),
    gateway("a controller in another network without a router", "[controller]", "[network]\naddress = \"192.168.13.20/24\"\n[controller]"),
    gateway("a name server in another network without a router", "[controller]", "[network]\naddress = \"192.168.12.20/24\"\ndns = \"192.168.13.1\"\n[controller]"),
    gateway("a controller with a name and no name server", "[controller]\naddress = \"192.168.12.138\"", "[network]\naddress = \"192.168.12.20/24\"\n[controller]\naddress = \"robot.cell\""),
    // [controller]
    gateway("no address", "address = \"192.168.12.138\"", ""),
    gateway("an address with a number beyond 255", "192.168.12.138", "300.1.1.1"),
    gateway("an address of three numbers", "192.168.12.138", "192.168.12"),
    gateway("two ports of one link", "[controller]", "[controller]\nports = { udp2011 = 2012 }"),
    gateway("an address with a port", "192.168.12.138", "192.168.12.138:2000"),
    gateway("an unknown key of the controller", "address =", "adress ="),
    gateway("an unknown dialect", "[controller]", "[controller]\ndialect = \"v9\""),
    gateway("a port beyond 65535", "[controller]", "[controller]\nports = { modbus = 70000 }"),
    gateway("port 0", "[controller]", "[controller]\nports = { modbus = 0 }"),
    gateway("an unknown port", "[controller]", "[controller]\nports = { modbuss = 502 }"),
    gateway("a link without a recipe", "{ udp = 2011, recipe = \"up\" }", "{ udp = 2011 }"),
    gateway("a link to no recipe", "recipe = \"up\" }", "recipe = \"upp\" }"),
    gateway("a link with a CAN recipe", "recipe = \"up\" }", "recipe = \"orders\" }"),
    gateway("a timeout in words", "on_timeout = ", "timeout_ms = \"soon\"\non_timeout = "),
    gateway("staleness without an end", "on_timeout = ", "stale_after_ms = \"never\"\non_timeout = "),
    // [[recipe]]
    gateway("a recipe without a name", "name = \"system\"\n", ""),
    gateway("a recipe with an empty name", "name = \"system\"\n", "name = \"\"\n"),
    gateway("a name with a blank", "name = \"orders\"", "name = \"the orders\""),
    gateway("a name of 33 bytes", "name = \"orders\"", "name = \"orders-orders-orders-orders-order\""),
    gateway("two recipes with one name", "name = \"up\"\nkind", "name = \"system\"\nkind"),
    gateway("no kind", "kind = \"can\"\n", ""),
    gateway("an unknown kind", "kind = \"can\"", "kind = \"canopen\""),
    gateway("an unknown mode", "mode = \"user\"", "mode = \"manual\""),
    gateway("a recipe without parts", "[recipe.input]\nhead = [255, 255]\nfields = [\"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\nfields = [\"RobotState[8..11]\"]\n", ""),
    gateway("frames in a stream recipe", "kind = \"can\"", "kind = \"stream\""),
    gateway("a head in a CAN recipe", "on_stale = \"stop\"", "head = [1]"),
    // Stream parts.
    gateway("a head of nine bytes", "head = [255, 255]\ntail = [238, 238]", "head = [1, 2, 3, 4, 5, 6, 7, 8, 9]"),
    gateway("a tail of nine bytes", "tail = [238, 238]", "tail = [1, 2, 3, 4, 5, 6, 7, 8, 9]"),
    gateway("a head byte of 256", "head = [255, 255]\ntail = [238, 238]", "head = [255, 256]"),
    gateway("a head that is a string", "head = [255, 255]\ntail = [238, 238]", "head = \"FF FF\""),
    gateway("a head byte that is a string", "head = [255, 255]\ntail = [238, 238]", "head = [\"FF\"]"),
    gateway("neither head nor tail on RS-485", "head = [255, 255]\ntail = [238, 238]", "head = []"),
    gateway("neither head nor tail on TCP", "head = [255, 255]\nfields = [\"RobotState[8..11]\"]\n\n[[recipe]]\nname = \"orders\"", "fields = [\"RobotState[8..11]\"]\n\n[[recipe]]\nname = \"orders\""),
    gateway("no fields at all", "tail = [238, 238]\nfields = [\"DigitalOutputCommand[1]\"]", "tail = [238, 238]\nfields = []"),
    gateway("no list of fields", "tail = [238, 238]\nfields = [\"DigitalOutputCommand[1]\"]", "tail = [238, 238]"),
    gateway("129 fields", "tail = [254, 254]\nfields = [\"RobotState[8..11]\"]", "tail = [254, 254]\nfields = [\"BitOutputReg[1..10]\", \"WordOutputReg[1..32]\", \"RobotState[1..32]\", \"FloatOutputReg[1..32]\", \"WordOutputReg[1..23]\"]"),
    gateway("a frame of 516 bytes", "tail = [254, 254]\nfields = [\"RobotState[8..11]\"]", "tail = [254, 254]\nfields = [\"RobotState[1..32]\", \"FloatOutputReg[1..32]\", \"RobotState[1..32]\", \"FloatOutputReg[1..32]\"]"),
    // System variables.
    gateway("an unknown variable", "fields = [\"RobotState[8..11]\"]\n\n[[recipe]]\nname = \"up\"", "fields = [\"RobotStates[8]\"]\n\n[[recipe]]\nname = \"up\""),
    gateway("a variable without index", "\"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\ntail", "\"DigitalOutputCommand\"]\n[recipe.output]\nhead = [255, 255]\ntail"),
    gateway("an index beyond the last", "RobotState[8..11]\"]\n\n[[recipe]]\nname = \"up\"", "RobotState[8..33]\"]\n\n[[recipe]]\nname = \"up\""),
    gateway("a range that runs backwards", "RobotState[8..11]\"]\n\n[[recipe]]\nname = \"up\"", "RobotState[11..8]\"]\n\n[[recipe]]\nname = \"up\""),
    gateway("an output of the robot in an input part", "fields = [\"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\ntail", "fields = [\"RobotState[8]\"]\n[recipe.output]\nhead = [255, 255]\ntail"),
    gateway("an input of the robot in an output part", "RobotState[8..11]\"]\n\n[[recipe]]\nname = \"up\"", "RobotState[8..11]\", \"ForceEnd[1]\"]\n\n[[recipe]]\nname = \"up\""),
    gateway("an input variable twice in a part", "fields = [\"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\ntail", "fields = [\"DigitalOutputCommand[1..2]\", \"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\ntail"),
    gateway("a user field in a realtime recipe", "fields = [\"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\ntail", "fields = [{ name = \"x\", type = \"byte\" }]\n[recipe.output]\nhead = [255, 255]\ntail"),
    // User fields.
    gateway("a variable in a user recipe", "{ name = \"fixed\", type = \"byte\", value = 125 }", "\"RobotState[8]\""),
    gateway("a field without a name", "{ name = \"code\", type", "{ type"),
    gateway("a field with an unknown type", "name = \"fixed\", type = \"byte\"", "name = \"fixed\", type = \"uint8\""),
    gateway("an unknown key of an input field", "scale = 10", "factor = 10"),
    gateway("a scale without to", "to = \"WordInputReg[1]\", ", ""),
    gateway("when without commands", "scale = 10", "when = \"frame\""),
    gateway("a scale of 0", "scale = 10", "scale = 0"),
    gateway("a scale that is not finite", "scale = 10", "scale = inf"),
    gateway("a scale beyond a float", "scale = 10", "scale = 1e300"),
    gateway("to an output of the robot", "to = \"WordInputReg[1]\"", "to = \"WordOutputReg[1]\""),
    gateway("to a range", "to = \"WordInputReg[1]\"", "to = \"WordInputReg[1..2]\""),
    gateway("two fields to one variable", "{ name = \"order\", type = \"byte\", commands = { 1 = \"run(pick.jspf,50)\", 2 = \"stop\" } }", "{ name = \"order\", type = \"byte\", to = \"WordInputReg[1]\" }"),
    gateway("a table without commands", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" }", "{}"),
    gateway("a command that port 2000 does not know", "2 = \"stop\"", "2 = \"halt\""),
    gateway("a command with a speed of 150", "run(pick.jspf,50)", "run(pick.jspf,150)"),
    gateway("a command without an argument", "run(pick.jspf,50)", "run"),
    gateway("a command that is too long", "run(pick.jspf,50)", "run(a-program-with-a-name-that-is-longer-than-any-name-that-somebody-would-want-to-type-into-a-pendant.jspf,50)"),
    gateway("a command for a value the field never has", "2 = \"stop\"", "300 = \"stop\""),
    gateway("a command for no number", "2 = \"stop\"", "two = \"stop\""),
    gateway("two commands for one value", "2 = \"stop\"", "0x01 = \"stop\""),
    gateway("commands that overlap", "2 = \"stop\"", "\"1..9\" = \"stop\""),
    gateway("a range of values that runs backwards", "2 = \"stop\"", "\"9..2\" = \"stop\""),
    gateway("a range of values without an end", "2 = \"stop\"", "\"2..\" = \"stop\""),
    gateway("a range beyond the field", "2 = \"stop\"", "\"2..300\" = \"stop\""),
    gateway("a speed from a range that is no speed at its end", "2 = \"stop\"", "\"2..101\" = \"speed({value})\""),
    gateway("an empty command", "2 = \"stop\"", "2 = \"\""),
    gateway("an idle value that picks a command", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" } }", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" }, idle = 2 }"),
    gateway("an idle value that is no integer", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" } }", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" }, idle = \"none\" }"),
    gateway("idle without commands", "scale = 10", "idle = 3"),
    gateway("an unknown base", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" } }", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" }, base = \"hold\" }"),
    gateway("a base that is kept although each frame acts", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" } }", "{ 1 = \"run(pick.jspf,50)\", 2 = \"stop\" }, when = \"frame\", base = \"keep\" }"),
    gateway("an edge of a field with several bits", "2 = \"stop\"", "rising = \"stop\""),
    gateway("commands of a float field", "{ name = \"order\", type = \"byte\"", "{ name = \"order\", type = \"float\""),
    gateway("an output field without a source", "{ name = \"fixed\", type = \"byte\", value = 125 }", "{ name = \"fixed\", type = \"byte\" }"),
    gateway("from and value", "value = 125", "value = 125, from = \"reply\""),
    gateway("a constant that does not fit", "value = 125", "value = 256"),
    gateway("a constant with a fraction", "value = 125", "value = 1.5"),
    gateway("a counter in a double", "{ name = \"count\", type = \"byte\", from = \"counter\" },\n    { name = \"code\", type = \"byte\", from = \"reply\" },\n    { name = \"fixed\", type = \"byte\", value = 125 }", "{ name = \"count\", type = \"double\", from = \"counter\" }"),
    gateway("from something unknown", "from = \"reply\"", "from = \"answer\""),
    gateway("a scale of a constant", "value = 125", "value = 125, scale = 2"),
    // Sending.
    gateway("an unknown trigger", "send = \"frame\"", "send = \"always\""),
    gateway("a rising edge of nothing", "send = \"frame\"", "send = \"rising:\""),
    gateway("a rising edge of a word", "send = \"frame\"", "send = \"rising:WordOutputReg[1].0\""),
    gateway("a rising edge of a reserved bit", "send = \"frame\"", "send = \"rising:DigitalSignalStatus[3].2\""),
    gateway("a trigger in a realtime recipe", "tail = [254, 254]", "tail = [254, 254]\nsend = \"change\""),
    gateway("an unknown on_stale", "on_stale = \"stop\"", "on_stale = \"zero\""),
    // CAN frames.
    gateway("a frame without id", "id = 0x101\n", ""),
    gateway("an id in quotes", "id = 0x101", "id = \"0x181\""),
    gateway("an extended id in quotes", "id = 0x101", "extended = true\nid = \"257\""),
    gateway("an id that is a word", "id = 0x101", "id = \"hand\""),
    gateway("a program without parentheses", "run(pick.jspf,50)", "run pick.jspf"),
    gateway("a program in single quotes", "run(pick.jspf,50)", "run('pick.jspf',50)"),
    gateway("a baud rate by another name", "baud = 115200", "baudrate = 115200"),
    gateway("a baud rate in quotes", "baud = 115200", "baud = \"115200\""),
    gateway("a port of the controller by another name", "[controller]", "[controller]\nmodbus_port = 1502"),
    gateway("a standard id beyond 11 bits", "id = 0x101", "id = 0x801"),
    gateway("an extended id beyond 29 bits", "id = 0x101", "extended = true\nid = 0x20000000"),
    gateway("two frames with one id", "[[recipe.output.frame]]\nid = 0x102", "[[recipe.output.frame]]\nid = 0x102\nfields = [{ name = \"x\", type = \"byte\", value = 1 }]\n[[recipe.output.frame]]\nid = 0x102"),
    gateway("nine bytes in a frame", "name = \"fixed\", type = \"byte\"", "name = \"fixed\", type = \"double\""),
    gateway("a CAN part without frames", "[[recipe.input.frame]]\nid = 0x101\nfields = [\n    { name = \"order\", type = \"byte\", commands = { 1 = \"run(pick.jspf,50)\", 2 = \"stop\" } },\n    { name = \"part\", type = \"word\", to = \"WordInputReg[1]\", scale = 10 },\n]", "[recipe.input]"),
    // [[port]]
    gateway("a port without a bus", "bus = \"can\"\n", ""),
    gateway("an unknown bus", "bus = \"can\"", "bus = \"canbus\""),
    gateway("a port without a recipe", "recipe = \"orders\"\n", ""),
    gateway("two ports with one name", "name = \"can-1\"", "name = \"rs485-1\""),
    gateway("a key of another bus", "bitrate = 500000", "baud = 500000"),
    gateway("an unknown key of a port", "cycle_ms = 4", "cycle = 4"),
    gateway("a baud rate too low", "baud = 115200", "baud = 300"),
    gateway("a baud rate that is a string", "baud = 115200", "baud = \"fast\""),
    gateway("a number that TOML cannot hold", "baud = 115200", "baud = 99999999999999999999"),
    gateway("an unknown parity", "baud = 115200", "parity = \"mark\""),
    gateway("three stop bits", "baud = 115200", "stop_bits = 3"),
    gateway("no idle gap", "baud = 115200", "idle_gap_ms = 0"),
    gateway("an idle gap of a minute", "baud = 115200", "idle_gap_ms = 60000"),
    gateway("a turnaround of ten seconds", "baud = 115200", "turnaround_us = 10_000_000"),
    gateway("a bitrate too high", "bitrate = 500000", "bitrate = 5000000"),
    gateway("a cycle below 4 ms", "cycle_ms = 4", "cycle_ms = 2"),
    gateway("a negative cycle", "cycle_ms = 4", "cycle_ms = -4"),
    gateway("a cycle of two hours", "cycle_ms = 4", "cycle_ms = 7_200_000"),
    gateway("a timeout of 0", "cycle_ms = 4", "timeout_ms = 0"),
    gateway("stale at once", "cycle_ms = 4", "stale_after_ms = 0"),
    gateway("a CAN recipe on RS-485", "recipe = \"system\"\ncycle", "recipe = \"orders\"\ncycle"),
    gateway("a stream recipe on CAN", "recipe = \"orders\"\n\n[[port]]", "recipe = \"up\"\n\n[[port]]"),
    gateway("a CAN recipe on a way up", "listen = \"0.0.0.0:50000\"\nrecipe = \"up\"", "listen = \"0.0.0.0:50000\"\nrecipe = \"orders\""),
    gateway("no address to listen on", "listen = \"0.0.0.0:50000\"\n", ""),
    gateway("an address without a port", "0.0.0.0:50000", "0.0.0.0"),
    gateway("nine ports", "[[port]]\nname = \"can-1\"", "[[port]]\nname = \"u1\"\nbus = \"udp-listen\"\nlisten = \"0.0.0.0:1\"\nrecipe = \"up\"\n[[port]]\nname = \"u2\"\nbus = \"udp-listen\"\nlisten = \"0.0.0.0:2\"\nrecipe = \"up\"\n[[port]]\nname = \"u3\"\nbus = \"udp-listen\"\nlisten = \"0.0.0.0:3\"\nrecipe = \"up\"\n[[port]]\nname = \"u4\"\nbus = \"udp-listen\"\nlisten = \"0.0.0.0:4\"\nrecipe = \"up\"\n[[port]]\nname = \"u5\"\nbus = \"udp-listen\"\nlisten = \"0.0.0.0:5\"\nrecipe = \"up\"\n[[port]]\nname = \"u6\"\nbus = \"udp-listen\"\nlisten = \"0.0.0.0:6\"\nrecipe = \"up\"\n[[port]]\nname = \"can-1\""),
    gateway("two ports that listen on one address", "[[port]]\nname = \"can-1\"", "[[port]]\nname = \"tcp-2\"\nbus = \"tcp-listen\"\nlisten = \"0.0.0.0:50000\"\nrecipe = \"up\"\n[[port]]\nname = \"can-1\""),
    // Ownership, ways up and down, safe values.
    gateway("two owners of one variable", "to = \"WordInputReg[1]\", scale = 10", "to = \"DigitalOutputCommand[1]\""),
    gateway("a variable that nothing can carry up", "to = \"WordInputReg[1]\"", "to = \"FloatInputReg[1]\""),
    gateway("a variable that nobody writes and nobody can read", "fields = [\"DigitalOutputCommand[1]\"]\n[recipe.output]\nhead = [255, 255]\nfields", "fields = [\"DigitalOutputCommand[1]\", \"ForceEnd[1..6]\"]\n[recipe.output]\nhead = [255, 255]\nfields"),
    gateway("a variable that nothing shows", "RobotState[8..11]\"]\n\n[[recipe]]\nname = \"up\"", "RobotState[8..11]\", \"RobotState[26]\"]\n\n[[recipe]]\nname = \"up\""),
    gateway("a field from a variable that nothing shows", "value = 125", "from = \"RobotState[27]\""),
    gateway("a safe value of somebody else's variable", "{ \"DigitalOutputCommand[1]\" = 0 }", "{ \"WordInputReg[1]\" = 0 }"),
    gateway("a safe value that does not fit", "{ \"DigitalOutputCommand[1]\" = 0 }", "{ \"DigitalOutputCommand[1]\" = 256 }"),
    gateway("a safe value of an unknown variable", "{ \"DigitalOutputCommand[1]\" = 0 }", "{ \"DO[1]\" = 0 }"),
    gateway("two safe values of one variable", "{ \"DigitalOutputCommand[1]\" = 0 }", "{ \"DigitalOutputCommand[1]\" = 0, __DigitalOutputCommand_1 = 1 }"),
    gateway("an unknown word for a timeout", "{ \"DigitalOutputCommand[1]\" = 0 }", "\"zero\""),
    // The controller's own file.
    controller("an address to listen on that is a name", "address = \"127.0.0.1\"", "address = \"localhost\""),
    controller("a listening port beyond 65535", "command = 2000", "command = 65536"),
    controller("two servers on one port", "command = 2000", "command = 2001"),
    controller("an unknown server", "command = 2000", "comand = 2000"),
    controller("an unknown state of power", "power = \"enabled\"", "power = \"standby\""),
    controller("an unknown operation mode", "mode = \"remote\"", "mode = \"automatic\""),
    controller("an unknown number of clients of port 2000", "mode = \"remote\"", "command_clients = \"two\""),
    controller("a number of clients of port 2000", "mode = \"remote\"", "command_clients = 1"),
    controller("an unknown dialect of the controller", "dialect = \"v2.3\"", "dialect = \"2.3\""),
    controller("an initial value of nothing known", "\"DI[3]\"", "\"DX[3]\""),
    controller("an initial bit that is not there", "\"DI[3]\"", "\"DI[17]\""),
    controller("an initial bit of 2", "\"DI[3]\" = true", "\"DI[3]\" = 2"),
    controller("an initial word of 70000", "= 7", "= 70000"),
    controller("an initial value in reserved bits", "\"DI[3]\" = true", "\"DigitalSignalStatus[3]\" = 4"),
    controller("an initial voltage of 12 V", "= 2.5", "= 12"),
    // Sources beside the variables, health and safe values at the start.
    gateway("an unknown value of the state packet", "from = \"reply\"", "from = \"controller.temperature\""),
    gateway("a value without its number", "from = \"reply\"", "from = \"controller.joint_position\""),
    gateway("a joint that is not there", "from = \"reply\"", "from = \"controller.joint_torque[7]\""),
    gateway("a reserved value", "from = \"reply\"", "from = \"controller.reserved_336[1]\""),
    gateway("a number where there is one", "from = \"reply\"", "from = \"controller.mode[1]\""),
    gateway("a speed that the dialect does not send", "from = \"reply\"", "from = \"controller.speed\""),
    gateway("a reply of port 2000 as a source", "from = \"reply\"", "from = \"controller.last_error\""),
    gateway("an unknown value of a port", "from = \"reply\"", "from = \"port.speed\""),
    gateway("the health of an unknown port", "from = \"reply\"", "from = \"port.rs485-9.alive\""),
    gateway("the health of a listening port", "from = \"reply\"", "from = \"port.up-tcp.alive\""),
    gateway("an unknown value of a link", "from = \"reply\"", "from = \"link.modbus.down\""),
    gateway("an unknown link", "from = \"reply\"", "from = \"link.modbsu.up\""),
    gateway("the link of a field port", "from = \"reply\"", "from = \"link.rs485-1.up\""),
    gateway("a count with a scale", "from = \"reply\"", "from = \"port.frames\", scale = 2"),
    gateway("health in a bit", "recipe = \"orders\"\n\n[[port]]", "recipe = \"orders\"\nhealth = { alive = \"BitInputReg[3].0\" }\n\n[[port]]"),
    gateway("health in a byte of bits", "recipe = \"orders\"\n\n[[port]]", "recipe = \"orders\"\nhealth = { alive = \"BitInputReg[3]\" }\n\n[[port]]"),
    gateway("health in a variable of the port's frames", "recipe = \"orders\"\n\n[[port]]", "recipe = \"orders\"\nhealth = { age_ms = \"WordInputReg[1]\" }\n\n[[port]]"),
    gateway("unknown health", "recipe = \"orders\"\n\n[[port]]", "recipe = \"orders\"\nhealth = { dead = \"WordInputReg[2]\" }\n\n[[port]]"),
    gateway("health of a listening port", "listen = \"0.0.0.0:50000\"", "listen = \"0.0.0.0:50000\"\nhealth = { alive = \"WordInputReg[2]\" }"),
    gateway("safe at the start without safe values", "recipe = \"orders\"\n\n[[port]]", "recipe = \"orders\"\nsafe_at_start = true\n\n[[port]]"),
    gateway("a refreshed output that is not sent on change", "recipe = \"orders\"\n\n[[port]]", "recipe = \"orders\"\nrefresh_ms = 1000\n\n[[port]]"),
    controller("an initial value twice", "\"DI[3]\" = true", "__WordOutputReg_1 = 8"),
    // Functions of functional inputs and outputs.
    controller("an unknown key of the functions", "[[program]]", "[functions]\nbuttons = {}\n[[program]]"),
    controller("a function of an input that has none", "[[program]]", "[functions]\ninputs = { \"DI[1]\" = \"stop\" }\n[[program]]"),
    controller("a function of a whole byte", "[[program]]", "[functions]\ninputs = { \"BitInputReg[1]\" = \"stop\" }\n[[program]]"),
    controller("a function of a register that triggers none", "[[program]]", "[functions]\ninputs = { \"BitInputReg[3].0\" = \"stop\" }\n[[program]]"),
    controller("a function of an input that is not there", "[[program]]", "[functions]\ninputs = { \"FDI[9]\" = \"stop\" }\n[[program]]"),
    controller("a function of nothing known", "[[program]]", "[functions]\ninputs = { \"F1\" = \"stop\" }\n[[program]]"),
    controller("an unknown function", "[[program]]", "[functions]\ninputs = { \"FDI[1]\" = \"halt\" }\n[[program]]"),
    controller("two functions of one input", "[[program]]", "[functions]\ninputs = { \"FDI[1]\" = \"stop\", \"DigitalSignalStatus[7].0\" = \"pause\" }\n[[program]]"),
    controller("a start of no program", "[[program]]", "[functions]\ninputs = { \"FDI[1]\" = \"start\" }\n[[program]]"),
    controller("a start of an unknown program", "[[program]]", "[functions]\ninputs = { \"FDI[1]\" = \"start\" }\nstart = \"ecco.jspf\"\n[[program]]"),
    controller("a start without programs", "[[program]]\nname = \"echo.jspf\"\nscript = \"comm_recv(\\\"rs485\\\")\"", "[functions]\ninputs = { \"FDI[1]\" = \"start\" }\nstart = \"echo.jspf\""),
    controller("a program that no input starts", "[[program]]", "[functions]\ninputs = { \"FDI[1]\" = \"stop\" }\nstart = \"echo.jspf\"\n[[program]]"),
    controller("a state of an output that shows none", "[[program]]", "[functions]\noutputs = { \"DO[1]\" = \"running\" }\n[[program]]"),
    controller("an unknown state of an output", "[[program]]", "[functions]\noutputs = { \"FDO[1]\" = \"moving\" }\n[[program]]"),
    controller("two states of one output", "[[program]]", "[functions]\noutputs = { \"BitOutputReg[1].0\" = \"running\", \"__BitOutputReg_1.0\" = \"paused\" }\n[[program]]"),
    controller("an initial value of an output that shows a state", "[initial]\n", "[functions]\noutputs = { \"DigitalSignalStatus[8].0\" = \"running\" }\n[initial]\n\"FDO[1]\" = true\n"),
    controller("a gateway's binding in a controller's file", "{ name = \"input1\", type = \"byte\" }", "{ name = \"input1\", type = \"byte\", to = \"WordInputReg[1]\" }"),
    controller("a gateway's trigger in a controller's file", "[recipe.output]\n", "[recipe.output]\nsend = \"period\"\n"),
    controller("a gateway's bus in a controller's file", "bus = \"udp-client\"", "bus = \"udp-listen\""),
    controller("a realtime recipe without head and tail on TCP", "bus = \"udp-client\"", "bus = \"tcp-client\""),
    controller("a user recipe on UDP", "bus = \"udp-server\"\nrecipe = \"system\"", "bus = \"udp-server\"\nrecipe = \"bytes\""),
    controller("two UDP servers", "bus = \"udp-client\"\nto = \"127.0.0.1:50000\"", "bus = \"udp-server\""),
    controller("a client without a target", "to = \"127.0.0.1:50000\"\n", ""),
    controller("a target whose address is none", "127.0.0.1:50000", "127.0.0.1.1:50000"),
    controller("a target without a port", "to = \"127.0.0.1:50000\"", "to = \"127.0.0.1\""),
    controller("a program without a script", "script = \"comm_recv(\\\"rs485\\\")\"\n", ""),
    controller("a program that run cannot name", "name = \"echo.jspf\"", "name = \"echo,50\""),
    controller("two programs with one name", "[[program]]", "[[program]]\nname = \"echo.jspf\"\nscript = \"\"\n[[program]]"),
];

#[test]
fn the_good_files_are_good() {
    parse_gateway(Text { name: "cell.toml", toml: GATEWAY }, &[]).unwrap_or_else(|error| panic!("{error}"));
    parse_controller(Text { name: "robot.toml", toml: CONTROLLER }, &[])
        .unwrap_or_else(|error| panic!("{error}"));
}

/// Without any section of its own, a file still is a controller's, which may leave out all of them.
#[test]
fn a_controller_file_may_leave_out_all_its_sections() {
    let parsed = |toml| parse(Text { name: "robot.toml", toml }, &[]);
    let ports = "[[recipe]]\nname = \"tool\"\nkind = \"stream\"\nmode = \"user\"\n[recipe.input]\nhead = \
                 [1]\nfields = [{ name = \"force\", type = \"float\" }]\n\n[[port]]\nname = \
                 \"rs485\"\nbus = \"rs485\"\nrecipe = \"tool\"\n";
    for toml in ["", ports] {
        assert!(matches!(parsed(toml), Ok(Config::Controller(_))), "{toml:?}: {:?}", parsed(toml));
        let text = Text { name: "robot.toml", toml };
        assert!(recipe_config::file::parse_recipes(text, &[]).is_ok());
    }
    // Who forgot the section is told how the file was read.
    let gateways = ports.replace("type = \"float\"", "type = \"float\", to = \"FloatInputReg[1]\"");
    let error = parsed(&gateways).unwrap_err().to_string();
    assert!(
        error.ends_with("(without [controller] it is read as a controller file; a gateway file has that)")
    );
    let error = parse_gateway(Text { name: "cell.toml", toml: ports }, &[]).unwrap_err().to_string();
    assert!(error.contains("controller"), "{error}");
}

/// Every source and key of a port's health, in an otherwise good file.
#[test]
fn sources_and_health_are_read() {
    let toml = GATEWAY
        .replacen("from = \"reply\"", "from = \"port.rs485-1.age_ms\", scale = 0.1", 1)
        .replacen("from = \"counter\"", "from = \"link.up-tcp.up\", scale = -1, offset = 1", 1)
        .replacen("value = 125", "from = \"controller.joint_position[6]\", scale = 100, offset = 1", 1)
        .replacen("send = \"frame\"", "send = \"change\"", 1)
        .replacen("cycle_ms = 4\n", "cycle_ms = 4\nsafe_at_start = true\n", 1)
        .replacen(
            "recipe = \"orders\"\n\n[[port]]",
            "recipe = \"orders\"\nrefresh_ms = 1000\nhealth = { alive = \"WordInputReg[20]\", frames = \
             \"WordInputReg[21]\", age_ms = \"WordInputReg[22]\", rejected = \"WordInputReg[23]\", ignored = \
             \"WordInputReg[24]\" }\n\n[[port]]",
            1,
        );
    let config =
        parse_gateway(Text { name: "cell.toml", toml: &toml }, &[]).unwrap_or_else(|error| panic!("{error}"));
    let sources: Vec<_> = config.fields.iter().filter_map(FieldSpec::source).collect();
    let age = OutputBinding::Port { port: Some(0), value: PortValue::Age, scale: 0.1, offset: 0.0 };
    let value = StateValue::parse("joint_position[6]").unwrap();
    let joint = OutputBinding::State { value, scale: 100.0, offset: 1.0 };
    let link = OutputBinding::Link { link: LinkSource::Listening(2), scale: -1.0, offset: 1.0 };
    assert_eq!(sources, [link, age, joint]);
    assert!(config.ports[0].safe_at_start && !config.ports[1].safe_at_start);
    assert_eq!(config.ports[1].refresh.map(|refresh| refresh.as_millis()), Some(1_000));
    let told: Vec<_> =
        config.ports[1].health.iter().map(|(value, var)| (value.name(), var.index())).collect();
    assert_eq!(told, [("alive", 20), ("frames", 21), ("age_ms", 22), ("rejected", 23), ("ignored", 24)]);
}

#[test]
fn only_an_item_of_a_list_is_taken_for_a_byte() {
    for toml in ["a = 1\na = 2", "a = { b = 1, b = 2 }", "b = ab"] {
        let error = parse(Text { name: "x.toml", toml }, &[]).unwrap_err().to_string();
        assert!(!error.contains("hexadecimal"), "{error}");
    }
}

#[test]
fn every_wrong_file_says_what_is_wrong_with_it() {
    assert!(CASES.len() >= 40);
    let all = messages(CASES, |good| if good == GATEWAY { "cell.toml" } else { "robot.toml" });
    insta::assert_snapshot!("wrong_files", all);
}

/// What each case is, and its message, which must be one line and no other case's. `name` names the good
/// files.
pub(super) fn messages(cases: &[Case], name: impl Fn(&str) -> &'static str) -> String {
    let mut all = String::new();
    let mut seen = HashSet::new();
    for Case { what, edit: (good, from, to) } in cases {
        assert!(good.contains(from), "{what}: nothing to edit");
        let name = name(good);
        let wrong = good.replacen(from, to, 1);
        let error = match parse(Text { name, toml: &wrong }, &[]) {
            Ok(_) => panic!("{what}: accepted"),
            Err(error) => error.to_string(),
        };
        assert!(error.starts_with(name) && !error.contains('\n'), "{what}: {error}");
        let message = error.splitn(4, ':').last().unwrap_or_default().to_owned();
        assert!(seen.insert(message), "{what}: the same message as another mistake: {error}");
        writeln!(all, "{what}\n  {error}").unwrap();
    }
    all
}

#[test]
fn every_wrong_override_says_what_is_wrong_with_it() {
    let mut all = String::new();
    for wrong in [
        "port.rs485-1.baud",
        "port..baud=1",
        "port.rs485-9.baud=9600",
        "port.rs485-1.baud=300",
        "port.rs485-1.bauds=9600",
        "port.rs485-1.baud.x=1",
        "controller.ports.modbus=no",
        "recipe.system.input.head=[1,",
        "recipe.orders.input.frame.2.id=5",
        "recipe.orders.input.frame.1.id=0x800",
        "nothing=1",
        "network.address=192.168.12.20",
        "network.router=192.168.12.1",
    ] {
        let text = Text { name: "cell.toml", toml: GATEWAY };
        let error = parse_gateway(text, &[wrong.to_owned()]).expect_err(wrong).to_string();
        assert!(error.starts_with(&format!("--set {wrong}: ")), "{error}");
        writeln!(all, "{error}").unwrap();
    }
    insta::assert_snapshot!("wrong_overrides", all);
}

#[test]
fn overrides_change_what_they_name() {
    let overrides = [
        "controller.address=10.0.0.2",
        "controller.ports.modbus=1502",
        "port.rs485-1.baud=9600",
        "port.can-1.recipe=\"orders\"",
        "port.2.cycle_ms=10",
        "recipe.orders.input.frame.1.id=0x111",
        "recipe.system.output.tail=[1, 2, 3]",
        "port.rs485-1.on_timeout.DigitalOutputCommand[1]=5",
    ];
    let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
    let config = parse_gateway(Text { name: "cell.toml", toml: GATEWAY }, &overrides)
        .unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(config.controller.address, "10.0.0.2");
    assert_eq!(config.controller.modbus_port, 1502);
    assert_eq!(config.ports[1].cycle.as_millis(), 10);
    assert_eq!(config.safe_values[0].value.as_f64(), 5.0);
    let plain = parse_gateway(Text { name: "cell.toml", toml: GATEWAY }, &[]).unwrap();
    assert_ne!(plain.recipes[0], config.recipes[0], "the tail");
    assert_ne!(plain.recipes[2], config.recipes[2], "the id");
    assert_ne!(plain.ports[0], config.ports[0], "the speed");
}

#[test]
fn a_port_that_is_set_counts_for_the_recipe_link() {
    let port = |sets: &[&str]| {
        let sets: Vec<String> = sets.iter().map(|&set| set.to_owned()).collect();
        let config = parse_gateway(Text { name: "cell.toml", toml: GATEWAY }, &sets)?;
        Ok(config.controller.recipe_link.unwrap().udp_port)
    };
    let (of_link, of_ports) = ("controller.recipe_link.udp=2012", "controller.ports.udp2011=2013");
    assert_eq!(port(&[]), Ok(2011));
    assert_eq!(port(&[of_link]), Ok(2012));
    assert_eq!(port(&[of_ports]), Ok(2013), "not lost against that of the file");
    let both: Result<u16, recipe_config::file::FileError> = port(&[of_link, of_ports]);
    let message = both.unwrap_err().to_string();
    assert!(message.contains("is not the port of controller.recipe_link.udp, 2012"), "{message}");
}

#[test]
fn the_other_kind_of_file_is_recognised() {
    let error = parse_gateway(Text { name: "robot.toml", toml: CONTROLLER }, &[]).unwrap_err().to_string();
    insta::assert_snapshot!(error, @"robot.toml: this is a controller file, not a gateway file; run it with host-sim controller -c FILE");
    let error = parse_controller(Text { name: "cell.toml", toml: GATEWAY }, &[]).unwrap_err().to_string();
    insta::assert_snapshot!(error, @"cell.toml: this is a gateway file, not a controller file; run it with host-sim gateway -c FILE");
}
