//! Faults between gateway and controller, and silent devices.

use std::time::{Duration, Instant};

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::{Cable, Gateway, Link};
use super::examples::{DO1, DO1_OFF, DO1_ON, ROBOT, pose_and_output, pose_frame};
use super::field::LineClient;
use super::network::Network;
use super::robot::reserved_ports;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("an_address_of_its_own", own_address),
        Scenario::new("the_controller_restarts", restart),
        Scenario::new("the_cable_is_pulled_and_plugged_in", cable),
        Scenario::new("modbus_alone_stalls_and_comes_back", modbus_stalls),
        Scenario::new("a_silent_device_leaves_safe_values", safe_value),
        Scenario::new("an_idle_gateway_takes_no_time", idle).alone(),
    ]
}

/// A board has the file's address; a host keeps its own and still works.
fn own_address(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let plan = case.gateway("rs485-system.toml").robot(&robot);
    let network = "{ address = '10.0.2.77/24', router = '10.0.2.2' }";
    let mut gateway = plan.set("network", network).start();
    gateway.until_up(Link::Modbus, 1);
    gateway.until_up(Link::State, 1);
    if let Some(address) = gateway.own_address() {
        assert_eq!(address, "10.0.2.77/24");
    }
    pose_and_output(&robot, &mut gateway.line("rs485-1"), &pose_frame(4));
}

fn restart(case: &Case) {
    let ports = reserved_ports();
    let robot = case.robot(ROBOT).on(ports).start();
    let mut gateway = case.cell("rs485-system.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    gateway.until_up(Link::State, 1);
    let mut device = gateway.line("rs485-1");
    pose_and_output(&robot, &mut device, &pose_frame(4));
    robot.end();
    gateway.until_down(Link::Modbus);
    let frames = gateway.port("rs485-1").frames_in.max(6);
    until("a frame came while the controller is away", || {
        device.send(&DO1_ON);
        (gateway.port("rs485-1").frames_in > frames).then_some(())
    });
    until_nothing_waits(&mut *gateway, &mut device);
    let robot = case.robot(ROBOT).on(ports).start();
    gateway.until_up(Link::Modbus, 2);
    gateway.until_up(Link::State, 2);
    // Since then, a pose of the new controller has come on the state link.
    device.forget();
    device.until(&pose_frame(4));
    assert_eq!(robot.variable(DO1), 0.0, "what was sent while the controller was away was written after all");
    pose_and_output(&robot, &mut device, &pose_frame(4));
}

/// Waits until no frame that the device has sent so far is still on the line: a byte that belongs to no frame
/// has followed them. A gateway that was stopped for half a second discards what waits, so their number may not
/// be reached.
fn until_nothing_waits(gateway: &mut dyn Gateway, device: &mut LineClient) {
    let before = gateway.port("rs485-1").skipped_bytes;
    until("a byte between frames is counted", || {
        device.send(&[0]);
        (gateway.port("rs485-1").skipped_bytes > before).then_some(())
    });
}

fn cable(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.gateway("rs485-system.toml").robot(&robot).with_cable().start();
    gateway.until_up(Link::Modbus, 1);
    gateway.until_up(Link::State, 1);
    let mut device = gateway.line("rs485-1");
    pose_and_output(&robot, &mut device, &pose_frame(4));
    gateway.cable(Cable::Pulled);
    until("both links are given up", || {
        device.send(&DO1_ON);
        let is_up = [Link::Modbus, Link::State].map(|link| gateway.link(link).is_up);
        (is_up == [false; 2]).then_some(())
    });
    until_nothing_waits(&mut *gateway, &mut device);
    gateway.cable(Cable::Plugged);
    gateway.until_up(Link::Modbus, 2);
    gateway.until_up(Link::State, 2);
    // What the previous connection still held would be written by now.
    device.forget();
    device.until(&pose_frame(4));
    assert_eq!(robot.variable(DO1), 0.0, "what was sent while the cable was pulled was written after all");
    pose_and_output(&robot, &mut device, &pose_frame(4));
}

/// The server accepts connections and sends nothing; the rest of the controller works.
fn modbus_stalls(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut way = Network::default();
    let modbus = way.tcp(robot.address("modbus"));
    let plan = case.gateway("rs485-system.toml").robot(&robot).server_at("modbus", modbus);
    let mut gateway = plan.set("port.rs485-1.on_timeout", SAFE).start();
    gateway.until_up(Link::Modbus, 1);
    gateway.until_up(Link::State, 1);
    let mut device = gateway.line("rs485-1");
    device.send(&DO1_ON);
    robot.until(DO1, 128.0);
    way.set(Cable::Pulled);
    until("Modbus is given up", || {
        device.send(&DO1_ON);
        (!gateway.link(Link::Modbus).is_up).then_some(())
    });
    // The other links still work.
    gateway.until_up(Link::State, 1);
    device.forget();
    device.until(&pose_frame(4));
    assert!(!gateway.link(Link::Modbus).is_up, "nobody answers there");
    way.set(Cable::Plugged);
    gateway.until_up(Link::Modbus, 2);
    // The device has been silent: its safe value is written when the link is back.
    robot.until(DO1, 128.0);
    robot.until_after(DO1, 1.0, || device.send(&DO1_ON));
}

/// DO1 to DO8 after the device falls silent.
const SAFE: &str = "{ 'DigitalOutputCommand[1]' = 0x80 }";

fn safe_value(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let plan = case.gateway("rs485-system.toml").robot(&robot);
    let mut gateway = plan.set("port.rs485-1.on_timeout", SAFE).start();
    gateway.until_up(Link::Modbus, 1);
    let mut device = gateway.line("rs485-1");
    for value in [1, 2] {
        device.send(&[0xFF, 0xFF, value, 0xEE, 0xEE]);
        // The safe value follows 100 ms later, maybe before the statistics show this value.
        robot.until(DO1, 128.0);
    }
    // While frames come in time, their value stays.
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_millis(500) {
        device.send(&DO1_ON);
        std::thread::sleep(Duration::from_millis(10));
    }
    device.send(&DO1_OFF);
    robot.until(DO1, 128.0);
}

fn idle(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("rs485-user.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let before = gateway.processor_time();
    gateway.line("rs485-1").is_silent(Duration::from_secs(2));
    let spent = gateway.processor_time() - before;
    assert!(spent < Duration::from_millis(500), "{spent:?} of processor time in 2 s");
}
