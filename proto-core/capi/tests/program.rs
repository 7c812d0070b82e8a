//! The gateway in C (examples/gateway.c) against the simulated controller in another process: a device
//! sends a frame, the controller switches an output, and its pose comes back. Then the program ends by
//! itself and prints its counters.
//!
//! `.ci/run capi` builds the programs and runs these tests; alone:
//! `HOST_SIM=target/debug/host-sim CAPI_HOST=... CAPI_CORTEX_M7=... cargo test -p recipe-capi -- --ignored`

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(60);

#[test]
#[ignore = "needs the program, valgrind and host-sim"]
fn on_this_host_under_valgrind() {
    let controller = Controller::start();
    let device = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let program = Command::new("valgrind")
        .args(
            "-q --error-exitcode=99 --leak-check=full --show-leak-kinds=all --errors-for-leak-kinds=all"
                .split(' '),
        )
        .arg(variable("CAPI_HOST"))
        .arg(controller.image())
        .arg(device.local_addr().unwrap().port().to_string())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("valgrind runs");
    let mut program = Running(program);
    a_device_works_through_it(accept(&device));
    drop(program.0.stdin.take());
    let mut said = String::new();
    program.0.stdout.take().unwrap().read_to_string(&mut said).unwrap();
    let ended = program.0.wait().unwrap();
    assert_eq!(ended.code(), Some(0), "valgrind found something, or the program failed:\n{said}");
    it_counted(&said);
}

#[test]
#[ignore = "needs the program, QEMU and host-sim"]
fn on_a_cortex_m7_in_qemu() {
    let controller = Controller::start();
    let device = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let console = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let mut qemu = Command::new("qemu-system-arm");
    qemu.args("-M mps2-an500 -display none -monitor none".split(' '));
    qemu.args(["-semihosting-config", "enable=on,target=native"]);
    let port = |listener: &TcpListener| listener.local_addr().unwrap().port();
    // UARTs: device, commands, state, Modbus, console.
    let uarts = [port(&device), controller.command, controller.state, controller.modbus, port(&console)];
    for (uart, port) in uarts.into_iter().enumerate() {
        let chardev = format!("socket,id=u{uart},host=127.0.0.1,port={port},nodelay=on");
        qemu.args(["-chardev", &chardev, "-serial", &format!("chardev:u{uart}")]);
    }
    let qemu = qemu.arg("-kernel").arg(variable("CAPI_CORTEX_M7")).spawn().expect("QEMU runs");
    let mut qemu = Running(qemu);
    let mut console = accept(&console);
    a_device_works_through_it(accept(&device));
    console.write_all(b"q").unwrap();
    let mut said = String::new();
    console.read_to_string(&mut said).unwrap();
    assert_eq!(qemu.0.wait().unwrap().code(), Some(0), "the program failed:\n{said}");
    it_counted(&said);
}

/// A device switches DO1 and waits until it is shown, with the pose.
#[track_caller]
fn a_device_works_through_it(mut line: TcpStream) {
    let shown =
        [&[0xFF, 0xFF, 0x01], &(-0.5_f32).to_le_bytes()[..], &0.25_f32.to_le_bytes(), &[0xFE, 0xFE]].concat();
    line.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let (mut received, mut chunk) = (Vec::new(), [0; 256]);
    let limit = Instant::now() + PATIENCE;
    while !received.windows(shown.len()).any(|frame| frame == shown) {
        assert!(Instant::now() < limit, "never shown; received {:02X?}", received.last_chunk::<64>());
        line.write_all(&[0xFF, 0xFF, 0x01, 0xEE, 0xEE]).unwrap();
        received.extend_from_slice(line.read(&mut chunk).map_or(&[], |len| &chunk[..len]));
    }
}

/// Checks the counters that it prints at its end.
#[track_caller]
fn it_counted(said: &str) {
    let numbers = |what: &str| -> Vec<u32> {
        let lines = said.lines().filter_map(|line| line.strip_prefix(what)?.trim().parse().ok());
        lines.collect()
    };
    assert!(matches!(numbers("frames in ")[..], [(1..)]), "{said}");
    assert!(matches!(numbers("frames out ")[..], [(1..)]), "{said}");
    assert_eq!(numbers("link "), [1, 2], "state and Modbus:\n{said}");
    // On a busy machine a connection may be lost and opened again.
    assert!(numbers("connects ").iter().all(|&connects| connects > 0), "{said}");
    assert!(numbers("answers ").iter().all(|&answers| answers > 0), "{said}");
    assert_eq!(numbers("sleeps ").len(), 1, "{said}");
}

/// A process that ends with its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The simulated controller, and where it listens.
struct Controller {
    folder: tempfile::TempDir,
    command: u16,
    state: u16,
    modbus: u16,
    _process: Running,
}

impl Controller {
    fn start() -> Self {
        let mut process = Command::new(variable("HOST_SIM"))
            .args(["controller", "-c"])
            .arg(example("controller.toml"))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("host-sim runs");
        let mut ready = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut ready).unwrap();
        let port = |of: &str| {
            let behind = ready.split(&format!("\"{of}\":\"127.0.0.1:")).nth(1);
            let digits = behind.and_then(|rest| rest.split('"').next());
            digits.and_then(|digits| digits.parse().ok()).unwrap_or_else(|| panic!("no {of}: {ready}"))
        };
        let folder = tempfile::tempdir().unwrap();
        let (command, state, modbus) = (port("command"), port("state"), port("modbus"));
        Self { folder, command, state, modbus, _process: Running(process) }
    }

    /// An image whose links go to this controller.
    fn image(&self) -> PathBuf {
        let image = self.folder.path().join("cell.img");
        let key = |key: &str, port: u16| format!("controller.ports.{key}={port}");
        let made = Command::new(variable("HOST_SIM"))
            .arg("image")
            .arg(example("cell.toml"))
            .args(["--set", &key("state", self.state), "--set", &key("modbus", self.modbus), "-o"])
            .arg(&image)
            .status();
        assert!(made.unwrap().success());
        image
    }
}

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples").join(name)
}

fn accept(listener: &TcpListener) -> TcpStream {
    listener.set_nonblocking(true).unwrap();
    let limit = Instant::now() + PATIENCE;
    loop {
        match listener.accept() {
            Ok((stream, _)) => {
                stream.set_nonblocking(false).unwrap();
                stream.set_nodelay(true).unwrap();
                stream.set_read_timeout(Some(PATIENCE)).unwrap();
                return stream;
            }
            Err(_) => assert!(Instant::now() < limit, "the program never connected"),
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The path in an environment variable, absolute or relative to the repository's root.
fn variable(name: &str) -> PathBuf {
    let value = std::env::var_os(name).unwrap_or_else(|| panic!("{name} is not set"));
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(value)
}
