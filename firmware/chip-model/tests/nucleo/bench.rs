//! The test bench: the chip with the firmware, and optionally a robot controller at the other end of the Ethernet
//! cable.

use std::sync::OnceLock;

use proto_core::config::image;
use recipe_chip_model::device::{MICRO, MILLI, Picos};
use recipe_chip_model::{Chip, Program};
use recipe_config::SimConfig;
use recipe_test_kit::toml;

use crate::robot::Robot;

pub(crate) struct Bench {
    pub(crate) chip: Chip,
    pub(crate) robot: Option<Robot>,
    seen: usize,
}

/// The environment variable with the firmware's path.
const ELF: &str = "CHIP_ELF";
/// About the duration of a frame of 60 bytes on the cable.
const CABLE: Picos = 20 * MICRO;

fn program() -> &'static Program {
    static PROGRAM: OnceLock<Program> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let path =
            std::env::var_os(ELF).unwrap_or_else(|| panic!("{ELF} does not say where the firmware is"));
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        Program::read(&bytes).expect("the firmware")
    })
}

/// The configuration image of a gateway file.
pub(crate) fn image_of(toml: &str) -> Vec<u8> {
    let config = toml::gateway(toml);
    let mut bytes = vec![0; image::MAX_IMAGE];
    let len = image::encode(&*config, &mut bytes).expect("it fits");
    bytes.truncate(len);
    bytes
}

impl Bench {
    /// A board without a configuration.
    pub(crate) fn blank() -> Self {
        Self::with_image(&[])
    }

    /// A board with the image of a gateway file.
    pub(crate) fn new(toml: &str) -> Self {
        Self::with_image(&image_of(toml))
    }

    pub(crate) fn with_image(image: &[u8]) -> Self {
        let chip = Chip::new(program(), image).unwrap_or_else(|error| panic!("{error}"));
        Self { chip, robot: None, seen: 0 }
    }

    /// A board with this program.
    pub(crate) fn of(program: &'static Program, image: &[u8]) -> Self {
        let chip = Chip::new(program, image).unwrap_or_else(|error| panic!("{error}"));
        Self { chip, robot: None, seen: 0 }
    }

    /// Adds a controller at 192.168.12.10.
    pub(crate) fn with_robot(mut self) -> Self {
        self.robot = Some(Robot::new(&SimConfig::default()));
        self
    }

    /// Adds the controller of a file, at 192.168.12.10.
    pub(crate) fn with_robot_of(mut self, toml: &str) -> Self {
        self.robot = Some(Robot::new(&toml::controller(toml)));
        self
    }

    /// Switches the board off and on, and forgets what it has logged and how often its power was cut.
    pub(crate) fn begin_again(&mut self) {
        self.chip.cut_power();
        self.chip.power_cuts = 0;
        self.chip.log.clear();
        self.seen = 0;
    }

    pub(crate) fn now(&self) -> Picos {
        self.chip.now()
    }

    /// Runs for `span`.
    #[track_caller]
    pub(crate) fn run(&mut self, span: Picos) {
        let end = self.now() + span;
        while self.now() < end {
            let next = match &mut self.robot {
                Some(robot) => {
                    robot.exchange(self.chip.now(), &mut self.chip.devices().ethernet);
                    end.min(self.chip.now() + CABLE)
                }
                None => end,
            };
            if let Err(stopped) = self.chip.run_until(next) {
                panic!("{stopped}\n{}", self.history());
            }
        }
    }

    /// Runs until `is_so`, at most for `span`.
    #[track_caller]
    pub(crate) fn until(&mut self, what: &str, span: Picos, mut is_so: impl FnMut(&mut Self) -> bool) {
        let end = self.now() + span;
        while !is_so(self) {
            assert!(self.now() < end, "not within {} ms: {what}\n{}", span / MILLI, self.history());
            self.run(MILLI / 4);
        }
    }

    /// Runs until the log has a line with `text`, after the lines found before; returns its time.
    #[track_caller]
    pub(crate) fn until_log(&mut self, text: &str, span: Picos) -> Picos {
        let mut found = None;
        self.until(&format!("a log line with {text:?}"), span, |bench| {
            let new = bench.chip.log.iter().enumerate().skip(bench.seen);
            found = new
                .into_iter()
                .find(|(_, (_, line))| line.contains(text))
                .map(|(index, (at, _))| (index, *at));
            found.is_some()
        });
        let (index, at) = found.expect("it was found");
        self.seen = index + 1;
        at
    }

    /// What was logged up to now is not found by [`Self::until_log`].
    pub(crate) fn look_no_further_back(&mut self) {
        self.seen = self.chip.log.len();
    }

    /// Whether the log has a line with this text.
    pub(crate) fn has_logged(&self, text: &str) -> bool {
        self.times_logged(text) > 0
    }

    /// The number of lines with this text.
    pub(crate) fn times_logged(&self, text: &str) -> usize {
        self.chip.log.iter().filter(|(_, line)| line.contains(text)).count()
    }

    /// The log and the last accesses.
    pub(crate) fn history(&mut self) -> String {
        let mut text = String::from("log:\n");
        for (at, line) in &self.chip.log {
            text += &format!("{:12.3} ms  {line}\n", *at as f64 / MILLI as f64);
        }
        text += &format!("at {}\nlast accesses:\n", self.chip.place());
        for access in self.chip.accesses(64) {
            text += &format!("{access}\n");
        }
        text
    }
}
