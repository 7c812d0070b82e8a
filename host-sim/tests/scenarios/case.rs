//! One scenario in one environment: its folders, its programs, its time limit.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock, RwLock, mpsc};
use std::time::{Duration, Instant};

use libtest_mimic::Failed;
use recipe_test_kit::example;

use super::environment::{Environment, Gateway, Plan};
use super::namespace::Namespace;
use super::program::Running;
use super::robot::{Robot, RobotPlan};
use super::terminals;

/// The time limit of a scenario.
const LIMIT: Duration = Duration::from_secs(300);
/// Maximum number of attempts of a scenario in which the machine holds the gateway or its devices up.
const ATTEMPTS: usize = 3;
/// Number of lines of each log that are shown if a case fails.
const SHOWN: usize = 12;

/// A scenario, for every environment.
pub(crate) struct Scenario {
    pub(crate) name: &'static str,
    run: fn(&Case),
    limit: Duration,
    is_alone: bool,
    pub(crate) has_true_cable: bool,
    /// It needs a gateway that can notice that it was stopped.
    pub(crate) is_of_sleep: bool,
}

impl Scenario {
    pub(crate) fn new(name: &'static str, run: fn(&Case)) -> Self {
        Self { name, run, limit: LIMIT, is_alone: false, has_true_cable: false, is_of_sleep: false }
    }

    /// It takes this long in addition to the usual time.
    pub(crate) fn lasting(self, time: Duration) -> Self {
        Self { limit: LIMIT + time, ..self }
    }

    /// It pulls the cable, and nothing may acknowledge what did not get through.
    pub(crate) fn with_true_cable(self) -> Self {
        Self { has_true_cable: true, ..self }
    }

    /// It stops the gateway, which has to notice.
    pub(crate) fn of_sleep(self) -> Self {
        Self { is_of_sleep: true, ..self }
    }

    /// It measures time or load, so no other case runs meanwhile.
    pub(crate) fn alone(self) -> Self {
        Self { is_alone: true, ..self }
    }
}

/// A running scenario.
pub(crate) struct Case {
    pub(crate) environment: Arc<dyn Environment>,
    /// Temporary folder for sockets, links and files, with a short path.
    pub(crate) folder: tempfile::TempDir,
    /// Folder for logs.
    pub(crate) logs: PathBuf,
    pub(crate) running: Running,
    /// The network namespace of its programs, if they have one.
    pub(crate) namespace: OnceLock<Arc<Namespace>>,
}

impl Case {
    /// A simulated controller, from an example file.
    pub(crate) fn robot(&self, file: &str) -> RobotPlan<'_> {
        RobotPlan::new(self, example(file))
    }

    /// A simulated controller, from this text.
    pub(crate) fn robot_of(&self, toml: &str) -> RobotPlan<'_> {
        let path = self.folder.path().join("controller.toml");
        std::fs::write(&path, toml).unwrap();
        RobotPlan::new(self, path)
    }

    /// A gateway, from an example file.
    pub(crate) fn gateway(&self, file: &str) -> Plan<'_> {
        Plan::new(self, example(file))
    }

    /// A gateway, from this text.
    pub(crate) fn gateway_of(&self, toml: &str) -> Plan<'_> {
        let path = self.folder.path().join("gateway.toml");
        std::fs::write(&path, toml).unwrap();
        Plan::new(self, path)
    }

    /// Starts an example's gateway with this controller, and waits for its links.
    #[track_caller]
    pub(crate) fn cell(&self, file: &str, robot: &Robot) -> Box<dyn Gateway> {
        self.gateway(file).robot(robot).start()
    }
}

/// Runs the scenario, alone if it has to be. A gateway that the machine has stopped for half a second discards what
/// its devices sent meanwhile, as it must, and devices whose lines the machine holds up look as if they were away; a
/// modelled chip that lags loses what its devices and the network have no more room for. A scenario that is not about
/// that then fails, and is run again.
pub(crate) fn run(
    name: &str,
    scenario: &Scenario,
    environment: &Arc<dyn Environment>,
    machine: &RwLock<()>,
) -> Result<(), Failed> {
    let _others = (!scenario.is_alone).then(|| machine.read());
    let _whole = scenario.is_alone.then(|| machine.write());
    for _ in 1..ATTEMPTS {
        match attempt(name, scenario, Arc::clone(environment)) {
            Err(Failure { message, held_up: Some(what) }) if !scenario.is_of_sleep => {
                eprintln!("{name}: the machine held up {what}, once more; {message}");
            }
            ended => return ended.map_err(|failed| failed.message.into()),
        }
    }
    attempt(name, scenario, Arc::clone(environment)).map_err(|failed| failed.message.into())
}

/// Why an attempt failed.
struct Failure {
    message: String,
    /// What the machine held up meanwhile.
    held_up: Option<&'static str>,
}

impl From<std::io::Error> for Failure {
    fn from(error: std::io::Error) -> Self {
        Self { message: error.to_string(), held_up: None }
    }
}

/// Runs the scenario on a separate thread, so that its time limit ends a hang.
fn attempt(name: &str, scenario: &Scenario, environment: Arc<dyn Environment>) -> Result<(), Failure> {
    let logs = Path::new(env!("CARGO_TARGET_TMPDIR")).join("scenarios").join(name.replace("::", "-"));
    let _ = std::fs::remove_dir_all(&logs);
    std::fs::create_dir_all(&logs)?;
    let running = Running::default();
    let folder = tempfile::Builder::new().prefix("scenario-").tempdir()?;
    let case = Case {
        environment,
        folder,
        logs: logs.clone(),
        running: running.clone(),
        namespace: OnceLock::new(),
    };
    let (begin, has_terminals) = (Instant::now(), case.environment.has_terminals());
    let (run, limit, has_true_cable) = (scenario.run, scenario.limit, scenario.has_true_cable);
    let (done, ended) = mpsc::channel();
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(move || {
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            if has_true_cable {
                case.environment.lay_true_cable(&case);
            }
            run(&case);
        }));
        // Remove its folder before the end is reported.
        drop(case);
        let _ = done.send(result);
    })?;
    let outcome = match ended.recv_timeout(limit) {
        Ok(Ok(())) => Ok(()),
        Ok(Err(panic)) => {
            let text = panic.downcast_ref::<String>().cloned();
            Err(text.or(panic.downcast_ref::<&str>().map(|text| (*text).to_owned())).unwrap_or_default())
        }
        Err(_) => Err(format!("not done within {limit:?}")),
    };
    running.kill();
    if ended.try_recv().is_ok() || outcome.is_ok() {
        let _ = thread.join();
    }
    match outcome {
        Ok(()) => {
            let _ = std::fs::remove_dir_all(&logs);
            Ok(())
        }
        Err(message) => {
            let logs = logs_in(&logs);
            let says = |line: &str| logs.iter().any(|(_, log)| log.contains(line));
            let has_lagged = has_terminals && terminals::were_late_since(begin);
            let held_up = says("the gateway slept").then_some("the gateway");
            let held_up = held_up.or(says("behind real time").then_some("the chip"));
            let held_up = held_up.or(has_lagged.then_some("the terminals"));
            Err(Failure { message: format!("{message}\n{}", ends_of(&logs)), held_up })
        }
    }
}

/// Each log: its path and its text.
fn logs_in(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut files: Vec<_> = std::fs::read_dir(folder).into_iter().flatten().flatten().collect();
    files.sort_by_key(|file| file.file_name());
    let text = |path: &Path| String::from_utf8_lossy(&std::fs::read(path).unwrap_or_default()).into_owned();
    files.iter().map(|file| (file.path(), text(&file.path()))).collect()
}

/// The end of each log.
fn ends_of(logs: &[(PathBuf, String)]) -> String {
    let mut text = String::new();
    for (path, log) in logs {
        let lines: Vec<&str> = log.lines().collect();
        let end = lines[lines.len().saturating_sub(SHOWN)..].join("\n    ");
        text.push_str(&format!("{}:\n    {end}\n", path.display()));
    }
    text
}
