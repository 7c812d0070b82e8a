//! The specification's worked examples through a gateway, and the cells of the example files.

use std::time::{Duration, Instant};

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::{Gateway, Link};
use super::field::{CanClient, LineClient};
use super::robot::{Robot, RobotPlan};

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("example_1_three_bytes_on_rs485", example_1),
        Scenario::new("example_2_pose_and_output_on_rs485", example_2),
        Scenario::new("example_3_three_bytes_on_can", example_3),
        Scenario::new("example_4_pose_and_output_on_can", example_4),
        Scenario::new("example_5_recipes_by_udp_2011", example_5),
        Scenario::new("example_6_recipes_by_the_controllers_tcp_client", example_6_tcp),
        Scenario::new("example_6_recipes_by_the_controllers_udp_client", example_6_udp),
        Scenario::new("a_force_sensor_at_960_frames_a_second", force_sensor).alone(),
        Scenario::new("a_hand_on_can", hand),
        Scenario::new("a_station_that_starts_programs", station),
    ]
}

pub(crate) const HEAD: [u8; 2] = [0xFF, 0xFF];
const OUT_TAIL: [u8; 2] = [0xFE, 0xFE];
/// Frames that switch DO1.
pub(crate) const DO1_ON: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];
pub(crate) const DO1_OFF: [u8; 5] = [0xFF, 0xFF, 0x00, 0xEE, 0xEE];
/// The variable that holds DO1.
pub(crate) const DO1: &str = "DigitalOutputCommand[1]";
/// The six floats of the captured frame of example 5.
const POSE: [u8; 24] = [
    0x39, 0x2F, 0x0B, 0xBF, 0x86, 0x87, 0x13, 0x3F, 0xBF, 0xBD, 0x9D, 0x3F, 0x37, 0xFC, 0xC8, 0xBF, 0x17,
    0xA0, 0x1B, 0xBF, 0x59, 0xFC, 0xEA, 0xBE,
];
/// The floats of example 4's captured frame with id 2.
const CAN_POSE: [u8; 8] = [0xEF, 0x54, 0xEF, 0x3E, 0xA7, 0xE7, 0xD1, 0x3E];

/// A controller that shows the captured pose and has no field ports of its own.
pub(crate) const ROBOT: &str = "udp-server-controller.toml";

/// A frame with the first floats of the pose.
pub(crate) fn pose_frame(floats: usize) -> Vec<u8> {
    [&HEAD[..], &POSE[..4 * floats], &OUT_TAIL].concat()
}

/// Checks that the device receives this pose each cycle and can switch DO1.
#[track_caller]
pub(crate) fn pose_and_output(robot: &Robot, device: &mut LineClient, pose: &[u8]) {
    device.until(pose);
    for nth in 0..20 {
        assert_eq!(device.take(pose.len()), pose, "frame {nth} behind the first");
    }
    for _ in 0..3 {
        device.send(&DO1_ON);
        robot.until(DO1, 1.0);
        device.send(&DO1_OFF);
        robot.until(DO1, 0.0);
    }
}

#[track_caller]
fn word_inputs(robot: &Robot, values: [f64; 3]) {
    for (index, value) in (1..).zip(values) {
        robot.until(&format!("WordInputReg[{index}]"), value);
    }
}

fn example_1(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("rs485-user.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut device = gateway.line("rs485-1");
    for values in [[1, 2, 3], [4, 5, 6]] {
        device.send(&[&HEAD[..], &values, &[0xEE, 0xEE]].concat());
        assert_eq!(device.take(7), [0xFF, 0xFF, 0x7D, 0x7D, 0x7D, 0xFE, 0xFE], "the answer");
        word_inputs(&robot, values.map(f64::from));
    }
}

fn example_2(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("rs485-system.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    gateway.until_up(Link::State, 1);
    pose_and_output(&robot, &mut gateway.line("rs485-1"), &pose_frame(4));
}

fn example_3(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("can-user.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut bus = gateway.can("can-1");
    for values in [[1, 2, 3], [4, 5, 6]] {
        bus.send(1, &values);
        assert_eq!(bus.frame(2), [0x7D, 0x7D, 0x7D], "the answer");
        word_inputs(&robot, values.map(f64::from));
    }
}

fn example_4(case: &Case) {
    let robot = case.robot("can-system-controller.toml").bind("can", "slcan-tcp:127.0.0.1:0").start();
    let mut gateway = case.cell("can-system.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut bus = gateway.can("can-1");
    until("a cycle with the pose", || (bus.frame(2) == CAN_POSE).then_some(()));
    for _ in 0..10 {
        let ids = [bus.next(), bus.next(), bus.next()].map(|(id, data)| (id, data.len()));
        assert_eq!(ids, [(3, 8), (4, 8), (2, 8)], "ids and lengths of the frames of a cycle");
    }
    for value in [1, 0, 1] {
        bus.send(1, &[value]);
        robot.until(DO1, f64::from(value));
    }
}

fn example_5(case: &Case) {
    let robot = case.robot(ROBOT).start();
    let mut gateway = case.cell("udp-server.toml", &robot);
    gateway.until_up(Link::Udp2011, 1);
    pose_and_output(&robot, &mut gateway.line("rs485-1"), &pose_frame(6));
}

/// A gateway that is started before the controller, whose client connects to it.
#[track_caller]
pub(crate) fn listening<'a>(case: &'a Case, bus: &str) -> (Box<dyn Gateway>, RobotPlan<'a>) {
    let gateway = case.gateway("client.toml").set("port.up.bus", bus).start();
    let (used, other) = if bus == "tcp-listen" { ("tcp1", "udp1") } else { ("udp1", "tcp1") };
    // The other client has no server and keeps trying.
    let robot = case
        .robot("client-controller.toml")
        .set(&format!("port.{used}.to"), gateway.listens("up"))
        .set(&format!("port.{other}.to"), "127.0.0.1:9");
    (gateway, robot)
}

fn example_6_tcp(case: &Case) {
    let (mut gateway, robot) = listening(case, "tcp-listen");
    let robot = robot.start();
    gateway.until_up(Link::TcpListen("up"), 1);
    pose_and_output(&robot, &mut gateway.line("rs485-1"), &pose_frame(6));
}

fn example_6_udp(case: &Case) {
    let (mut gateway, robot) = listening(case, "udp-listen");
    let robot = robot.start();
    gateway.until_up(Link::UdpListen("up"), 1);
    pose_and_output(&robot, &mut gateway.line("rs485-1"), &pose_frame(6));
}

fn force_sensor(case: &Case) {
    const RATE: u32 = 960;
    const FRAMES: u32 = 3 * RATE;
    let robot = case.robot("force-sensor-controller.toml").start();
    // A busy machine may pause longer between two frames than the 20 ms of the file.
    let plan = case.gateway("force-sensor.toml").robot(&robot).set("port.force.timeout_ms", 2_000);
    let mut gateway = plan.start();
    gateway.until_up(Link::Udp2011, 1);
    let mut sensor = gateway.line("force");
    let begin = Instant::now();
    let frame = |number: u32| -> Vec<u8> {
        let forces = (0_u8..6).flat_map(|axis| (number as f32 / 8.0 + f32::from(axis)).to_le_bytes());
        [0x48, 0xAA].into_iter().chain(forces).chain([0x0D, 0x0A]).collect()
    };
    for number in 0..FRAMES {
        sensor.send(&frame(number));
        let due = begin + number * Duration::from_secs(1) / RATE;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
    let status = gateway.until_bytes_in("force", u64::from(FRAMES) * 28);
    assert_eq!((status.frames_in, status.skipped_bytes), (u64::from(FRAMES), 0), "{status:?}");
    // The last datagram may get lost, and its value ends with its time: the sensor goes on until it is seen.
    until("the last forces at the controller", || {
        sensor.send(&frame(FRAMES - 1));
        (robot.newest("ForceEnd[1]") == f64::from(FRAMES - 1) / 8.0).then_some(())
    });
    // A robot that follows a force must not follow one that is no longer measured.
    for axis in 1..=6 {
        robot.until(&format!("ForceEnd[{axis}]"), 0.0);
    }
}

fn hand(case: &Case) {
    let robot = case.robot("can-hand-controller.toml").start();
    let mut gateway = case.cell("can-hand.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    let mut hand = gateway.can("hand");
    until("fingers at rest", || (hand.frame(0x501) == [0; 6]).then_some(()));
    robot.command("run(grip.jspf)", "run start");
    until("closed fingers", || (hand.frame(0x501) == [200; 6]).then_some(()));
    // State 3, no error, 1500 g.
    until_reported(&mut hand, &robot, [3, 0, 0xDC, 0x05], [3.0, 0.0, 1500.0]);
    // Unplugged: the state becomes 0, the other two hold.
    word_inputs(&robot, [0.0, 0.0, 1500.0]);
    until_reported(&mut hand, &robot, [2, 7, 0xFF, 0xFF], [2.0, 7.0, 65_535.0]);
}

/// The hand sends this until the controller has it.
#[track_caller]
fn until_reported(hand: &mut CanClient, robot: &Robot, report: [u8; 4], values: [f64; 3]) {
    until("the report at the controller", || {
        hand.send(0x502, &report);
        let now = [1, 2, 3].map(|index| robot.newest(&format!("WordInputReg[{index}]")));
        (now == values).then_some(())
    });
}

fn station(case: &Case) {
    let robot = case.robot("request-response-controller.toml").start();
    let mut gateway = case.cell("request-response.toml", &robot);
    gateway.until_up(Link::Modbus, 1);
    gateway.until_up(Link::Command, 1);
    let mut station = gateway.line("station");
    let mut count = None;
    // Each order has one answer, with the reply code of the orders before.
    let mut order = |number: u8, part: u16| {
        let part = part.to_le_bytes();
        station.send(&[0xFF, 0xFF, number, part[0], part[1], 0xEE, 0xEE]);
        let answer = station.take(7);
        assert_eq!((&answer[..2], &answer[5..]), (&HEAD[..], &OUT_TAIL[..]), "{answer:02X?}");
        let (number, expected) = (answer[2], count.map_or(answer[2], |before: u8| before.wrapping_add(1)));
        assert_eq!(number, expected, "the answers' count");
        count = Some(number);
        (answer[3], answer[4])
    };
    assert_eq!(order(0, 5).0, 0, "the reply code before any command");
    robot.until("WordInputReg[1]", 5.0);
    order(1, 513);
    robot.until("WordInputReg[1]", 513.0);
    robot.until_stats("the program ran", |stats| stats["program"].as_str() == Some("pick.jspf"));
    until("the reply code: success", || (order(0, 513).0 == 2).then_some(()));
    until("the program is seen to be busy, or has ended", || (order(0, 513).1 == 0).then_some(()));
    robot.until_stats("the program has ended", |stats| stats["program_state"] == 0);
    // No program runs that could be stopped.
    order(9, 513);
    until("the reply code: fail", || (order(0, 513).0 == 3).then_some(()));
}
