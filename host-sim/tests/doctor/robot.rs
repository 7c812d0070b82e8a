//! Commands that the simulated controller refuses.

use std::path::PathBuf;

use recipe_test_kit::{HostSim, toml};

use super::{BINARY, Feeder, doctor, finds, logs};

/// A controller with a program.
fn controller(mode: &str, power: &str) -> String {
    format!(
        "[listen]\naddress = \"127.0.0.1\"\n\n[robot]\npower = \"{power}\"\nmode = \"{mode}\"\n\n\
         [[program]]\nname = \"pick.jspf\"\nscript = \"wait_ms(1);\"\n"
    )
}

struct Cell {
    folder: tempfile::TempDir,
    robot: HostSim,
    file: PathBuf,
}

impl Cell {
    /// A panel whose order 1 runs this program, and a controller in this mode.
    fn new(program: &str, mode: &str, power: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (file, robot_file) = (folder.path().join("panel.toml"), folder.path().join("robot.toml"));
        std::fs::write(&file, toml::panel(&format!("1 = \"run({program})\""), 1_000)).unwrap();
        std::fs::write(&robot_file, controller(mode, power)).unwrap();
        let robot = BINARY.controller(&robot_file, &[]);
        Self { folder, robot, file }
    }

    fn arguments(&self) -> Vec<String> {
        let line = self.folder.path().join("device");
        let mut arguments = self.robot.links(&["command", "state", "modbus"]);
        arguments.push(format!("--bind=device=pty:{}", line.display()));
        arguments
    }

    /// What the gateway says after the order.
    #[track_caller]
    fn says(&self, words: &[&str]) {
        let arguments = self.arguments();
        let gateway = HostSim::start(BINARY.run("gateway", &self.file).arg("-v").args(&arguments));
        gateway.stats("the command link is up", |stats| stats["links"]["command"]["state"] == "up");
        let line = self.folder.path().join("device");
        let base = Feeder::start(&line, &[255, 255, 0, 0, 238, 238]);
        gateway.stats("the panel is heard", |stats| stats["ports"]["device"]["frames_in"] != 0);
        drop(base);
        let _order = Feeder::start(&line, &[255, 255, 1, 0, 238, 238]);
        logs(&gateway, &[&["port device: "], words].concat());
        gateway.end();
    }
}

#[test]
fn manual_mode() {
    let cell = Cell::new("pick.jspf", "manual", "enabled");
    let words = ["the controller is in manual mode"];
    cell.says(&["run(pick.jspf) refused ", " s ago: the controller is in manual mode"]);
    finds(&doctor(&cell.file, &cell.arguments()), "manual", &words);
}

#[test]
fn power_off() {
    let cell = Cell::new("pick.jspf", "remote", "off");
    cell.says(&["run(pick.jspf) refused ", " s ago: the arm is powered off"]);
    finds(&doctor(&cell.file, &cell.arguments()), "power_off", &["the arm is powered off"]);
}

#[test]
fn a_wrong_program_name() {
    // Nobody knows the name's fault before the command is given: the doctor gives none.
    let cell = Cell::new("pcik.jspf", "remote", "enabled");
    cell.says(&["run(pcik.jspf) refused", "in remote mode, powered and enabled", "no program pcik.jspf"]);
    let findings = doctor(&cell.file, &cell.arguments());
    assert!(findings.iter().all(|finding| finding["place"] == "port"), "{findings:#?}");
}
