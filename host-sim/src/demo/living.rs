//! A cell that goes on until it is ended, with its pages in a browser: `host-sim demo --console`.
//!
//! Controller and gateway are processes of their own, as on a cell's PC, with the command lines that a person would
//! use; they are printed. The devices are threads of this process.

use std::fs;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use recipe_io::random::random;
use recipe_runtime::Signals;
use recipe_runtime::out::print_stderr;
use serde_json::Value;

use super::folder::TempFolder;

/// Runs the cell until a signal comes or a process ends; the pages are served at this address and the next port.
pub fn run_living(gateway: SocketAddr) -> ExitCode {
    match live(gateway) {
        Ok(code) => code,
        Err(error) => {
            print_stderr(format_args!("the cell cannot run: {error}"));
            ExitCode::FAILURE
        }
    }
}

fn live(address: SocketAddr) -> io::Result<ExitCode> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let mut signals = {
        let _inside = runtime.enter();
        Signals::catch()?
    };
    let folder = TempFolder::new()?;
    let key = write_files(&folder)?;
    // Whatever comes first ends the cell.
    let (ended, end) = mpsc::channel();
    let on_signal = ended.clone();
    thread::Builder::new().name("signals".to_owned()).spawn(move || {
        let _ = on_signal.send(DemoEnd::Signal(runtime.block_on(signals.next())));
    })?;

    let (address, next) = two_ports(address)?;
    let peers = (address, next.port());
    let mut robot = Process::start(
        &folder,
        &controller_arguments(&folder, (next, address.port())),
        "controller",
        &ended,
    )?;
    let mut gateway =
        Process::start(&folder, &gateway_arguments(&folder, peers, &robot.ready)?, "gateway", &ended)?;
    start_devices(&folder, &gateway.ready)?;

    let place = |ready: &Value| ready["console"].as_str().unwrap_or("").to_owned();
    // If nobody reads it, the cell goes on all the same.
    let _ = write!(
        io::stdout(),
        "A living cell: a force sensor, a hand and a panel, a gateway, a simulated controller.\n\n  \
         gateway      http://{}/\n  \
         controller   http://{}/    the pendant: press buttons, move switches\n  \
         key          {key}    for changes; made for this run\n\n\
         The panel presses start after a second, and the robot waves. The files are in\n\
         {} until this ends. Ctrl-C ends it.\n",
        place(&gateway.ready),
        place(&robot.ready),
        folder.path("").display(),
    );

    let what = end.recv().unwrap_or(DemoEnd::Signal(0));
    gateway.end();
    robot.end();
    Ok(match what {
        DemoEnd::Signal(number) => ExitCode::from(u8::try_from(128 + number).unwrap_or(1)),
        DemoEnd::Process(name) => {
            print_stderr(format_args!("the {name} has ended"));
            ExitCode::FAILURE
        }
    })
}

/// Two ports beside one another, or any two: each console has to know the other's before it starts.
fn two_ports(address: SocketAddr) -> io::Result<(SocketAddr, SocketAddr)> {
    if let Some(next) = address.port().checked_add(1).filter(|next| *next > 1) {
        return Ok((address, SocketAddr::new(address.ip(), next)));
    }
    // Both at once, or they would be the same.
    let (one, other) = (TcpListener::bind(address)?, TcpListener::bind((address.ip(), 0))?);
    Ok((one.local_addr()?, other.local_addr()?))
}

/// Why the cell ends.
enum DemoEnd {
    /// A signal with this number.
    Signal(i32),
    /// A process that should go on.
    Process(&'static str),
}

/// Writes the files of the cell; returns the key.
fn write_files(folder: &TempFolder) -> io::Result<String> {
    let key: String = random::<16>()?.iter().map(|byte| format!("{byte:02x}")).collect();
    fs::write(folder.path("robot.toml"), include_str!("living/robot.toml"))?;
    fs::write(folder.path("cell.toml"), include_str!("living/cell.toml"))?;
    let mut file =
        fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(folder.path("key"))?;
    writeln!(file, "{key}")?;
    Ok(key)
}

fn controller_arguments(folder: &TempFolder, console: (SocketAddr, u16)) -> Vec<String> {
    let mut arguments = vec!["controller".to_owned(), "-c".to_owned(), text(folder, "robot.toml")];
    for server in ["command", "state", "modbus", "udp2011"] {
        arguments.extend(["--set".to_owned(), format!("listen.{server}=0")]);
    }
    arguments.extend(console_arguments(folder, console));
    arguments
}

fn gateway_arguments(
    folder: &TempFolder,
    console: (SocketAddr, u16),
    robot: &Value,
) -> io::Result<Vec<String>> {
    let mut arguments = vec!["gateway".to_owned(), "-c".to_owned(), text(folder, "cell.toml")];
    for server in ["command", "state", "modbus", "udp2011"] {
        let address: Option<SocketAddr> = robot[server].as_str().and_then(|address| address.parse().ok());
        let port = address.ok_or_else(|| io::Error::other(format!("the controller has no {server}")))?.port();
        arguments.extend(["--set".to_owned(), format!("controller.ports.{server}={port}")]);
    }
    for (port, device) in [
        ("force", format!("pty:{}", text(folder, "force"))),
        ("hand", "slcan-tcp:127.0.0.1:0".to_owned()),
        ("panel", format!("pty:{}", text(folder, "panel"))),
    ] {
        arguments.extend(["--bind".to_owned(), format!("{port}={device}")]);
    }
    arguments.extend(console_arguments(folder, console));
    arguments.extend(["--console-state".to_owned(), text(folder, "revisions")]);
    Ok(arguments)
}

/// The address of its own console, and the port of the other one.
fn console_arguments(folder: &TempFolder, (address, peer): (SocketAddr, u16)) -> Vec<String> {
    let arguments = [
        ["--console".to_owned(), address.to_string()],
        ["--console-key".to_owned(), text(folder, "key")],
        ["--console-peer".to_owned(), peer.to_string()],
    ];
    arguments.concat()
}

fn text(folder: &TempFolder, name: &str) -> String {
    folder.path(name).display().to_string()
}

/// A running part of the cell.
struct Process {
    child: Child,
    ready: Value,
}

impl Process {
    /// Starts one and waits until it is ready.
    fn start(
        folder: &TempFolder,
        arguments: &[String],
        name: &'static str,
        ended: &mpsc::Sender<DemoEnd>,
    ) -> io::Result<Self> {
        let program = std::env::current_exe()?;
        let mut child = folder.fill(|| {
            Command::new(program).args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).spawn()
        })?;
        let stdout = child.stdout.take().ok_or_else(|| io::Error::other("no stdout"))?;
        let mut lines = BufReader::new(stdout).lines();
        let ready = loop {
            match lines.next().transpose()? {
                Some(line) => {
                    if let Some(json) = line.strip_prefix("ready ") {
                        break serde_json::from_str(json).map_err(io::Error::other)?;
                    }
                }
                None => {
                    let _ = child.wait();
                    return Err(io::Error::other(format!("the {name} did not start")));
                }
            }
        };
        let ended = ended.clone();
        // The end of its output is the end of the process.
        thread::Builder::new().name(name.to_owned()).spawn(move || {
            for _ in lines {}
            let _ = ended.send(DemoEnd::Process(name));
        })?;
        Ok(Self { child, ready })
    }

    /// Asks it to end, and waits for that.
    fn end(&mut self) {
        let id = rustix::process::Pid::from_child(&self.child);
        let _ = rustix::process::kill_process(id, rustix::process::Signal::TERM);
        let _ = self.child.wait();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if !matches!(self.child.try_wait(), Ok(Some(_))) {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// Starts the devices: threads that end with the process. A device whose line is gone, as while another
/// configuration is started, opens it again.
fn start_devices(folder: &TempFolder, ready: &Value) -> io::Result<()> {
    let (force, panel) = (folder.path("force"), folder.path("panel"));
    let hand = ready["ports"]["hand"].as_str().unwrap_or("").to_owned();
    device("force sensor", move || force_sensor(&force))?;
    device("panel", move || panel_of_buttons(&panel))?;
    device("hand", move || hand_on_can(&hand))
}

fn device(name: &str, run: impl Fn() -> io::Result<()> + Send + 'static) -> io::Result<()> {
    let thread = thread::Builder::new().name(name.to_owned());
    thread.spawn(move || {
        loop {
            let _ = run();
            thread::sleep(Duration::from_millis(200));
        }
    })?;
    Ok(())
}

/// Forces that swing, 125 times a second.
fn force_sensor(path: &Path) -> io::Result<()> {
    let mut line = fs::OpenOptions::new().read(true).write(true).open(path)?;
    let began = Instant::now();
    let mut ticks = Ticks::new(Duration::from_millis(8));
    loop {
        let at = began.elapsed().as_secs_f32();
        let mut frame = vec![0x48, 0xAA];
        for axis in 0..6_u8 {
            let size = if axis < 3 { 12.0 } else { 1.5 };
            frame.extend((size * (at * (0.4 + 0.3 * f32::from(axis))).sin()).to_le_bytes());
        }
        frame.extend([0x0D, 0x0A]);
        line.write_all(&frame)?;
        ticks.wait();
    }
}

/// A panel whose start button is pressed once, a second after it was switched on, and whose knob is turned.
fn panel_of_buttons(path: &Path) -> io::Result<()> {
    let mut line = fs::OpenOptions::new().read(true).write(true).open(path)?;
    let began = Instant::now();
    let mut ticks = Ticks::new(Duration::from_millis(50));
    loop {
        let at = began.elapsed();
        let is_pressed = (Duration::from_secs(1)..Duration::from_secs(2)).contains(&at);
        let knob = (100.0 + 90.0 * (at.as_secs_f32() * 0.2).sin()) as u8;
        line.write_all(&[0xFF, 0xFF, u8::from(is_pressed), knob, 0xEE, 0xEE])?;
        ticks.wait();
    }
}

/// A hand that moves to its target, and reports state, position and grip.
fn hand_on_can(address: &str) -> io::Result<()> {
    let mut line = TcpStream::connect(address)?;
    line.set_nodelay(true)?;
    line.set_read_timeout(Some(Duration::from_millis(20)))?;
    line.write_all(b"C\rS6\rO\r")?;
    let (mut received, mut chunk) = (Vec::new(), [0; 256]);
    let (mut target, mut position) = (0_u8, 0_u8);
    let mut ticks = Ticks::new(Duration::from_millis(20));
    loop {
        match line.read(&mut chunk) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(count) => received.extend_from_slice(&chunk[..count]),
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {}
            Err(error) => return Err(error),
        }
        while let Some(end) = received.iter().position(|&byte| byte == b'\r' || byte == 7) {
            let one: Vec<u8> = received.drain(..=end).collect();
            if let Some(data) = std::str::from_utf8(&one).ok().and_then(|text| text.strip_prefix("t5011"))
                && let Some(value) = data.get(..2).and_then(|digits| u8::from_str_radix(digits, 16).ok())
            {
                target = value;
            }
        }
        position = if position < target {
            position.saturating_add(4).min(target)
        } else {
            position.saturating_sub(4).max(target)
        };
        let state = u8::from(position != target) + 1;
        let grip = u16::from(position) * 3;
        let [low, high] = grip.to_le_bytes();
        line.write_all(format!("t5024{state:02X}{position:02X}{low:02X}{high:02X}\r").as_bytes())?;
        ticks.wait();
    }
}

/// A period that does not drift.
struct Ticks {
    next: Instant,
    period: Duration,
}

impl Ticks {
    fn new(period: Duration) -> Self {
        Self { next: Instant::now() + period, period }
    }

    fn wait(&mut self) {
        thread::sleep(self.next.saturating_duration_since(Instant::now()));
        self.next = (self.next + self.period).max(Instant::now());
    }
}
