//! The specification's six worked examples (proto-core/docs/wire/recipes.md section 8), each against the
//! simulated controller's own ports and, where a gateway can take part, through the gateway.

use std::io;
use std::net::TcpListener;

use serde_json::json;

use super::cell::{Example, Gateway, Robot, serial};
use super::device::{Adapter, Datagrams, FieldStream};
use super::folder::TempFolder;
use super::show::Show;

const HEAD: [u8; 2] = [0xFF, 0xFF];
const OUT_TAIL: [u8; 2] = [0xFE, 0xFE];
/// Example 1: three bytes to the robot, and the program's answer.
const THREE_BYTES: [u8; 7] = [0xFF, 0xFF, 1, 2, 3, 0xEE, 0xEE];
const ANSWER: [u8; 7] = [0xFF, 0xFF, 0x7D, 0x7D, 0x7D, 0xFE, 0xFE];
/// Examples 2, 5 and 6: DO1 on, and all off.
const DO1_ON: [u8; 5] = [0xFF, 0xFF, 1, 0xEE, 0xEE];
const DO1_OFF: [u8; 5] = [0xFF, 0xFF, 0, 0xEE, 0xEE];
/// Example 4's captured frame.
const CAN_POSE: [u8; 8] = [0xEF, 0x54, 0xEF, 0x3E, 0xA7, 0xE7, 0xD1, 0x3E];
/// Example 5's captured frame.
const POSE: [u8; 28] = [
    0xFF, 0xFF, 0x39, 0x2F, 0x0B, 0xBF, 0x86, 0x87, 0x13, 0x3F, 0xBF, 0xBD, 0x9D, 0x3F, 0x37, 0xFC, 0xC8,
    0xBF, 0x17, 0xA0, 0x1B, 0xBF, 0x59, 0xFC, 0xEA, 0xBE, 0xFE, 0xFE,
];
/// The coil that shows DO1.
const DO1: u16 = 192;
/// The holding register that shows WordInputReg[1].
const WORD_INPUT: u16 = 8;

macro_rules! example {
    ($name:literal) => {
        Example {
            name: concat!($name, ".toml"),
            toml: include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/configs/", $name, ".toml")),
        }
    };
}

pub(super) fn run_all(show: &mut Show, folder: &TempFolder) {
    show.heading("1  RS-485, user-defined: a program receives three bytes and answers");
    show.judge("on the controller's own port", |show| rs485_user(show, folder));
    show.judge("through the gateway: the bytes go to word registers", |show| {
        rs485_user_gateway(show, folder)
    });

    show.heading("2  RS-485, system data: the pose comes out every 4 ms, one byte switches DO1..8");
    show.judge("on the controller's own port", |show| rs485_system(show, folder));
    show.judge("through the gateway: DO1 by Modbus, the pose from port 2001", |show| {
        rs485_system_gateway(show, folder)
    });

    show.heading("3  CAN, user-defined: the same with frame ids");
    show.judge("on the controller's own port", can_user);
    show.judge("through the gateway: the bytes go to word registers", can_user_gateway);

    show.heading("4  CAN, system data: the pose in ids 2, 3 and 4, id 1 switches DO1..8");
    show.judge("on the controller's own port", can_system);
    show.judge("through the gateway: DO1 by Modbus, the pose from port 2001", can_system_gateway);

    show.heading("5  UDP 2011: every client that sends a datagram gets the pose every 4 ms");
    show.judge("on the controller's own port", udp_server);
    show.judge("through the gateway: an RS-485 device on the far side of UDP 2011", |show| {
        udp_server_gateway(show, folder)
    });

    show.heading("6  TCP and UDP clients: the controller connects out, and connects again");
    show.judge("on the controller's own ports", clients);
    show.judge("through the gateway: the controller's TCP client connects to it", |show| {
        client_gateway(show, folder)
    });
}

/// The device sends three bytes and gets the answer.
fn three_bytes<S: io::Read + io::Write + std::os::fd::AsFd>(
    show: &Show,
    device: &mut FieldStream<S>,
) -> io::Result<()> {
    show.sends("device", &THREE_BYTES, "head, 1, 2, 3, tail");
    device.send(&THREE_BYTES)?;
    let answer = device.frame(&HEAD, &OUT_TAIL, ANSWER.len())?;
    show.sees("device", &answer, "head, 125, 125, 125, tail");
    same(&answer, &ANSWER)
}

fn rs485_user(show: &Show, folder: &TempFolder) -> io::Result<()> {
    let path = folder.path("rs485");
    let robot = folder.fill(|| {
        Robot::start(example!("rs485-user-controller"), &[], &[bind("rs485", "pty", path.display())])
    })?;
    robot.command("run(echo.jspf)", "run start")?;
    show.notes("2000", "run(echo.jspf)", "run start");
    three_bytes(show, &mut serial(&path)?)?;
    robot.variable("list1", &json!([1, 2, 3]))?;
    show.notes("program", "list1 = {1,2,3}", "what comm_recv returned");
    Ok(())
}

fn rs485_user_gateway(show: &Show, folder: &TempFolder) -> io::Result<()> {
    let path = folder.path("gateway-rs485");
    let robot = Robot::start(example!("udp-server-controller"), &[], &[])?;
    let binds = [bind("rs485-1", "pty", path.display())];
    let gateway = folder.fill(|| Gateway::start(example!("rs485-user"), Some(&robot), &[], &binds))?;
    gateway.linked()?;
    three_bytes(show, &mut serial(&path)?)?;
    robot.registers(WORD_INPUT, &[1, 2, 3])?;
    show.notes("Modbus", "WordInputReg[1..3] = 1 2 3", "holding registers 8 to 10 of the controller");
    Ok(())
}

/// The device sees this pose each cycle and switches DO1.
fn pose_and_do1<S: io::Read + io::Write + std::os::fd::AsFd>(
    show: &Show,
    device: &mut FieldStream<S>,
    pose: &[u8],
    robot: &Robot,
) -> io::Result<()> {
    let frame = device.wait_for(|received| {
        let at = received.windows(pose.len()).position(|frame| frame == pose)?;
        Some((received[at..at + pose.len()].to_vec(), at + pose.len()))
    })?;
    show.sees("device", &frame, "head, RobotState[8..], tail");
    show.sends("device", &DO1_ON, "head, DigitalOutputCommand[1] = 1, tail");
    device.send(&DO1_ON)?;
    do1(show, robot, true)?;
    show.sends("device", &DO1_OFF, "and off again");
    device.send(&DO1_OFF)?;
    do1(show, robot, false)
}

fn rs485_system(show: &Show, folder: &TempFolder) -> io::Result<()> {
    let path = folder.path("rs485");
    let binds = [bind("rs485", "pty", path.display())];
    let robot = folder.fill(|| Robot::start(example!("rs485-system-controller"), &[], &binds))?;
    pose_and_do1(show, &mut serial(&path)?, &pose_of(4), &robot)
}

fn rs485_system_gateway(show: &Show, folder: &TempFolder) -> io::Result<()> {
    let path = folder.path("gateway-rs485");
    let robot = Robot::start(example!("udp-server-controller"), &[], &[])?;
    let binds = [bind("rs485-1", "pty", path.display())];
    let gateway = folder.fill(|| Gateway::start(example!("rs485-system"), Some(&robot), &[], &binds))?;
    gateway.linked()?;
    pose_and_do1(show, &mut serial(&path)?, &pose_of(4), &robot)
}

fn can_three_bytes(show: &Show, adapter: &mut Adapter) -> io::Result<()> {
    show.sends("bus", &[1, 2, 3], "id 1");
    adapter.send(1, &[1, 2, 3])?;
    let answer = adapter.frame(2)?;
    show.sees("bus", &answer, "id 2");
    same(&answer, &[0x7D; 3])
}

fn can_user(show: &Show) -> io::Result<()> {
    let robot = Robot::start(example!("can-user-controller"), &[], &[bind("can", "slcan-tcp", LOOPBACK)])?;
    robot.command("run(echo.jspf)", "run start")?;
    show.notes("2000", "run(echo.jspf)", "run start");
    can_three_bytes(show, &mut Adapter::connect(robot.address("ports/can")?)?)?;
    robot.variable("list1", &json!([1, 1, 2, 3]))?;
    show.notes("program", "list1 = {1,1,2,3}", "the id, then the values");
    Ok(())
}

fn can_user_gateway(show: &Show) -> io::Result<()> {
    let robot = Robot::start(example!("udp-server-controller"), &[], &[])?;
    let binds = [bind("can-1", "slcan-tcp", LOOPBACK)];
    let gateway = Gateway::start(example!("can-user"), Some(&robot), &[], &binds)?;
    gateway.linked()?;
    can_three_bytes(show, &mut Adapter::connect(gateway.address("ports/can-1")?)?)?;
    robot.registers(WORD_INPUT, &[1, 2, 3])?;
    show.notes("Modbus", "WordInputReg[1..3] = 1 2 3", "holding registers 8 to 10 of the controller");
    Ok(())
}

fn can_pose_and_do1(show: &Show, adapter: &mut Adapter, robot: &Robot) -> io::Result<()> {
    let pose = loop {
        // A gateway's first cycles may come before the first state packet.
        let frame = adapter.frame(2)?;
        if frame.iter().any(|&byte| byte != 0) {
            break frame;
        }
    };
    show.sees("bus", &pose, "id 2: RobotState[8], RobotState[9]");
    same(&pose, &CAN_POSE)?;
    for id in [3, 4] {
        show.sees("bus", &adapter.frame(id)?, &format!("id {id}"));
    }
    show.sends("bus", &[1], "id 1: DigitalOutputCommand[1] = 1");
    adapter.send(1, &[1])?;
    do1(show, robot, true)
}

fn can_system(show: &Show) -> io::Result<()> {
    let robot = Robot::start(example!("can-system-controller"), &[], &[bind("can", "slcan-tcp", LOOPBACK)])?;
    can_pose_and_do1(show, &mut Adapter::connect(robot.address("ports/can")?)?, &robot)
}

fn can_system_gateway(show: &Show) -> io::Result<()> {
    // The controller's own CAN port exists too, without a device.
    let robot = Robot::start(example!("can-system-controller"), &[], &[bind("can", "slcan-tcp", LOOPBACK)])?;
    let binds = [bind("can-1", "slcan-tcp", LOOPBACK)];
    let gateway = Gateway::start(example!("can-system"), Some(&robot), &[], &binds)?;
    gateway.linked()?;
    can_pose_and_do1(show, &mut Adapter::connect(gateway.address("ports/can-1")?)?, &robot)
}

fn udp_server(show: &Show) -> io::Result<()> {
    let robot = Robot::start(example!("udp-server-controller"), &[], &[])?;
    let socket = Datagrams::connect(robot.address("udp2011")?)?;
    show.sends("client", &[0], "any datagram asks for the stream");
    socket.send(&[0])?;
    let frame = socket.receive()?;
    show.sees("client", &frame, "-0.543689 0.576287 1.232353 -1.570197 -0.607912 -0.458957");
    same(&frame, &POSE)?;
    show.sends("client", &DO1_ON, "DigitalOutputCommand[1] = 1");
    socket.send(&DO1_ON)?;
    do1(show, &robot, true)
}

fn udp_server_gateway(show: &Show, folder: &TempFolder) -> io::Result<()> {
    let path = folder.path("gateway-rs485");
    let robot = Robot::start(example!("udp-server-controller"), &[], &[])?;
    let overrides = [format!("controller.recipe_link.udp={}", robot.address("udp2011")?.port())];
    let binds = [bind("rs485-1", "pty", path.display())];
    let gateway = folder.fill(|| Gateway::start(example!("udp-server"), Some(&robot), &overrides, &binds))?;
    gateway.linked()?;
    pose_and_do1(show, &mut serial(&path)?, &POSE, &robot)
}

fn clients(show: &Show) -> io::Result<()> {
    let listener = TcpListener::bind(LOOPBACK)?;
    let (datagrams, udp) = Datagrams::bind()?;
    let overrides = [format!("port.tcp1.to={}", listener.local_addr()?), format!("port.udp1.to={udp}")];
    let robot = Robot::start(example!("client-controller"), &overrides, &[])?;
    {
        let mut connection = FieldStream::accept(&listener)?;
        show.notes("TCP", "the controller connected", "");
        pose_and_do1(show, &mut connection, &POSE, &robot)?;
    }
    show.notes("TCP", "connection closed", "the controller has to come back");
    pose_and_do1(show, &mut FieldStream::accept(&listener)?, &POSE, &robot)?;
    let frame = datagrams.receive()?;
    show.sees("UDP", &frame, "the same frame, a datagram each");
    same(&frame, &POSE)?;
    datagrams.send(&DO1_ON)?;
    show.sends("UDP", &DO1_ON, "head, DigitalOutputCommand[1] = 1, tail");
    do1(show, &robot, true)
}

fn client_gateway(show: &Show, folder: &TempFolder) -> io::Result<()> {
    let path = folder.path("gateway-rs485");
    let binds = [bind("rs485-1", "pty", path.display())];
    let overrides = [format!("port.up.listen={LOOPBACK}")];
    let gateway = folder.fill(|| Gateway::start(example!("client"), None, &overrides, &binds))?;
    let (_unused, udp) = Datagrams::bind()?;
    let overrides = [format!("port.tcp1.to={}", gateway.address("ports/up")?), format!("port.udp1.to={udp}")];
    let robot = Robot::start(example!("client-controller"), &overrides, &[])?;
    gateway.linked()?;
    pose_and_do1(show, &mut serial(&path)?, &POSE, &robot)
}

/// A free port of this host.
const LOOPBACK: &str = "127.0.0.1:0";

fn bind(port: &str, kind: &str, place: impl std::fmt::Display) -> String {
    format!("{port}={kind}:{place}")
}

/// The captured pose cut to its first `floats` values.
fn pose_of(floats: usize) -> Vec<u8> {
    [&POSE[..2 + 4 * floats], &OUT_TAIL].concat()
}

fn do1(show: &Show, robot: &Robot, on: bool) -> io::Result<()> {
    robot.coil(DO1, on)?;
    show.notes("Modbus", &format!("coil {DO1} = {}", u8::from(on)), "DO1, seen by another Modbus client");
    Ok(())
}

fn same(got: &[u8], expected: &[u8]) -> io::Result<()> {
    if got == expected {
        return Ok(());
    }
    let (got, expected) = (super::show::hex(got), super::show::hex(expected));
    Err(io::Error::other(format!("expected {expected}, got {got}")))
}
