//! The firmware in QEMU when something goes wrong: watchdog, exit codes, and the log before.
//!
//! They need QEMU (`apt-get install qemu-system-arm`), the firmware for `mps2-an500` and `host-sim`:
//! `FIRMWARE_ELF=... HOST_SIM=target/debug/host-sim cargo test -p firmware --test machine -- --ignored`

use std::io::{BufRead, BufReader, Read, Write};
use std::net::UdpSocket;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use embassy_futures::block_on;
use recipe_store::{Flash, FlashWord, Geometry, Marks, Store, Trial, TrialEnd, WORD, Word};
use recipe_test_kit::{qemu, until};

/// A running machine, with the lines of its log.
struct QemuMachine {
    qemu: Child,
    lines: Receiver<String>,
    log: String,
    /// Folder of the socket of QEMU's monitor.
    monitor: tempfile::TempDir,
}

impl QemuMachine {
    /// Starts it with an image (or the name of a missing file), a fault to inject, and more options.
    fn start(image: &Path, fault: &str, options: &[&str]) -> Self {
        Self::start_with(&format!("arg={},arg={fault}", image.display()), options)
    }

    /// Starts it with the file of its store.
    fn with_store(image: &Path, store: &Path) -> Self {
        Self::start_with(
            &format!("arg={},arg=none,arg={}", image.display(), store.display()),
            &["-nic", "user"],
        )
    }

    fn start_with(arguments: &str, options: &[&str]) -> Self {
        Self::start_on(&["-serial", "null"], arguments, options)
    }

    /// The same, with this device on the CAN bus.
    fn start_on(bus: &[&str], arguments: &str, options: &[&str]) -> Self {
        let arguments = format!("enable=on,target=native,arg=firmware,{arguments}");
        let monitor = tempfile::tempdir().unwrap();
        let socket = format!("unix:{}/socket,server=on,wait=off", monitor.path().display());
        let mut qemu = Command::new("qemu-system-arm")
            .args("-M mps2-an500 -display none".split(' '))
            .args(["-monitor", &socket])
            .args("-serial null -serial null".split(' '))
            .args(bus)
            .args(["-serial", "stdio"])
            .args(["-semihosting-config", &arguments, "-kernel"])
            .arg(variable("FIRMWARE_ELF"))
            .args(options)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("qemu-system-arm runs");
        let output = BufReader::new(qemu.stdout.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in output.lines() {
                if line.is_err() || sender.send(line.unwrap_or_default()).is_err() {
                    return;
                }
            }
        });
        Self { qemu, lines, log: String::new(), monitor }
    }

    /// Waits for a line with this text.
    #[track_caller]
    fn until(&mut self, text: &str) {
        let limit = Instant::now() + PATIENCE;
        while let Ok(line) = self.lines.recv_timeout(limit.saturating_duration_since(Instant::now())) {
            self.log += &line;
            self.log.push('\n');
            if line.contains(text) {
                return;
            }
        }
        panic!("{text:?} was never said:\n{}", self.log);
    }

    /// Waits until the machine has ended; returns its whole log.
    #[track_caller]
    fn end(mut self) -> (ExitStatus, String) {
        let limit = Instant::now() + PATIENCE;
        loop {
            match self.lines.recv_timeout(limit.saturating_duration_since(Instant::now())) {
                Ok(line) => self.log += &(line + "\n"),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => panic!("it does not end:\n{}", self.log),
            }
        }
        let log = std::mem::take(&mut self.log);
        (self.qemu.wait().unwrap(), log)
    }

    /// Polls the word at an address through QEMU's monitor until it has had all these values.
    fn until_seen(&self, address: u32, values: &[u32]) {
        let mut monitor = UnixStream::connect(self.monitor.path().join("socket")).unwrap();
        monitor.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut answers = BufReader::new(monitor.try_clone().unwrap());
        let mut missing = values.to_vec();
        let limit = Instant::now() + PATIENCE;
        while !missing.is_empty() {
            assert!(Instant::now() < limit, "{missing:08X?} never stood at {address:08X}");
            writeln!(monitor, "xp /1wx {address}").unwrap();
            let mut line = String::new();
            // Skips the echo and the prompt.
            while !line.starts_with("00000000") {
                line.clear();
                assert_ne!(answers.read_line(&mut line).unwrap(), 0, "QEMU ended");
            }
            let value =
                line.trim().rsplit_once("0x").and_then(|(_, digits)| u32::from_str_radix(digits, 16).ok());
            missing.retain(|wanted| Some(*wanted) != value);
        }
    }

    /// Lets a machine run that was started with `-S`.
    fn go_on(&self) {
        let mut monitor =
            until("QEMU's monitor", || UnixStream::connect(self.monitor.path().join("socket")).ok());
        monitor.set_read_timeout(Some(PATIENCE)).unwrap();
        writeln!(monitor, "cont").unwrap();
        // What QEMU has not read yet is lost with the connection. It asks for a command at the start, and again.
        let (mut said, mut byte) = (Vec::new(), [0]);
        while said.windows(6).filter(|words| words == b"(qemu)").count() < 2 {
            monitor.read_exact(&mut byte).expect("the monitor answers");
            said.push(byte[0]);
        }
    }

    /// Collects the log for `time`; returns all of it.
    fn listen(&mut self, time: Duration) -> &str {
        let limit = Instant::now() + time;
        while let Ok(line) = self.lines.recv_timeout(limit.saturating_duration_since(Instant::now())) {
            self.log += &(line + "\n");
        }
        &self.log
    }
}

impl Drop for QemuMachine {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

fn variable(name: &str) -> PathBuf {
    let value =
        std::env::var_os(name).unwrap_or_else(|| panic!("{name} is not set; see the top of this file"));
    // Relative to the workspace: Cargo runs tests in the package's folder.
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(value)
}

/// The image of one of the example files.
fn image(folder: &tempfile::TempDir, example: &str, sets: &[&str]) -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let image = folder.path().join("cell.img");
    let mut command = Command::new(variable("HOST_SIM"));
    command.arg("image").arg(root.join("host-sim/configs").join(example)).arg("-o").arg(&image);
    for set in sets {
        command.args(["--set", set]);
    }
    assert!(command.stdout(Stdio::null()).status().unwrap().success());
    image
}

/// The Ethernet cable to the machine: each datagram is a frame.
struct Cable {
    socket: UdpSocket,
    machine: u16,
}

impl Cable {
    /// Two free ports, one for each end.
    fn new() -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        let machine = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        Self { socket, machine }
    }

    fn option(&self) -> String {
        let ours = self.socket.local_addr().unwrap();
        format!("socket,udp={ours},localaddr=127.0.0.1:{}", self.machine)
    }

    fn receive(&self) -> Vec<u8> {
        let mut frame = vec![0; 2048];
        let len = self.socket.recv(&mut frame).expect("the machine sends something");
        frame.truncate(len);
        frame
    }

    /// Answers the sender of `frame`.
    fn answer(&self, frame: &[u8], kind: [u8; 2], payload: &[u8]) {
        let whole = [&frame[6..12], &CABLE_END, &kind, payload].concat();
        self.socket.send_to(&whole, ("127.0.0.1", self.machine)).unwrap();
    }

    /// Answers an ARP request: every address is at this end.
    fn answer_arp(&self, frame: &[u8]) {
        let (sender, asked) = (&frame[22..32], &frame[38..42]);
        self.answer(frame, [8, 6], &[&[0, 1, 8, 0, 6, 4, 0, 2][..], &CABLE_END, asked, sender].concat());
    }

    /// Answers a DNS query with this address.
    fn answer_dns(&self, frame: &[u8], address: [u8; 4]) {
        let (ip, udp) = (&frame[14..34], &frame[34..]);
        let question = &udp[8..usize::from(u16::from_be_bytes([udp[4], udp[5]]))];
        let record = [&[0xC0, 12, 0, 1, 0, 1, 0, 0, 0, 60, 0, 4], &address[..]].concat();
        let dns = [&question[..2], &[0x81, 0x80, 0, 1, 0, 1, 0, 0, 0, 0], &question[12..], &record].concat();
        let length = (dns.len() as u16 + 8).to_be_bytes();
        // Without a checksum, as UDP over IPv4 may be.
        let udp = [&udp[2..4], &udp[..2], &length, &[0, 0], &dns].concat();
        let mut ip = [
            &[0x45, 0],
            &(udp.len() as u16 + 20).to_be_bytes(),
            &[0, 0, 0, 0, 64, 17, 0, 0][..],
            &ip[16..20],
            &ip[12..16],
        ]
        .concat();
        let sum: u32 = ip.chunks(2).map(|word| u32::from(u16::from_be_bytes([word[0], word[1]]))).sum();
        let sum = !((sum & 0xFFFF) + (sum >> 16)) as u16;
        ip[10..12].copy_from_slice(&sum.to_be_bytes());
        self.answer(frame, [8, 0], &[ip, udp].concat());
    }
}

fn nothing() -> &'static Path {
    Path::new("/nowhere/cell.img")
}

#[track_caller]
fn assert_said(log: &str, words: &[&str]) {
    let mut rest = log;
    for text in words {
        let Some(at) = rest.find(text) else { panic!("{text:?} was not said, or too early:\n{log}") };
        rest = &rest[at + text.len()..];
    }
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_task_that_hangs_is_named_and_then_the_machine_is_reset() {
    let (status, log) = QemuMachine::start(nothing(), "stall", &["-no-reboot"]).end();
    assert_said(
        &log,
        &[
            "nothing runs",
            &format!("task {FAULTY_TASK} does not respond"),
            "the watchdog was not fed",
            "no task was running",
        ],
    );
    // QEMU ends instead of resetting.
    assert_eq!(status.code(), Some(0));
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_task_that_keeps_the_processor_is_named_and_after_the_reset_all_begins_again() {
    let mut machine = QemuMachine::start(nothing(), "spin", &[]);
    machine.until("recipe gateway");
    machine.until("the watchdog was not fed");
    machine.until(&format!("task {FAULTY_TASK} was running"));
    machine.until("recipe gateway");
    machine.until("nothing runs");
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn the_led_blinks_when_nothing_runs() {
    let mut machine = QemuMachine::start(nothing(), "none", &["-nic", "user"]);
    machine.until("nothing runs");
    for _ in 0..3 {
        machine.until_seen(FPGAIO_LED, &[0, 1]);
    }
}

/// The board uses the address of its file, asks the file's name server for the controller, and connects to the
/// answer.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn with_an_address_of_its_own_the_board_finds_the_controller_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let sets = ["controller.address=robot.cell", "network.address=10.9.0.2/24", "network.dns=10.9.0.1"];
    let image = image(&folder, "rs485-system.toml", &sets);
    let cable = Cable::new();
    let mut machine = QemuMachine::start(&image, "none", &["-nic", &cable.option()]);
    machine.until("address 10.9.0.2/24");
    let mut asked = 0;
    loop {
        let frame = cable.receive();
        match frame.get(12..14) {
            Some([8, 6]) => cable.answer_arp(&frame),
            Some([8, 0]) if frame[23] == UDP && frame[36..38] == [0, 53] => {
                assert_eq!((&frame[26..30], &frame[30..34]), (&[10, 9, 0, 2][..], &[10, 9, 0, 1][..]));
                assert_eq!(&frame[54..66], b"\x05robot\x04cell\0");
                cable.answer_dns(&frame, [10, 9, 0, 9]);
                asked += 1;
            }
            Some([8, 0]) if frame[23] == TCP => {
                assert_eq!(frame[30..34], [10, 9, 0, 9], "the address that the name has");
                break;
            }
            _ => {}
        }
    }
    assert!(asked > 0);
}

/// A client that opens the bus while the board has no power yet. QEMU keeps its bytes, and the board asks for them.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn what_came_on_a_line_before_the_start_is_taken_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let image = image(&folder, "can-hand.toml", &["controller.address=10.0.2.2"]);
    let path = folder.path().join("can");
    let bus = qemu::line("can", &path);
    let arguments = format!("arg={},arg=none", image.display());
    let options = [&qemu::MACHINE[..], &["-S", "-nic", "user"]].concat();
    let mut machine = QemuMachine::start_on(&bus.each_ref().map(String::as_str), &arguments, &options);
    let mut client = until("QEMU's socket", || UnixStream::connect(&path).ok());
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    client.write_all(b"O\r").unwrap();
    machine.go_on();
    machine.until("configuration: ");
    let mut answer = [0];
    client.read_exact(&mut answer).expect("the bus is opened");
    assert_eq!(answer, *b"\r");
}

/// For longer than the watchdog's period, while links to a missing controller are retried.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_run_without_trouble_never_starves_the_watchdog() {
    let folder = tempfile::tempdir().unwrap();
    let image = image(&folder, "force-sensor.toml", &["controller.address=10.0.2.2"]);
    let mut machine = QemuMachine::start(&image, "none", &["-nic", "user"]);
    machine.until("address 10.0.2.15");
    let log = machine.listen(Duration::from_secs(12));
    assert_eq!(log.matches("recipe gateway").count(), 1, "{log}");
    assert!(!log.contains("watchdog") && !log.contains("panicked"), "{log}");
    // The bound computed from the machine code (.ci/stack), if given.
    if let Ok(bound) = std::env::var("FIRMWARE_STACK") {
        let used = log.split_once("stack: ").and_then(|(_, rest)| rest.split_once(' ')).unwrap().0;
        assert!(used.parse::<u32>().unwrap() <= bound.parse().unwrap(), "{used} of {bound} bytes");
    }
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_panic_says_where_and_ends_with_101() {
    let (status, log) = QemuMachine::start(nothing(), "panic", &[]).end();
    assert_said(&log, &["panicked at", "as asked", &format!("task {FAULTY_TASK} was running")]);
    assert_eq!(status.code(), Some(101));
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_stack_overflow_and_a_read_of_nothing_fault_and_end_with_102() {
    for fault in ["overflow", "fault"] {
        let (status, log) = QemuMachine::start(nothing(), fault, &[]).end();
        assert_said(&log, &["hard fault", &format!("task {FAULTY_TASK} was running")]);
        assert!(!log.contains("panicked"), "{log}");
        assert_eq!(status.code(), Some(102), "{fault}");
    }
}

/// Flash of three sectors of 128 KiB, as the file of the store.
struct MappedStore(PathBuf, Vec<u8>);

const STORE_SECTOR: usize = 128 * 1024;

impl MappedStore {
    fn offset(place: FlashWord) -> usize {
        usize::from(place.sector) * STORE_SECTOR + usize::from(place.word) * WORD
    }

    fn read(path: &Path) -> Self {
        let mut bytes = std::fs::read(path).unwrap();
        bytes.resize(2 * STORE_SECTOR, 0xFF);
        Self(path.into(), bytes)
    }

    fn save(&self) {
        std::fs::write(&self.0, &self.1).unwrap();
    }
}

impl Flash for MappedStore {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 2, words: (STORE_SECTOR / WORD) as u16 }
    }

    fn read(&self, place: FlashWord) -> Word {
        *self.1[Self::offset(place)..].first_chunk().unwrap()
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.1[Self::offset(place)..][..WORD].copy_from_slice(word);
    }

    async fn erase(&mut self, sector: u8) {
        self.1[usize::from(sector) * STORE_SECTOR..][..STORE_SECTOR].fill(0xFF);
    }
}

/// The image is taken over, runs without its file, and gives way to another one on trial, which nobody confirms.
#[test]
#[ignore = "needs QEMU and the firmware"]
fn the_store_keeps_what_runs_and_a_trial_ends() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cell.store");
    let image = image(&folder, "force-sensor.toml", &["controller.address=10.0.2.2"]);
    let taken_over = "the store has taken over the configuration";
    QemuMachine::with_store(&image, &path).until(taken_over);
    QemuMachine::with_store(nothing(), &path).until("configuration 1 of the store, the live one");

    let mut file = MappedStore::read(&path);
    let mut store = Store::mount(&file).unwrap();
    let bytes = std::fs::read(&image).unwrap();
    let [live] = store.revisions()[..] else { panic!("one is kept") };
    assert_eq!((live.number, live.len), (1, bytes.len()));
    block_on(store.keep(2, 2, &bytes, None).unwrap().execute(&mut file)).unwrap();
    let trial = Some(Trial { number: 2, attempts: 3, confirm_s: 1 });
    let marks = Marks { live: Some(1), trial, ..Marks::default() };
    block_on(store.mark(marks).unwrap().execute(&mut file)).unwrap();
    file.save();
    let mut machine = QemuMachine::with_store(nothing(), &path);
    machine.until("configuration 2 of the store, on trial for 1 s");
    machine.until("was not confirmed in time");
    // By a restart of its own.
    machine.until("the last trial was of configuration 2: nobody confirmed it in time");
    machine.until("configuration 1 of the store, the live one");
    drop(machine);
    assert_eq!(
        Store::mount(&MappedStore::read(&path)).unwrap().marks(),
        Marks { trial: None, last: Some((2, TrialEnd::NotConfirmed)), ..marks }
    );
}

/// The task with the injected fault.
const FAULTY_TASK: &str = "board 0";
/// IP protocols.
const TCP: u8 = 6;
const UDP: u8 = 17;
/// The Ethernet address of the test's end.
const CABLE_END: [u8; 6] = [2, 0x11, 0x22, 0x33, 0x44, 0x66];
/// The register of the machine's LEDs.
const FPGAIO_LED: u32 = 0x4002_8000;
/// Limit of every wait.
const PATIENCE: Duration = Duration::from_secs(120);
