//! Programs on a bus: ours, and the can-utils around them.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Longest wait for anything, far above what a busy machine needs.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// Looks again and again until there is something.
#[track_caller]
pub(crate) fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "not within {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Runs a tool to its end; it must succeed.
#[track_caller]
pub(crate) fn tool(command: &str) -> String {
    let mut words = command.split_whitespace();
    let name = words.next().unwrap();
    let output = Command::new(name).args(words).stdin(Stdio::null()).output();
    let output = output.unwrap_or_else(|error| panic!("{name}: {error}; Debian: can-utils, iproute2"));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command}: {}: {errors}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// Puts a frame on the bus, as `001#0102`.
#[track_caller]
pub(crate) fn cansend(interface: &str, frame: &str) {
    tool(&format!("cansend {interface} {frame}"));
}

/// An example file.
pub(crate) fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name)
}

/// A program that runs until it is dropped, and what it says line by line.
struct Background {
    child: Child,
    lines: Lines,
    errors: Lines,
}

type Lines = Arc<Mutex<Vec<String>>>;

impl Background {
    #[track_caller]
    fn start(command: &mut Command) -> Self {
        let command = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let child = command.spawn();
        let mut child = child.unwrap_or_else(|error| panic!("{command:?}: {error}"));
        let lines = collect(child.stdout.take().unwrap(), |_| {});
        // Also shown: it may say why a test fails.
        let errors = collect(child.stderr.take().unwrap(), |line| eprintln!("{line}"));
        Self { child, lines, errors }
    }

    fn lines(&self) -> Vec<String> {
        self.lines.lock().unwrap().clone()
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What comes, line by line, until the end.
fn collect(from: impl Read + Send + 'static, show: fn(&str)) -> Lines {
    let lines = Lines::default();
    let sink = Arc::clone(&lines);
    std::thread::spawn(move || {
        for line in BufReader::new(from).lines().map_while(Result::ok) {
            show(&line);
            sink.lock().unwrap().push(line);
        }
    });
    lines
}

/// A running `host-sim`.
pub(crate) struct Running {
    program: Background,
    pub(crate) ready: Value,
}

impl Running {
    /// A simulated controller on free ports.
    #[track_caller]
    pub(crate) fn controller(file: &Path, extra: &[&str]) -> Self {
        let free = ["command", "state", "modbus", "udp2011"].map(|port| format!("--set=listen.{port}=0"));
        let free: Vec<&str> = free.iter().map(String::as_str).chain(extra.iter().copied()).collect();
        Self::start("controller", file, &free)
    }

    /// A gateway to that controller; its links are up.
    #[track_caller]
    pub(crate) fn gateway(file: &Path, robot: &Self, extra: &[&str]) -> Self {
        let ports = ["command", "state", "modbus"].map(|name| {
            let place = robot.ready[name].as_str().unwrap();
            format!("--set=controller.ports.{name}={}", place.rsplit_once(':').unwrap().1)
        });
        let all: Vec<&str> = ports.iter().map(String::as_str).chain(extra.iter().copied()).collect();
        let gateway = Self::start("gateway", file, &all);
        gateway.stats("links up", |stats| {
            stats["links"].as_object().is_some_and(|links| links.values().all(|link| link["state"] == "up"))
        });
        gateway
    }

    #[track_caller]
    fn start(what: &str, file: &Path, extra: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
        command.args([what, "--stats", "50ms", "-c"]).arg(file).args(extra);
        let program = Background::start(&mut command);
        let ready = until(&format!("{what}'s ready line"), || {
            program.lines().iter().find_map(|line| Some(line.strip_prefix("ready ")?.to_owned()))
        });
        Self { ready: serde_json::from_str(&ready).unwrap(), program }
    }

    /// The newest statistics, once they satisfy `found`.
    #[track_caller]
    pub(crate) fn stats(&self, what: &str, found: impl Fn(&Value) -> bool) -> Value {
        let mut newest = Value::Null;
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            let line = self.program.lines.lock().unwrap().last().cloned();
            if let Some(stats) = line.and_then(|line| serde_json::from_str(&line).ok()) {
                newest = stats;
                if found(&newest) {
                    return newest;
                }
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("not within {PATIENCE:?}: {what}; the newest: {newest}");
    }

    /// Statistics that were printed after this call.
    #[track_caller]
    pub(crate) fn fresh(&self) -> Value {
        let before = self.program.lines.lock().unwrap().len();
        // The line after the next was begun after the call.
        until("statistics", || (self.program.lines.lock().unwrap().len() >= before + 2).then_some(()));
        self.stats("statistics", |_| true)
    }

    /// The lines of the log so far that have these words.
    pub(crate) fn log(&self, words: &str) -> Vec<String> {
        let errors = self.program.errors.lock().unwrap();
        errors.iter().filter(|line| line.contains(words)).cloned().collect()
    }

    /// One command on port 2000.
    #[track_caller]
    pub(crate) fn command(&self, request: &str, reply: &str) {
        let mut stream = TcpStream::connect(self.ready["command"].as_str().unwrap()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = vec![0; reply.len()];
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(String::from_utf8_lossy(&answer), reply);
    }

    pub(crate) fn signal(&self, signal: &str) {
        tool(&format!("kill -s {signal} {}", self.program.child.id()));
    }

    /// Ends it as a person would; it must end well.
    #[track_caller]
    pub(crate) fn end(mut self) {
        self.signal("INT");
        let code = self.program.child.wait().unwrap().code();
        assert_eq!(code, Some(0), "after Ctrl-C");
    }
}

/// A running `candump -L`.
pub(crate) struct Candump(Background);

impl Candump {
    /// Starts it and waits until it hears the bus.
    #[track_caller]
    pub(crate) fn start(interface: &str) -> Self {
        let mut command = Command::new("stdbuf");
        let dump = Self(Background::start(command.args(["-oL", "candump", "-L", interface])));
        until("candump listens", || {
            cansend(interface, MARK);
            dump.0.lines().iter().any(|line| line.ends_with(MARK)).then_some(())
        });
        dump
    }

    /// The whole log so far, as candump wrote it.
    pub(crate) fn log(&self) -> Vec<String> {
        let lines = self.0.lines();
        lines.into_iter().filter(|line| line.starts_with('(') && !line.ends_with(MARK)).collect()
    }

    /// The frames so far, as `001#0102`.
    pub(crate) fn frames(&self) -> Vec<String> {
        self.log().iter().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
    }

    /// Waits until the frame is on the bus.
    #[track_caller]
    pub(crate) fn wait_for(&self, frame: &str) {
        until(frame, || self.frames().iter().any(|seen| seen == frame).then_some(()));
    }
}

/// An interface that exists for one test.
pub(crate) struct Vcan(pub(crate) &'static str);

impl Vcan {
    /// A virtual one that is up.
    #[track_caller]
    pub(crate) fn new(name: &'static str) -> Self {
        let _ = Command::new("ip").args(["link", "del", name]).stderr(Stdio::null()).status();
        tool(&format!("ip link add {name} type vcan"));
        tool(&format!("ip link set {name} up"));
        Self(name)
    }
}

impl Drop for Vcan {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["link", "del", self.0]).stderr(Stdio::null()).status();
    }
}

/// No recipe has it.
const MARK: &str = "7FE#";
