//! A bus at full load: every frame is accounted for.

use std::time::{Duration, Instant};

use serde_json::Value;
use socketcan::{CanFrame, CanSocket, EmbeddedFrame, Frame, Socket, SocketOptions, StandardId};

use super::BINARY;
use super::{Needs, Test};
use recipe_test_kit::{example, until};

pub(crate) fn trials(interface: &str) -> Vec<Test> {
    let interface = interface.to_owned();
    vec![("a_bus_at_full_load", Needs::Nothing, Box::new(move || full_load(&interface)))]
}

/// Time of a frame of eight bytes and the space after it at 500 kbit/s: 111 bits without stuffing.
const FRAME_NANOS: u64 = 222_000;
/// More than come between two wake-ups of a thread that the system wakes 100 times a second.
const BURST: u64 = 64;

/// Each frame carries its number and is answered with a number.
const GATEWAY: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "load"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 1
fields = [
    { name = "number", type = "dword" },
    { name = "low", type = "word", to = "WordInputReg[1]" },
    { name = "high", type = "word", to = "WordInputReg[2]" },
]
[recipe.output]
send = "frame"
[[recipe.output.frame]]
id = 2
fields = [{ name = "number", type = "dword", from = "counter" }, { name = "rest", type = "dword", value = 7 }]

[[port]]
name = "can-1"
bus = "can"
recipe = "load"
"#;

fn full_load(interface: &str) {
    let seconds = std::env::var("HOST_SIM_LOAD_SECONDS").map_or(2.0, |text| text.parse().expect("seconds"));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("load.toml");
    std::fs::write(&file, GATEWAY).unwrap();
    let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
    let gateway = BINARY.gateway(&file, &robot, &[&format!("--bind=can-1=socketcan:{interface}")]);
    let sender = CanSocket::open(interface).unwrap();
    sender.set_filter_drop_all().unwrap();
    let mut answers = Answers::listen(interface);

    let backlog = dropped_before_sockets();
    let (begin, mut paced) = (Instant::now(), Instant::now());
    let mut sent = 0_u32;
    while begin.elapsed().as_secs_f64() < seconds {
        let due = paced.elapsed().as_nanos() as u64 / FRAME_NANOS;
        paced += Duration::from_nanos(due * FRAME_NANOS);
        // A bus does not catch up after time in which this machine was busy.
        for _ in 0..due.min(BURST) {
            sent += 1;
            sender.write_frame(&numbered(sent)).unwrap();
        }
        answers.take();
        std::thread::sleep(Duration::from_millis(1));
    }

    let number = |value: &Value| value.as_u64().unwrap();
    let stats = gateway.stats("every frame read or lost, answered or overtaken", |stats| {
        let port = &stats["ports"]["can-1"];
        let [read, lost] = ["frames_in", "overruns"].map(|name| number(&port["device"][name]));
        let [answered, overtaken] = ["frames_out", "skipped_cycles"].map(|name| number(&port[name]));
        let backlog = dropped_before_sockets() - backlog;
        read + lost + backlog >= u64::from(sent) && answered + overtaken == read
    });
    let backlog = dropped_before_sockets() - backlog;
    if backlog == 0 && stats["ports"]["can-1"]["device"]["overruns"] == 0 {
        robot.stats("the last frame's number", |stats| {
            stats["registers"]["WordInputReg[1]"].as_f64() == Some(f64::from(sent & 0xFFFF))
        });
    }
    let stats = gateway.fresh();
    let port = &stats["ports"]["can-1"];
    let device = &port["device"];
    let [read, lost, answered] = ["frames_in", "overruns", "frames_out"].map(|name| number(&device[name]));
    until("every answer", || {
        answers.take();
        (u64::from(answers.count) >= answered).then_some(())
    });
    println!(
        "{interface}: {sent} frames in {seconds} s ({:.0} a second); the gateway read {read}, the kernel dropped \
         {lost} at its socket and {backlog} before; {answered} answers, {} received",
        f64::from(sent) / seconds,
        answers.count,
    );
    // The kernel may also have dropped a received answer.
    assert!(read <= u64::from(sent) && read + lost + backlog >= u64::from(sent), "{port}");
    assert_eq!(number(&port["frames_in"]), read, "no frame is lost that the kernel delivered");
    assert_eq!(number(&port["frames_out"]), answered, "{port}");
    assert_eq!(number(&device["dropped"]), 0, "{port}");
    assert_eq!(answered + number(&port["skipped_cycles"]), read, "each is answered or overtaken by the next");
    assert_eq!(u64::from(answers.count), answered, "answers");
    gateway.end();
    robot.end();
}

/// Number of frames and packets that the kernel dropped from a full queue, before sockets could count them.
fn dropped_before_sockets() -> u64 {
    let per_processor = std::fs::read_to_string("/proc/net/softnet_stat").unwrap();
    let dropped = per_processor.lines().filter_map(|line| line.split_whitespace().nth(1));
    dropped.map(|hex| u64::from_str_radix(hex, 16).unwrap()).sum()
}

fn numbered(number: u32) -> CanFrame {
    let bytes = number.to_le_bytes();
    let data: Vec<u8> = bytes.iter().chain(&bytes).copied().collect();
    CanFrame::new(StandardId::new(1).unwrap(), &data).unwrap()
}

/// The gateway's answers, whose numbers must have no gaps.
struct Answers {
    socket: CanSocket,
    count: u32,
}

impl Answers {
    fn listen(interface: &str) -> Self {
        let socket = CanSocket::open(interface).unwrap();
        socket.set_filters(&[(2, 0x7FF)]).unwrap();
        socket.set_nonblocking(true).unwrap();
        socket.as_raw_socket().set_recv_buffer_size(4 << 20).unwrap();
        Self { socket, count: 0 }
    }

    #[track_caller]
    fn take(&mut self) {
        while let Ok(frame) = self.socket.read_frame() {
            assert_eq!(frame.raw_id(), 2);
            let number = u32::from_le_bytes(frame.data()[..4].try_into().unwrap());
            assert_eq!(number, self.count, "an answer is missing, or comes twice");
            self.count += 1;
        }
    }
}
