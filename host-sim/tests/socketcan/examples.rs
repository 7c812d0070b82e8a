//! The specification's worked examples on CAN and the cell files, with foreign clients: can-utils and
//! python-can.

use std::io::Write;
use std::process::{Command, Stdio};

use super::BINARY;
use super::{Needs, Test, python};
use recipe_test_kit::can::{Candump, cansend, tool};
use recipe_test_kit::{HostSim, example, until};

/// Example 4's captured frame.
const POSE: &str = "002#EF54EF3EA7E7D13E";
/// Example 3: three bytes to the robot, and its answer.
const THREE_BYTES: &str = "001#010203";
const ANSWER: &str = "002#7D7D7D";

pub(crate) fn trials(interface: &str) -> Vec<Test> {
    let test = |name, needs, test: fn(&str)| -> Test {
        let interface = interface.to_owned();
        (name, needs, Box::new(move || test(&interface)))
    };
    vec![
        test("worked_example_3_on_the_controller", Needs::Nothing, user_controller),
        test("worked_example_3_through_the_gateway", Needs::Nothing, user_gateway),
        test("worked_example_4_on_the_controller", Needs::Nothing, system_controller),
        test("worked_example_4_through_the_gateway", Needs::Nothing, system_gateway),
        test("a_program_closes_the_hand", Needs::Nothing, hand),
        test("python_can_is_served_like_can_utils", Needs::Python, python_can),
        test("what_the_recipe_does_not_have_is_not_applied", Needs::Nothing, refused_frames),
        test("the_log_of_a_run_replays_byte_for_byte", Needs::Nothing, replay),
    ]
}

fn bind(port: &str, interface: &str) -> String {
    format!("--bind={port}=socketcan:{interface}")
}

fn controller(file: &str, interface: &str) -> HostSim {
    BINARY.controller(&example(file), &[&bind("can", interface)])
}

/// A controller without a CAN port on this bus, and a gateway with one.
fn cell(file: &str, interface: &str) -> (HostSim, HostSim) {
    let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
    let gateway = BINARY.gateway(&example(file), &robot, &[&bind("can-1", interface)]);
    (robot, gateway)
}

#[track_caller]
fn register(robot: &HostSim, name: &str, value: f64) {
    robot.stats(&format!("{name} = {value}"), |stats| {
        stats["registers"][name].as_f64().unwrap_or(0.0) == value
    });
}

fn user_controller(interface: &str) {
    let robot = controller("can-user-controller.toml", interface);
    let dump = Candump::start(interface);
    robot.command("run(echo.jspf)", "run start");
    cansend(interface, THREE_BYTES);
    dump.wait_for(ANSWER);
    assert_eq!(dump.frames(), [THREE_BYTES, ANSWER]);
    robot.stats("list1", |stats| stats["variables"]["list1"] == serde_json::json!([1, 1, 2, 3]));
    robot.end();
}

fn user_gateway(interface: &str) {
    let (robot, gateway) = cell("can-user.toml", interface);
    let dump = Candump::start(interface);
    cansend(interface, THREE_BYTES);
    dump.wait_for(ANSWER);
    assert_eq!(dump.frames(), [THREE_BYTES, ANSWER]);
    for (name, value) in [("WordInputReg[1]", 1.0), ("WordInputReg[2]", 2.0), ("WordInputReg[3]", 3.0)] {
        register(&robot, name, value);
    }
    gateway.end();
    robot.end();
}

/// The pose is sent in cycles of three frames, and id 1 switches DO1.
fn system(interface: &str, robot: &HostSim) {
    let dump = Candump::start(interface);
    let frames = until("ten cycles", || Some(dump.frames()).filter(|frames| frames.len() > 32));
    let begin = frames.iter().position(|frame| frame.starts_with("002#")).unwrap();
    for cycle in frames[begin..].chunks_exact(3).take(10) {
        assert_eq!(cycle[0], POSE);
        assert!(cycle[1].starts_with("003#") && cycle[1].len() == 20, "{cycle:?}");
        assert!(cycle[2].starts_with("004#") && cycle[2].len() == 20, "{cycle:?}");
    }
    for (frame, value) in [("001#01", 1.0), ("001#00", 0.0), ("001#81", 129.0)] {
        cansend(interface, frame);
        register(robot, "DigitalOutputCommand[1]", value);
    }
}

fn system_controller(interface: &str) {
    let robot = controller("can-system-controller.toml", interface);
    system(interface, &robot);
    robot.end();
}

fn system_gateway(interface: &str) {
    // The controller's own CAN port is on another bus, in user space.
    let file = example("can-system-controller.toml");
    let robot = BINARY.controller(&file, &["--bind=can=slcan-tcp:127.0.0.1:0"]);
    let gateway = BINARY.gateway(&example("can-system.toml"), &robot, &[&bind("can-1", interface)]);
    system(interface, &robot);
    gateway.end();
    robot.end();
}

fn hand(interface: &str) {
    let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
    let gateway = BINARY.gateway(&example("can-hand.toml"), &robot, &[&bind("hand", interface)]);
    let dump = Candump::start(interface);
    dump.wait_for("501#000000000000");
    robot.command("run(grip.jspf)", "run start");
    dump.wait_for("501#C8C8C8C8C8C8");
    cansend(interface, "502#0307F401");
    register(&robot, "WordInputReg[3]", 500.0);
    // The hand is silent: its state becomes 0.
    register(&robot, "WordInputReg[1]", 0.0);
    register(&robot, "WordInputReg[3]", 500.0);
    gateway.end();
    robot.end();
}

fn python_can(interface: &str) {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/socketcan/python_can.py");
    let python = |example: &str| {
        let output = Command::new(python().unwrap()).args([script, interface, example]).output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "example {example}: {errors}");
    };
    let robot = controller("can-user-controller.toml", interface);
    robot.command("run(echo.jspf)", "run start");
    python("3");
    robot.end();
    let robot = controller("can-system-controller.toml", interface);
    python("4");
    register(&robot, "DigitalOutputCommand[1]", 1.0);
    robot.end();
    let (robot, gateway) = cell("can-user.toml", interface);
    python("3");
    gateway.end();
    robot.end();
}

fn refused_frames(interface: &str) {
    let robot = controller("can-system-controller.toml", interface);
    // An unknown id, and the other kind of id: the kernel filters them out, so they are not counted.
    cansend(interface, "005#01");
    cansend(interface, "00000001#01");
    // Ids of the recipe with another content.
    cansend(interface, "001#R1");
    cansend(interface, "001#0101");
    cansend(interface, "001#");
    cansend(interface, "001#04");
    register(&robot, "DigitalOutputCommand[1]", 4.0);
    let stats = robot.fresh();
    let port = &stats["ports"]["can"];
    assert_eq!(port["remote_frames"], 1, "{port}");
    assert_eq!(port["wrong_lengths"], 2, "{port}");
    assert_eq!(port["frames_in"], 1, "{port}");
    assert_eq!(port["unknown_ids"], 0, "{port}");
    assert_eq!(port["device"]["frames_in"], 4, "{port}");
    robot.end();
}

fn replay(interface: &str) {
    let robot = controller("can-system-controller.toml", interface);
    let dump = Candump::start(interface);
    for value in 0..40 {
        cansend(interface, &format!("001#{value:02X}"));
    }
    let log = until("a log", || {
        let log = dump.log();
        (log.len() > 300 && log.iter().any(|line| line.ends_with(" 001#27"))).then_some(log)
    });
    robot.end();
    for part in ["input", "output"] {
        // `encode` reads what `decode` prints.
        let values = convert("decode", part, &log.join("\n"));
        let again = convert("encode", part, &values);
        let is_input = |line: &&String| line.contains(" 001#") == (part == "input");
        let expected: Vec<&str> = log.iter().filter(is_input).map(String::as_str).collect();
        assert!(expected.len() >= 40);
        assert_eq!(again.lines().collect::<Vec<_>>(), expected, "{part}");
    }
    // canplayer replays the log: it has the same effect on another controller as on the first.
    let robot = controller("can-system-controller.toml", interface);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bus.log");
    let input: Vec<&str> = log.iter().filter(|line| line.contains(" 001#")).map(String::as_str).collect();
    std::fs::write(&path, input.join("\n") + "\n").unwrap();
    tool(&format!("canplayer -t -I {}", path.display()));
    register(&robot, "DigitalOutputCommand[1]", 39.0);
    assert_eq!(robot.fresh()["ports"]["can"]["frames_in"], 40);
    robot.end();
}

fn convert(command: &str, part: &str, text: &str) -> String {
    let mut process = BINARY
        .command()
        .arg(command)
        .arg(example("can-system-controller.toml"))
        .args(["--part", part])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut stdin = process.stdin.take().unwrap();
    let text = format!("{text}\n");
    let writer = std::thread::spawn(move || stdin.write_all(text.as_bytes()).unwrap());
    let output = process.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success(), "{command}");
    String::from_utf8(output.stdout).unwrap()
}
