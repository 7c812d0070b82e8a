//! The doctor gives the controller nothing, and the field only what it is told to ask.

use std::io::Read;
use std::net::{TcpListener, UdpSocket};
use std::process::Command;
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use recipe_test_kit::{PATIENCE, ended, toml};

use super::{BINARY, Feeder, appears};

/// A server that reports each byte that it is given, and how many clients it has had.
fn server(bytes: Sender<(&'static str, Vec<u8>)>, name: &'static str) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for client in listener.incoming() {
            let mut given = Vec::new();
            let _ = client.unwrap().read_to_end(&mut given);
            let _ = bytes.send((name, given));
        }
    });
    port
}

#[test]
fn the_controller_is_given_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (file, line) = (folder.path().join("panel.toml"), folder.path().join("device"));
    // A panel whose values go to Modbus and to UDP, whose order is a command, and whose silence has safe values.
    let panel = toml::panel("1 = \"run(pick.jspf)\", 2 = \"stop\"", 200);
    let panel = panel.replace(
        "address = \"127.0.0.1\"",
        "address = \"127.0.0.1\"\nrecipe_link = { udp = 2011, recipe = \"up\" }",
    );
    let up = "\n[[recipe]]\nname = \"up\"\nkind = \"stream\"\nmode = \"realtime\"\ninput = { head = [1], tail = [2], \
              fields = [\"DigitalOutputCommand[1]\", \"WordInputReg[1]\"] }\n";
    std::fs::write(&file, panel + up).unwrap();
    let (sender, given) = channel();
    let datagrams = UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut command = BINARY.command();
    command.args(["doctor", "--for", "4s", "-c"]).arg(&file);
    command.arg(format!("--bind=device=pty:{}", line.display()));
    for name in ["command", "modbus", "state"] {
        command.arg(format!("--set=controller.ports.{name}={}", server(sender.clone(), name)));
    }
    command.arg(format!("--set=controller.recipe_link.udp={}", datagrams.local_addr().unwrap().port()));
    let orders = [[255, 255, 0, 3, 238, 238], [255, 255, 1, 4, 238, 238], [255, 255, 2, 5, 238, 238]];
    let feeder = Feeder::start(&line, orders.as_flattened());
    let findings = run(&mut command);
    drop(feeder);
    datagrams.set_nonblocking(true).unwrap();
    assert!(datagrams.recv(&mut [0; 64]).is_err(), "a datagram");
    // It has connected to the command port at least, and said nothing anywhere.
    let clients: Vec<_> =
        std::iter::from_fn(|| given.recv_timeout(Duration::from_millis(500)).ok()).collect();
    assert!(clients.iter().any(|(name, _)| *name == "command"), "{clients:?}\n{findings}");
    assert!(clients.iter().all(|(_, bytes)| bytes.is_empty()), "{clients:?}");
}

/// Runs it; returns what it says.
fn run(command: &mut Command) -> String {
    let mut child = command.spawn().unwrap();
    let code = ended(&mut child, PATIENCE).code();
    let output = child.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(matches!(code, Some(0 | 1)), "{code:?} {text}{}", String::from_utf8_lossy(&output.stderr));
    text
}

#[test]
fn the_field_is_given_nothing_unless_it_is_to_be_asked() {
    let folder = tempfile::tempdir().unwrap();
    let (file, line) = (folder.path().join("line.toml"), folder.path().join("line"));
    std::fs::write(
        &file,
        "controller = { address = \"127.0.0.1\" }\n\
         [[recipe]]\nname = \"r\"\nkind = \"modbus-rtu\"\n\
         [[recipe.exchange]]\nslave = 9\nfunction = \"read-holding-registers\"\naddress = 1\nevery_ms = 50\n\
         read = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }]\n\
         [[port]]\nname = \"line\"\nbus = \"modbus-rtu\"\nrecipe = \"r\"\n",
    )
    .unwrap();
    for (ask, is_asked) in [(&[][..], false), (&["--ask"][..], true)] {
        let mut command = BINARY.command();
        command.args(["doctor", "--for", "3s", "-c"]).arg(&file).args(ask);
        command.arg(format!("--bind=line=pty:{}", line.display()));
        let own = line.clone();
        let device = std::thread::spawn(move || {
            appears(&own);
            let mut device = std::fs::File::open(&own).unwrap();
            let mut bytes = [0; 64];
            // The end of the doctor ends the read.
            device.read(&mut bytes).map(|len| bytes[..len].to_vec()).unwrap_or_default()
        });
        run(&mut command);
        let bytes = device.join().unwrap();
        assert_eq!(!bytes.is_empty(), is_asked, "{bytes:?}");
    }
}
