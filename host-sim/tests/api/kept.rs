//! Devices whose clients stay connected while another configuration takes the place of one.

use std::fs::File;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::OpenOptionsExt;

use recipe_test_kit::until;

use crate::kit::*;

/// A panel on a CAN bus.
fn can(timeout_ms: u32) -> String {
    format!(
        r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "panel"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 1
fields = [{{ name = "outputs", type = "byte", to = "DigitalOutputCommand[1]" }}]

[[port]]
name = "device"
bus = "can"
recipe = "panel"
timeout_ms = {timeout_ms}
"#
    )
}

/// A client that opened a pseudoterminal once.
fn terminal(cell: &Cell) -> File {
    let flags = (rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::NONBLOCK).bits().cast_signed();
    let link = cell.folder.path().join("line");
    File::options().read(true).write(true).custom_flags(flags).open(link).unwrap()
}

/// Everything that replaces the gateway; `reaches` makes sure after each that what the client sends arrives.
fn replace(cell: &Cell, configs: [String; 3], mut reaches: impl FnMut(u8)) {
    let [second, third, wrong] = configs;
    reaches(1);
    put(cell.console, &cell.base(), &second).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    reaches(2);
    post(cell.console, "confirm", "").must_be(200);
    reaches(3);
    put(cell.console, &cell.base(), &third).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    reaches(4);
    post(cell.console, "rollback", "").must_be(200);
    reaches(5);
    put(cell.console, &cell.base(), &wrong).must_be(201);
    post(cell.console, "apply", "").must_be(409);
    reaches(6);
    post(cell.console, "rollback", "").must_be(200);
    assert_eq!(cell.revisions()["live"], 1);
    reaches(7);
    post(cell.console, "apply", r#"{"revision": 2, "confirm_s": 1}"#).must_be(200);
    cell.until_revisions("taken back", |revisions| revisions["running"] == 1);
    reaches(8);
}

/// Configurations that take each other's place: the second one with another baud rate, the last one does not start.
fn lines() -> [String; 3] {
    let faster = config(450).replace("recipe = \"panel\"", "recipe = \"panel\"\nbaud = 9600");
    [faster, config(400), config(400).replace("name = \"device\"", "name = \"other\"")]
}

#[test]
fn a_terminal_stays_open() {
    for device in ["pty:FOLDER/line", "pty-paced:FOLDER/line"] {
        let cell = Cell::with(device, &config(500));
        let mut panel = terminal(&cell);
        replace(&cell, lines(), |value| cell.switch(&mut panel, value));
        let link = cell.folder.path().join("line");
        cell.gateway.end();
        assert!(std::fs::symlink_metadata(&link).is_err(), "the link is removed at the end");
    }
}

#[test]
fn a_terminal_stays_open_that_the_next_gateway_had_taken_before_it_failed() {
    let cell = Cell::with("pty:FOLDER/line", &config(500));
    let mut panel = terminal(&cell);
    cell.switch(&mut panel, 1);
    // Sockets are opened behind the devices, and this address is taken.
    let console = cell.console;
    let listens = format!(
        "\n[[port]]\nname = \"robot\"\nbus = \"tcp-listen\"\nlisten = \"{console}\"\nrecipe = \"link\"\n"
    ) + "\n[[recipe]]\nname = \"link\"\nkind = \"stream\"\nmode = \"realtime\"\n[recipe.input]\nhead = [1, 2]\n"
        + "tail = [3, 4]\nfields = [\"DigitalOutputCommand[1]\"]\n";
    put(cell.console, &cell.base(), &(config(400) + &listens)).must_be(201);
    let failed = post(cell.console, "apply", "").must_be(409).json();
    assert!(failed["error"].as_str().unwrap().contains("cannot listen on"), "{failed}");
    cell.switch(&mut panel, 2);
}

#[test]
fn a_connection_stays_open() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    let place = panel.peer_addr().unwrap().to_string();
    replace(&cell, lines(), |value| cell.switch(&mut panel, value));
    // It is the only client.
    let mut second = TcpStream::connect(&place).unwrap();
    second.set_read_timeout(Some(recipe_test_kit::PATIENCE)).unwrap();
    assert_eq!(second.read(&mut [0]).unwrap_or(0), 0, "it is refused");
    drop(panel);
    until("the next one is served", || {
        let mut panel = TcpStream::connect(&place).unwrap();
        panel.set_read_timeout(Some(std::time::Duration::from_millis(300))).unwrap();
        panel.write_all(&frame(9)).unwrap();
        let is_served =
            panel.read(&mut [0]).is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock);
        is_served.then_some(())
    });
    cell.outputs_are(9);
}

#[test]
fn clients_of_a_bus_stay_connected_with_their_channels_open() {
    let cell = Cell::with("slcan-tcp:127.0.0.1:0,FOLDER/line", &can(500));
    let (mut first, mut second) = (cell.panel(), terminal(&cell));
    first.write_all(b"O\r").unwrap();
    second.write_all(b"O\r").unwrap();
    let configs = [can(450), can(400), can(400).replace("name = \"device\"", "name = \"other\"")];
    replace(&cell, configs, |value| {
        let shows = |client: &mut dyn Write, value: u8| {
            until("outputs", || {
                client.write_all(format!("t0011{value:02X}\r").as_bytes()).unwrap();
                let shown = cell.robot.newest()["registers"]["DigitalOutputCommand[1]"].as_u64();
                (shown == Some(value.into())).then_some(())
            });
        };
        shows(&mut first, value);
        shows(&mut second, value | 0x80);
    });
    // A bus of another bit rate is another bus.
    let slower = can(300).replace("bus = \"can\"", "bus = \"can\"\nbitrate = 125000");
    put(cell.console, &cell.base(), &slower).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    until("the client is disconnected", || first.write_all(b"V\r").is_err().then_some(()));
}
