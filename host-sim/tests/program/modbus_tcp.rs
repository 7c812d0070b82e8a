//! Devices of Modbus TCP over real sockets: `configs/modbus-tcp.toml` against a device of this test, and a gateway
//! between two simulated controllers, of which one is the device.

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::thread;

use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::sysvar::{ModbusPlace, SysVar};
use recipe_test_kit::{HostSim, example, until};
use serde_json::Value;

use super::BINARY;

/// The conveyor and its rack, both behind one address.
#[derive(Debug, Default)]
struct Conveyor {
    speed: i16,
    /// Writes to 0x0200 as they came.
    orders: Vec<Vec<u16>>,
    lamps: Vec<bool>,
    /// It hangs up when it is started, before it has said so.
    hangs_up: bool,
    must_hang_up: bool,
    connections: u32,
}

struct Bank<'a>(&'a Mutex<Conveyor>);

impl RegisterBank for Bank<'_> {
    fn read_coils(&self, _: u16, _: u16, _: &mut [u8]) -> Result<(), Exception> {
        Err(Exception::IllegalFunction)
    }

    fn read_discrete(&self, _: u16, _: u16, packed: &mut [u8]) -> Result<(), Exception> {
        // Without room, whether there are any.
        packed.iter_mut().take(1).for_each(|byte| *byte = 0b10);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        if address != 0x0100 || words.len() != 2 {
            return Err(Exception::IllegalDataAddress);
        }
        words[0] = 1_u16.to_be_bytes();
        words[1] = self.0.lock().unwrap().speed.to_be_bytes();
        Ok(())
    }

    fn write_coils(&mut self, _: u16, coils: Coils<'_>) -> Result<(), Exception> {
        self.0.lock().unwrap().lamps = coils.iter().collect();
        Ok(())
    }

    fn write_holding(&mut self, _: u16, words: Registers<'_>) -> Result<(), Exception> {
        let mut conveyor = self.0.lock().unwrap();
        conveyor.orders.push(words.iter().collect());
        conveyor.must_hang_up = conveyor.hangs_up && words.iter().count() == 2;
        Ok(())
    }
}

/// Serves one connection after the other.
fn serve(listener: &TcpListener, conveyor: &Mutex<Conveyor>) {
    while let Ok((mut stream, _)) = listener.accept() {
        conveyor.lock().unwrap().connections += 1;
        let (mut server, mut chunk, mut out) = (Server::new(), [0; 512], [0; MAX_ADU]);
        'connection: while let Ok(len @ 1..) = stream.read(&mut chunk) {
            let mut rest = &chunk[..len];
            while let Some(answer) = server.receive(&mut rest, &mut Bank(conveyor), &mut out) {
                let len = answer.expect("the gateway's frames are right");
                if std::mem::take(&mut conveyor.lock().unwrap().must_hang_up)
                    || stream.write_all(&out[..len]).is_err()
                {
                    break 'connection;
                }
            }
        }
    }
}

impl Conveyor {
    fn start() -> (SocketAddr, Arc<Mutex<Self>>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (address, conveyor) = (listener.local_addr().unwrap(), Arc::new(Mutex::new(Self::default())));
        let served = Arc::clone(&conveyor);
        thread::spawn(move || serve(&listener, &served));
        (address, conveyor)
    }
}

const ROBOT: &str = r#"
[listen]
address = "127.0.0.1"

[robot]
power = "enabled"
mode = "remote"

[initial]
"WordOutputReg[1]" = 1200
"WordOutputReg[2]" = 1

[[program]]
name = "start.jspf"
script = 'set("BitOutputReg[3]", 1); wait_ms(300); set("BitOutputReg[3]", 0); wait_ms(300);'

[[program]]
name = "stop.jspf"
script = 'set("BitOutputReg[3]", 2); wait_ms(300); set("BitOutputReg[3]", 0); wait_ms(300);'
"#;

fn written(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, text).unwrap();
    path
}

fn shows(robot: &HostSim, register: &str, value: f64) {
    robot.stats(&format!("{register} = {value}"), |stats| {
        stats["registers"][register].as_f64() == Some(value)
    });
}

/// Runs a program of the robot to its end.
fn runs(robot: &HostSim, program: &str) {
    let started = robot.fresh()["programs_started"].as_u64().unwrap();
    robot.command(&format!("run({program})"), "run start");
    robot.stats("the program ends", |stats| {
        stats["programs_started"] == started + 1 && stats["program"].is_null()
    });
}

#[test]
fn a_device_over_tcp_is_read_written_started_once_and_stopped() {
    const DONE: f64 = 2.0;
    const UNKNOWN: f64 = 5.0;
    let folder = tempfile::tempdir().unwrap();
    let robot = BINARY.controller(&written(folder.path(), "robot.toml", ROBOT), &[]);
    let (address, conveyor) = Conveyor::start();
    conveyor.lock().unwrap().speed = -250;
    let to = format!("--set=port.conveyor.to={address}");
    let gateway = BINARY.gateway(&example("modbus-tcp.toml"), &robot, &[&to]);
    assert_eq!(gateway.ready["ports"]["conveyor"], address.to_string());

    // The device's values are in the robot's registers, and the robot's in the device.
    shows(&robot, "WordInputReg[1]", 1.0);
    shows(&robot, "WordInputReg[2]", 65_286.0);
    until("the lamps", || (conveyor.lock().unwrap().lamps == [true, false]).then_some(()));

    // An event once, and a stop.
    let orders = || conveyor.lock().unwrap().orders.clone();
    runs(&robot, "start.jspf");
    shows(&robot, "WordInputReg[3]", DONE);
    assert_eq!(orders(), [[1, 1200]]);
    runs(&robot, "stop.jspf");
    assert_eq!(orders(), [vec![1, 1200], vec![0]]);

    // The connection is lost while an event is on its way: nobody knows, and it is never sent again.
    conveyor.lock().unwrap().hangs_up = true;
    runs(&robot, "start.jspf");
    shows(&robot, "WordInputReg[3]", UNKNOWN);
    {
        let mut conveyor = conveyor.lock().unwrap();
        conveyor.hangs_up = false;
        conveyor.speed = 700;
    }
    shows(&robot, "WordInputReg[2]", 700.0);
    assert_eq!(conveyor.lock().unwrap().connections, 2);
    let stats = gateway.fresh();
    let (port, link) = (&stats["ports"]["conveyor"], &stats["links"]["conveyor"]);
    assert_eq!(
        (&port["bus"], &link["kind"], &link["reconnects"]),
        (&Value::from("modbus-tcp"), &Value::from("modbus-tcp"), &Value::from(1))
    );
    assert_eq!(orders().len(), 3);
    runs(&robot, "start.jspf");
    shows(&robot, "WordInputReg[3]", DONE);
    assert_eq!(orders().len(), 4);
    assert_eq!(gateway.log("no connection to the device").len(), 1);
    gateway.end();
    robot.end();
}

fn register(name: &str) -> u16 {
    match SysVar::parse(name).unwrap().modbus() {
        Some(ModbusPlace::Register { address }) => address,
        other => panic!("{name}: {other:?}"),
    }
}

/// The second controller's Modbus server is the device: what the robot's program has written goes there, and what the
/// device shows comes back.
#[test]
fn a_gateway_stands_between_two_robots() {
    let folder = tempfile::tempdir().unwrap();
    let robot = BINARY.controller(&written(folder.path(), "robot.toml", ROBOT), &[]);
    let device = ROBOT.replace("\"WordOutputReg[1]\" = 1200", "\"WordOutputReg[1]\" = 77");
    let device = written(folder.path(), "device.toml", &device);
    let other = BINARY.controller(&device, &[]);
    let file = format!(
        r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "other"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 1
function = "read-holding-registers"
address = {}
every_ms = 20
read = [{{ name = "theirs", type = "word", to = "WordInputReg[5]" }}]

[[recipe.exchange]]
slave = 1
function = "write-registers"
address = {}
on = ["change"]
write = [{{ name = "ours", type = "word", from = "WordOutputReg[1]" }}]

[[port]]
name = "other"
bus = "modbus-tcp"
to = "localhost:1"
recipe = "other"
on_timeout = {{ "WordInputReg[5]" = 9 }}
"#,
        register("WordOutputReg[1]"),
        register("WordInputReg[6]"),
    );
    let file = written(folder.path(), "gateway.toml", &file);
    let to = format!("--set=port.other.to={}", other.at("modbus"));
    let gateway = BINARY.gateway(&file, &robot, &[&to]);
    shows(&robot, "WordInputReg[5]", 77.0);
    shows(&other, "WordInputReg[6]", 1200.0);

    // The device goes away and comes back at the same place: safe values, then its own, and ours are written again.
    let port = format!("--set=listen.modbus={}", other.at("modbus").port());
    other.end();
    shows(&robot, "WordInputReg[5]", 9.0);
    let other = BINARY.controller(&device, &[&port]);
    shows(&robot, "WordInputReg[5]", 77.0);
    shows(&other, "WordInputReg[6]", 1200.0);
    gateway.end();
    other.end();
    robot.end();
}
