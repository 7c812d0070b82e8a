//! What the session does the same with every board: its controller, its configuration, its key, its network, its panel.

use std::io::Write;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use recipe_test_kit::{Process, until};
use tempfile::TempDir;

use crate::BINARY;
use crate::ctl::{Ctl, TIMEOUT};
use crate::panel::Panel;
use crate::robot::Robot;
use crate::target::Target;

/// The address that QEMU's user network gives a board, and that of this host in it.
const BOARD: &str = "10.0.2.15";
pub(crate) const HERE: &str = "10.0.2.2";

/// A board, as far as it differs from others.
pub(crate) trait Board {
    fn around(&self) -> &Surroundings;

    fn around_mut(&mut self) -> &mut Surroundings;

    /// Starts it, unless it runs by itself, with the image of this file if it keeps nothing.
    fn start(&mut self, file: &Path);

    /// Presses its button, which may be held until [`Board::let_go`].
    fn press(&self);

    fn let_go(&self) {}

    /// Takes its power.
    fn kill(&mut self);

    /// A trial that nobody will confirm, in seconds. It has to start and be asked within it.
    fn short_trial_s(&self) -> u32;
}

impl<B: Board> Target for B {
    fn folder(&self) -> &TempDir {
        &self.around().folder
    }

    fn config(&self, timeout_ms: u32) -> String {
        self.around().robot.config(timeout_ms).replacen("127.0.0.1", HERE, 1)
    }

    fn start(&mut self, file: &Path) {
        Board::start(self, file);
        self.around().until_answers();
    }

    fn has_names(&self) -> bool {
        false
    }

    fn claim(&mut self) {
        self.around().claim(|| self.press());
        self.let_go();
    }

    fn kill(&mut self) {
        Board::kill(self);
    }

    fn address(&self) -> SocketAddr {
        self.around().to
    }

    fn host(&self) -> Option<&'static str> {
        Some(BOARD)
    }

    fn short_trial_s(&self) -> u32 {
        Board::short_trial_s(self)
    }

    fn push_takes(&self) -> Duration {
        Duration::from_millis(400)
    }

    fn plug(&mut self) {
        let line = PathBuf::from(self.around().path(LINE));
        self.around_mut().panel = Some(Panel::start(move || {
            let stream = UnixStream::connect(&line).ok()?;
            // Nobody reads while the board starts again.
            stream.set_write_timeout(Some(Duration::from_secs(1))).ok()?;
            Some(Box::new(stream) as Box<dyn Write>)
        }));
    }

    fn pull(&mut self) {
        self.around_mut().panel = None;
    }
}

/// The socket of the line with the panel.
pub(crate) const LINE: &str = "line";

/// Around a board.
pub(crate) struct Surroundings {
    folder: TempDir,
    pub(crate) robot: Robot,
    panel: Option<Panel>,
    /// Where its port 80 is reached.
    to: SocketAddr,
}

impl Surroundings {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let robot = Robot::new(folder.path());
        Self::with(folder, robot)
    }

    /// With another controller.
    pub(crate) fn with(folder: TempDir, robot: Robot) -> Self {
        // Free at the moment; nobody else asks for it by number.
        let to = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        Self { folder, robot, panel: None, to }
    }

    /// A file that a variable names, relative to the workspace: Cargo runs tests in the package's folder.
    pub(crate) fn named(variable: &str) -> PathBuf {
        let named = std::env::var_os(variable).unwrap_or_else(|| panic!("{variable} is not set"));
        Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(named)
    }

    pub(crate) fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    /// QEMU's options for the way to port 80.
    pub(crate) fn forward(&self) -> String {
        format!("hostfwd=tcp:{}-:80", self.to)
    }

    /// The image of a configuration.
    pub(crate) fn image(&self, file: &Path) -> String {
        let image = self.path("first.img");
        let made = BINARY.command().arg("image").arg(file).args(["-o", &image]).output().unwrap();
        assert!(made.status.success(), "{made:?}");
        image
    }

    /// Waits until the board answers. One that has another key, or none, answers too.
    #[track_caller]
    fn until_answers(&self) {
        let ctl = Ctl {
            to: self.to,
            host: Some(BOARD),
            key: Some(self.folder.path().join("key")),
            timeout: TIMEOUT,
        };
        until("it answers", || {
            let printed = ctl.run(&["info"]);
            (printed.code == 0 || printed.err.contains("key")).then_some(())
        });
    }

    /// Gives it the key, once it says that its button is to be pressed.
    #[track_caller]
    fn claim(&self, press: impl FnOnce()) {
        let ctl = Ctl { to: self.to, host: Some(BOARD), key: None, timeout: TIMEOUT };
        let start = || Process::start(&mut ctl.command(&["claim", &self.path("key")]));
        let mut claim = start();
        until("it asks for the button", || {
            let asks = |line: &String| line.starts_with("press the button of rgw-");
            if claim.errors().iter().any(asks) {
                return Some(());
            }
            // A board has few places; one that has none for a moment is asked again, as by a person.
            if claim.has_ended() {
                eprintln!("claim: {}", claim.all_errors());
                claim = start();
            }
            None
        });
        press();
        assert!(claim.ended().success(), "{}", claim.all_errors());
    }
}
