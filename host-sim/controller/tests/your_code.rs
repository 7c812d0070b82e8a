//! A test of one's own code against the simulated controller: one process, no socket, no sleep. The code
//! powers the robot up and runs a program; three seconds of the controller's time pass in milliseconds.

use std::net::Ipv4Addr;

use proto_core::time::{Duration, Instant};
use recipe_config::{Power, SimConfig, SimProgram};
use recipe_controller::{ConnId, Controller, ControllerInput, ControllerOutput};

/// The code under test: the command behind a reply. None behind the last, or when one fails.
fn next_command(reply: &str) -> Option<&'static str> {
    match reply {
        "" => Some("poweron"),
        "poweron success" => Some("enable"),
        "enable success" => Some("run(weld)"),
        _ => None,
    }
}

/// The controller and one client, on a clock that jumps from deadline to deadline.
struct Bench {
    controller: Controller,
    now: Instant,
    received: String,
}

impl Bench {
    fn new() -> Self {
        let mut config = SimConfig::default();
        config.robot.power = Power::Off;
        let script = r#"set("DO[1]", true); wait_ms(2000); set("DO[1]", false);"#;
        config.programs.push(SimProgram { name: "weld".into(), script: script.into() });
        let controller = Controller::new(&config).expect("a controller");
        let mut bench = Self { controller, now: Instant::ZERO, received: String::new() };
        let from = Ipv4Addr::LOCALHOST.into();
        bench.input(ControllerInput::CommandOpened { conn: ConnId(1), from });
        bench
    }

    /// One change, then everything that follows from it; returns when to come back.
    fn input(&mut self, input: ControllerInput<'_>) -> Instant {
        self.controller.handle(self.now, input);
        loop {
            match self.controller.poll_output(self.now) {
                ControllerOutput::Send { bytes, .. } => self.received += &String::from_utf8_lossy(&bytes),
                ControllerOutput::Sleep { until } => return until,
                _ => {}
            }
        }
    }

    /// Lets time pass, up to a reply or to the end.
    fn wait(&mut self, longest: Duration) -> String {
        let end = self.now + longest;
        while self.now < end && self.received.is_empty() {
            self.now = self.input(ControllerInput::Tick).min(end);
        }
        self.input(ControllerInput::Tick);
        std::mem::take(&mut self.received).trim().to_owned()
    }
}

#[test]
fn it_powers_up_and_runs_the_program() {
    let output_1 = |bench: &Bench| bench.controller.registers().value("DO[1]".parse().expect("an output"));
    let mut bench = Bench::new();
    let mut reply = String::new();
    while let Some(command) = next_command(&reply) {
        bench.input(ControllerInput::CommandBytes { conn: ConnId(1), bytes: command.as_bytes() });
        reply = bench.wait(Duration::from_secs(60));
    }
    assert_eq!(reply, "run start");
    bench.wait(Duration::from_secs(1));
    assert_eq!(output_1(&bench), 1.0);
    bench.wait(Duration::from_secs(2));
    assert_eq!(output_1(&bench), 0.0);
}
