//! Ports of Modbus TCP in a file: where the device is, and what such a port does not have.

use proto_core::config::{Bus, GatewayConfig};
use recipe_config::board::BOARDS;
use recipe_config::file::{Text, parse_gateway};

use super::wrong_files::{Case, messages};

const TCP: &str = include_str!("good/tcp.toml");

fn parse(toml: &str) -> Box<GatewayConfig> {
    parse_gateway(Text { name: "tcp.toml", toml }, &[]).unwrap_or_else(|error| panic!("{error}"))
}

fn at(host: &str, port: u16) -> Bus {
    Bus::ModbusTcp { host: host.try_into().unwrap(), port }
}

#[test]
fn a_port_is_at_a_host_and_perhaps_a_port() {
    let config = parse(TCP);
    assert_eq!(config.ports[0].bus, at("drive.cell", 1502));
    assert_eq!(config.ports[1].bus, at("192.168.12.50", 502));
    assert_eq!(config.view().field_ports().count(), 2);
    for (to, bus) in [
        ("10.0.0.1:1", at("10.0.0.1", 1)),
        ("plc", at("plc", 502)),
        ("[fd00::5]:503", at("fd00::5", 503)),
        ("[fd00::5]", at("fd00::5", 502)),
        ("fd00::5", at("fd00::5", 502)),
    ] {
        assert_eq!(parse(&TCP.replace("drive.cell:1502", to)).ports[0].bus, bus, "{to}");
    }
}

#[test]
fn a_board_has_room_for_two() {
    let config = parse(TCP);
    BOARDS.iter().for_each(|board| assert_eq!(board.check(&config), Ok(())));
    let third = "[[recipe]]\nname = \"third\"\nkind = \"modbus-rtu\"\n[[recipe.exchange]]\nslave = 1\n\
                 function = 3\naddress = 0\nevery_ms = 100\nread = [{ name = \"x\", type = \"word\" }]\n\
                 [[port]]\nname = \"third\"\nbus = \"modbus-tcp\"\nto = \"third\"\nrecipe = \"third\"\n";
    let config = parse(&format!("{TCP}\n{third}"));
    let unfit = BOARDS[0].check(&config).unwrap_err();
    assert_eq!(
        unfit.message,
        "the board nucleo-h743zi has no room for it: too many recipe links and Modbus TCP ports: 3 are needed; this gateway has room for 2"
    );
}

const fn tcp(what: &'static str, from: &'static str, to: &'static str) -> Case {
    Case { what, edit: (TCP, from, to) }
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    tcp("no to", "to = \"drive.cell:1502\"\n", ""),
    tcp("an empty to", "drive.cell:1502", ""),
    tcp("a to without a host", "drive.cell:1502", ":1502"),
    tcp("a to without digits behind the colon", "drive.cell:1502", "drive.cell:"),
    tcp("a port of 0", "drive.cell:1502", "drive.cell:0"),
    tcp("a port beyond 16 bits", "drive.cell:1502", "drive.cell:65536"),
    tcp("a port with a sign", "drive.cell:1502", "drive.cell:+502"),
    tcp("a URL", "drive.cell:1502", "tcp://drive.cell"),
    tcp("an address with five numbers", "\"192.168.12.50\"", "\"192.168.12.50.1\""),
    tcp("an open bracket", "drive.cell:1502", "[fd00::5"),
    tcp("no colon behind a bracket", "drive.cell:1502", "[fd00::5]502"),
    tcp("a number", "\"drive.cell:1502\"", "502"),
    tcp("the speed of a line", "absent_ms = 5000", "baud = 115200"),
    tcp("the echo of a line", "absent_ms = 5000", "echo = true"),
    tcp("the silence of a line", "absent_ms = 5000", "turnaround_us = 100"),
    tcp("the speed of a bus", "absent_ms = 5000", "bitrate = 500000"),
    tcp("an address to listen on", "to = \"drive.cell:1502\"", "listen = \"0.0.0.0:502\""),
    tcp("another kind of recipe", "name = \"rack\"\nkind = \"modbus-rtu\"\n", "name = \"rack\"\nkind = \"stream\"\nmode = \"user\"\n"),
    tcp("a recipe of frames", "[[port]]\nname = \"drive\"", "[[recipe]]\nname = \"plain\"\nkind = \"stream\"\nmode = \"user\"\n[recipe.input]\nhead = [1]\nfields = [{ name = \"x\", type = \"byte\" }]\n[[port]]\nname = \"old\"\nbus = \"modbus-tcp\"\nto = \"x\"\nrecipe = \"plain\"\n[[port]]\nname = \"drive\""),
    tcp("a write to all slaves", "slave = 1\nfunction = \"write-register\"", "slave = 0\nfunction = \"write-register\""),
    tcp("a unit id beyond a byte", "slave = 255", "slave = 256"),
    tcp("a unit id of Modbus TCP on a line", "bus = \"modbus-tcp\"\nto = \"192.168.12.50\"\n", "bus = \"modbus-rtu\"\n"),
];

#[test]
fn wrong_ports_of_modbus_tcp() {
    insta::assert_snapshot!(messages(CASES, |_| "tcp.toml"));
}
