//! The sections that only controller files have, and their `[[port]]`.

use super::gateway::{BITRATE, CYCLE, DIALECT, LINE, NAME};
use super::{Case, Key, KeyTable, Limits, Shape, TextKind, When, words};
use crate::functions::{Function, ShownState};
use crate::sim::{CommandClients, Power, RobotMode};

const fn server(name: &'static str, port: i64, text: &'static str) -> Key {
    Key::integer(name, 0, 65_535).or(port).is(text)
}

pub(crate) const COMMAND: Key = server("command", 2000, "the server of commands; 0 is any free port");
pub(crate) const STATE: Key = server("state", 2001, "the state stream; 0 is any free port");
pub(crate) const MODBUS: Key = server("modbus", 502, "Modbus TCP; 0 is any free port");
pub(crate) const UDP2011: Key = server("udp2011", 2011, "the UDP server of recipes; 0 is any free port");
pub(crate) const CONTROL: Key = server(
    "control",
    0,
    "the control socket ([control.md](control.md)), which is always at 127.0.0.1; 0 is any free port",
);

/// `[listen]`.
pub const LISTEN: KeyTable = KeyTable::of(
    "listen",
    &[
        Key::text_of("address", TextKind::Length(1, 64)).or_word("127.0.0.1").tells("IP address"),
        COMMAND,
        STATE,
        MODBUS,
        UDP2011,
        CONTROL,
    ],
);

/// The words of `power`.
pub(crate) const POWERS: [(&str, Power); 4] =
    [("boot", Power::Boot), ("off", Power::Off), ("on", Power::On), ("enabled", Power::Enabled)];
pub(crate) const POWER: Key = Key::words("power", words!(POWERS)).or_word("enabled").tells(
    "`\"off\"`, `\"on\"`, `\"enabled\"`; `\"boot\"`: the controller was just switched on, and boots to `\"off\"`",
);
/// The words of `mode` of the robot.
pub(crate) const MODES: [(&str, RobotMode); 3] =
    [("manual", RobotMode::Manual), ("auto", RobotMode::Auto), ("remote", RobotMode::Remote)];
pub(crate) const MODE: Key = Key::words("mode", words!(MODES)).or_word("remote").is("the operation mode");
/// The words of `command_clients`.
pub(crate) const COMMAND_CLIENTS: [(&str, CommandClients); 3] = [
    ("many", CommandClients::Many),
    ("one", CommandClients::RefuseSecond),
    ("newest", CommandClients::DropFirst),
];
pub(crate) const CLIENTS: Key = Key::words("command_clients", words!(COMMAND_CLIENTS)).or_word("many").tells(
    "how many clients port 2000 accepts: `\"many\"`; `\"one\"`: any further one is closed at once; `\"newest\"`: the \
     previous one is closed",
);

/// `[robot]`.
pub const ROBOT: KeyTable = KeyTable::of("robot", &[DIALECT, POWER, MODE, CLIENTS]);

/// A value of `[initial]`.
pub const INITIAL: Shape = Shape::Either(&[Shape::Number(Limits::Any), Shape::Bool]);

/// `[functions]`.
pub const FUNCTIONS: KeyTable = KeyTable::of("functions", &[
    Key::new("inputs", Shape::Map(&Shape::Words(words!(Function::ALL)), 0)).tells(
        "`FDI[1..8]`, `ToolButton[1..2]` or a bit of `BitInputReg[1..2]`, such as `\"BitInputReg[1].0\" = \"stop\"`; \
         functions `\"start\"`, `\"stop\"`, `\"pause\"`, `\"resume\"`, `\"enable\"`, `\"disable\"`, `\"reset\"` \
         ([simulated-controller.md](simulated-controller.md) section 7)",
    ),
    Key::new("outputs", Shape::Map(&Shape::Words(words!(ShownState::ALL)), 0)).tells(
        "`FDO[1..8]` or a bit of `BitOutputReg[1..2]`, such as `\"FDO[1]\" = \"running\"`; states `\"powered\"`, \
         `\"enabled\"`, `\"running\"`, `\"paused\"`, `\"error\"`, `\"emergency_stop\"`, `\"remote\"`. Such an output \
         takes no initial value",
    ),
    Key::text_of("start", TextKind::Any).tells(
        "name of a program of this file; required with the function `\"start\"`, and only with it",
    ),
]);

/// What a port of a controller is.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum BusKind {
    Rs485,
    Can,
    UdpServer,
    TcpClient,
    UdpClient,
}

/// The words of `bus`.
pub(crate) const BUSES: [(&str, BusKind); 5] = [
    ("rs485", BusKind::Rs485),
    ("can", BusKind::Can),
    ("udp-server", BusKind::UdpServer),
    ("tcp-client", BusKind::TcpClient),
    ("udp-client", BusKind::UdpClient),
];
/// What a port is.
pub const BUS: Key = Key::words("bus", words!(BUSES))
    .required()
    .tells("`\"rs485\"`, `\"can\"`, `\"udp-server\"` (one at most), `\"tcp-client\"`, `\"udp-client\"`");
const RECIPE: Key =
    Key::text_of("recipe", TextKind::Any).absent("none (idle)").tells("name of a recipe of this file");
pub(crate) const TO: Key = Key::text_of("to", TextKind::Pattern("^.+:[0-9]+$"))
    .required()
    .tells("`\"HOST:PORT\"` (`tcp-client`, `udp-client`)");

/// `[[port]]` of a controller file.
pub const PORT: KeyTable = KeyTable::of("port of a controller", &[NAME, BUS, RECIPE, CYCLE]).cases(&[
    Case { when: &[When::Is("bus", &["rs485"], &[])], keys: &[LINE] },
    Case { when: &[When::Is("bus", &["can"], &[])], keys: &[&[BITRATE]] },
    Case { when: &[When::Is("bus", &["udp-server"], &[])], keys: &[] },
    Case { when: &[When::Is("bus", &["tcp-client", "udp-client"], &[])], keys: &[&[TO]] },
]);

/// `[[program]]`.
pub const PROGRAM: KeyTable = KeyTable::of(
    "program",
    &[
        Key::text_of("name", TextKind::Pattern("^[^,()\"\\r\\n]+$"))
            .required()
            .tells("the name in `run(NAME)`"),
        Key::text_of("script", TextKind::Any).required().tells("Rhai"),
    ],
);
