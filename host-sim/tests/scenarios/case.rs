//! One scenario in one environment: its folders, its programs, its time limit.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock, RwLock, mpsc};
use std::time::Duration;

use libtest_mimic::Failed;
use recipe_test_kit::example;

use super::environment::{Environment, Gateway, Plan};
use super::namespace::Namespace;
use super::program::Running;
use super::robot::{Robot, RobotPlan};

/// How long a scenario may take.
const LIMIT: Duration = Duration::from_secs(90);
/// Lines of each log that are shown of a case that failed.
const SHOWN: usize = 12;

/// What is to be shown, whoever the gateway is.
pub(crate) struct Scenario {
    pub(crate) name: &'static str,
    run: fn(&Case),
    limit: Duration,
    is_alone: bool,
    pub(crate) has_true_cable: bool,
    /// Only where a gateway can notice that it was stopped.
    pub(crate) is_of_sleep: bool,
}

impl Scenario {
    pub(crate) fn new(name: &'static str, run: fn(&Case)) -> Self {
        Self { name, run, limit: LIMIT, is_alone: false, has_true_cable: false, is_of_sleep: false }
    }

    /// It takes so long, beside what every scenario takes.
    pub(crate) fn lasting(self, time: Duration) -> Self {
        Self { limit: LIMIT + time, ..self }
    }

    /// It pulls the cable, and nobody may acknowledge what did not get through.
    pub(crate) fn with_true_cable(self) -> Self {
        Self { has_true_cable: true, ..self }
    }

    /// It stops the gateway, which has to notice.
    pub(crate) fn of_sleep(self) -> Self {
        Self { is_of_sleep: true, ..self }
    }

    /// It measures something, so nothing else runs meanwhile.
    pub(crate) fn alone(self) -> Self {
        Self { is_alone: true, ..self }
    }
}

/// A scenario under way.
pub(crate) struct Case {
    pub(crate) environment: Arc<dyn Environment>,
    /// For sockets, links and files: a short path, gone afterwards.
    pub(crate) folder: tempfile::TempDir,
    /// For what programs say.
    pub(crate) logs: PathBuf,
    pub(crate) running: Running,
    /// Where its programs are, when not in the network of the tests.
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

    /// An example's gateway at this robot, its links up.
    #[track_caller]
    pub(crate) fn cell(&self, file: &str, robot: &Robot) -> Box<dyn Gateway> {
        self.gateway(file).robot(robot).start()
    }
}

/// Runs the scenario on a thread of its own, so that a hang ends with its limit.
pub(crate) fn run(
    name: &str,
    scenario: &Scenario,
    environment: Arc<dyn Environment>,
    machine: &RwLock<()>,
) -> Result<(), Failed> {
    let others = (!scenario.is_alone).then(|| machine.read());
    let whole = scenario.is_alone.then(|| machine.write());
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
    let (run, limit, has_true_cable) = (scenario.run, scenario.limit, scenario.has_true_cable);
    let (done, ended) = mpsc::channel();
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(move || {
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            if has_true_cable {
                case.environment.lay_true_cable(&case);
            }
            run(&case);
        }));
        // Its folder is gone before anybody hears that it ended.
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
    drop((others, whole));
    match outcome {
        Ok(()) => {
            let _ = std::fs::remove_dir_all(&logs);
            Ok(())
        }
        Err(message) => Err(format!("{message}\n{}", ends_of(&logs)).into()),
    }
}

/// How each log ends.
fn ends_of(logs: &Path) -> String {
    let mut files: Vec<_> = std::fs::read_dir(logs).into_iter().flatten().flatten().collect();
    files.sort_by_key(|file| file.file_name());
    let mut text = String::new();
    for file in files {
        let said = std::fs::read(file.path()).unwrap_or_default();
        let said = String::from_utf8_lossy(&said);
        let lines: Vec<&str> = said.lines().collect();
        let end = lines[lines.len().saturating_sub(SHOWN)..].join("\n    ");
        text.push_str(&format!("{}:\n    {end}\n", file.path().display()));
    }
    text
}
