//! One process that serves several cells (docs/several-cells.md).

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

use recipe_test_kit::{HostSim, example, free_servers, names, until};
use rustix::process::Signal;
use serde_json::Value;

use super::BINARY;
use super::processes::refused;

fn robot() -> HostSim {
    HostSim::start(
        BINARY
            .command()
            .args(["controller", "--stats", "50ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(free_servers()),
    )
}

/// Two cells of the same example, each with its own line and robot.
struct Cells {
    folder: tempfile::TempDir,
    command: Command,
}

const NAMES: [&str; 2] = ["left", "right"];

impl Cells {
    /// On one thread.
    fn new(robots: [&HostSim; 2]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut command = BINARY.command();
        command.args(["gateway", "--threads", "1"]);
        for (name, robot) in NAMES.into_iter().zip(robots) {
            let file = folder.path().join(name).with_extension("toml");
            std::fs::copy(example("rs485-system.toml"), &file).unwrap();
            command.arg("-c").arg(file);
            let links = robot.links(&["state", "modbus"]);
            command.args(links.iter().map(|set| set.replacen("--set=", &format!("--set={name}/"), 1)));
        }
        Self { folder, command }
    }

    /// With a pseudoterminal for each.
    fn with_lines(mut self) -> Self {
        for name in NAMES {
            self.command.arg(bind(name, &self.line(name)));
        }
        self
    }

    fn line(&self, name: &str) -> PathBuf {
        self.folder.path().join(format!("line-{name}"))
    }

    fn device(&self, name: &str) -> File {
        File::options().read(true).write(true).open(self.line(name)).unwrap()
    }
}

fn bind(name: &str, line: &Path) -> String {
    format!("--bind={name}/rs485-1=pty:{}", line.display())
}

fn switch(device: &mut File, value: u8) {
    device.write_all(&[0xFF, 0xFF, value, 0xEE, 0xEE]).unwrap();
}

fn is_switched(robot: &HostSim, value: f64) {
    robot.next_stats(|stats| stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(value));
}

fn is_up(cell: &Value) -> bool {
    cell["links"]["modbus"]["state"] == "up" && cell["links"]["state"]["received"] != 0
}

#[test]
fn each_cell_has_its_own_robot_and_does_not_need_the_others() {
    let robots = [robot(), robot()];
    let mut cells = Cells::new([&robots[0], &robots[1]]).with_lines();
    let ready = cells.folder.path().join("ready.json");
    let gateway = HostSim::start(cells.command.args(["--stats", "50ms", "--ready"]).arg(&ready));
    let file: Value = serde_json::from_str(&std::fs::read_to_string(&ready).unwrap()).unwrap();
    assert_eq!(file, gateway.ready);
    for name in NAMES {
        assert_eq!(gateway.ready["cells"][name]["ports"]["rs485-1"], cells.line(name).to_str().unwrap());
    }
    gateway.next_stats(|stats| NAMES.iter().all(|name| is_up(&stats["cells"][name])));

    let mut devices = NAMES.map(|name| cells.device(name));
    for (nth, (device, robot)) in devices.iter_mut().zip(&robots).enumerate() {
        switch(device, 5 + nth as u8);
        is_switched(robot, 5.0 + nth as f64);
    }
    // Its own robot's pose comes to each of them, every 4 ms.
    for device in &mut devices {
        let mut frame = [0; 64];
        device.read_exact(&mut frame).unwrap();
        assert!(frame.windows(2).any(|head| head == [0xFF, 0xFF]), "{frame:x?}");
    }

    // The left robot is switched off. What this takes does not touch the right cell.
    let [left, right] = robots;
    left.ended_by(Signal::TERM);
    let stats = gateway.next_stats(|stats| stats["cells"]["left"]["links"]["modbus"]["state"] != "up");
    assert!(is_up(&stats["cells"]["right"]), "{stats}");
    let told = until("a line in the log", || gateway.log("no connection to the controller").first().cloned());
    assert!(told.contains("cell{name=\"left\"}"), "{told}");
    switch(&mut devices[1], 9);
    is_switched(&right, 9.0);
    let stats = gateway.next_stats(|stats| stats["cells"]["right"]["ports"]["rs485-1"]["frames_in"] == 2);
    assert_eq!(stats["cells"]["left"]["ports"]["rs485-1"]["frames_in"], 1);

    gateway.ended_by(Signal::INT);
    assert_eq!(names(cells.folder.path()), ["left.toml", "right.toml"]);
}

#[test]
fn each_cell_has_a_console_of_its_own() {
    let robots = [robot(), robot()];
    let mut cells = Cells::new([&robots[0], &robots[1]]).with_lines();
    let (key, state) = (cells.folder.path().join("console.key"), cells.folder.path().join("revisions"));
    assert!(BINARY.command().args(["ctl", "keygen"]).arg(&key).status().unwrap().success());
    cells.command.args(["--stats", "50ms", "--console", "127.0.0.1:0", "--console-key"]).arg(&key);
    let gateway = HostSim::start(cells.command.arg("--console-state").arg(&state));
    assert_eq!(names(&state), NAMES);
    let stats = gateway.next_stats(|stats| NAMES.iter().all(|name| is_up(&stats["cells"][name])));
    let sent = |stats: &Value, name: &str| stats["cells"][name]["ports"]["rs485-1"]["frames_out"].as_u64();
    let before = sent(&stats, "right").unwrap();

    // Another configuration for the left cell, while the right one goes on.
    let slower = cells.folder.path().join("slower.toml");
    let text = std::fs::read_to_string(cells.folder.path().join("left.toml")).unwrap();
    std::fs::write(&slower, text.replace("cycle_ms = 4", "cycle_ms = 100")).unwrap();
    let to = gateway.at("cells/left/console").to_string();
    for words in [vec!["push", slower.to_str().unwrap(), "--apply"], vec!["confirm"]] {
        let mut ctl = BINARY.command();
        let output = ctl.args(["ctl", "--to", &to, "--key"]).arg(&key).args(&words).output().unwrap();
        assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
    gateway.skip_lines();
    gateway.next_stats(|stats| is_up(&stats["cells"]["left"]) && sent(stats, "right") > Some(before + 50));
    let mut devices = NAMES.map(|name| cells.device(name));
    for (device, robot) in devices.iter_mut().zip(&robots) {
        switch(device, 3);
        is_switched(robot, 3.0);
    }
    let told = gateway.log("what=\"confirm\"");
    assert!(told[0].contains("cell{name=\"left\"}"), "{told:?}");
    let kept = |name: &str| std::fs::read_dir(state.join(name)).unwrap().count();
    assert!(kept("left") > kept("right"), "a revision more");
    gateway.ended_by(Signal::TERM);
}

#[test]
fn all_cells_start_or_none() {
    let robots = [robot(), robot()];
    let started = |cells: &mut Cells, words: &str| {
        let message = refused(&mut cells.command);
        assert!(message.contains(words), "{message}");
        assert_eq!(names(cells.folder.path()), ["left.toml", "right.toml"], "{words}");
    };
    let cells = || Cells::new([&robots[0], &robots[1]]);

    let mut no_place = cells();
    no_place.command.arg(bind("left", &no_place.line("left")));
    no_place.command.arg(bind("right", Path::new("/dev/null/line")));
    started(&mut no_place, "right: --bind rs485-1=pty:/dev/null/line: ");

    let mut wrong = cells().with_lines();
    std::fs::write(wrong.folder.path().join("right.toml"), "[controller]\naddress = 1\n").unwrap();
    started(&mut wrong, "right.toml:2:");
    let mut missing = cells().with_lines();
    std::fs::write(missing.folder.path().join("right.toml"), "").unwrap();
    started(&mut missing, "right: --set controller.ports.state=");

    for (option, words) in [
        ("--bind=rs485-1=pty:line", "--bind rs485-1=pty:line: for which cell? Write the cell before it"),
        ("--bind=up/rs485-1=pty:line", "there is no cell up; there are left, right"),
        ("--set=port.rs485-1.baud=9600", "such as left/port.rs485-1.baud=9600"),
        ("--bind=left/other=pty:line", "left: --bind other=pty:line: there is no such port"),
        ("--set=left/port.rs485-1.baud=1", "left: --set port.rs485-1.baud=1: "),
        ("--capture=file.pcapng", "--capture is for one cell"),
        ("--record=folder", "--record is for one cell"),
        ("--sparkplug=node.toml", "--sparkplug is for one cell"),
    ] {
        let mut cells = cells();
        cells.command.arg(option);
        started(&mut cells, words);
    }
    for robot in &robots {
        let stats = robot.next_stats(|_| true);
        assert_eq!(
            stats["servers"]["modbus"]["opened"].as_u64().unwrap_or(0),
            0,
            "nobody has called: {stats}"
        );
    }

    let twice = example("rs485-system.toml");
    let mut command = BINARY.command();
    command.args(["gateway", "-c"]).arg(&twice).arg("-c").arg(&twice);
    let message = refused(&mut command);
    assert!(message.contains("another cell is called rs485-system too"), "{message}");
    let mut command = BINARY.command();
    let message = refused(command.args(["gateway", "--threads", "2", "-c"]).arg(&twice));
    assert!(message.contains("--threads is for several cells"), "{message}");
}
