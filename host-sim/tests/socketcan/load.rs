//! A bus at full load: every frame is accounted for.

use std::time::{Duration, Instant};

use serde_json::Value;
use socketcan::{CanFrame, CanSocket, EmbeddedFrame, Frame, Socket, SocketOptions, StandardId};

use super::cell::{Running, example, until};
use super::{Needs, Test};

pub(crate) fn trials(interface: &str) -> Vec<Test> {
    let interface = interface.to_owned();
    vec![("a_bus_at_full_load", Needs::Nothing, Box::new(move || full_load(&interface)))]
}

const BITRATE: u64 = 500_000;
/// Bits of a frame with eight bytes and the space after it, without stuffing.
const FRAME_BITS: u64 = 111;

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
    let robot = Running::controller(&example("can-hand-controller.toml"), &[]);
    let gateway = Running::gateway(&file, &robot, &[&format!("--bind=can-1=socketcan:{interface}")]);
    let sender = CanSocket::open(interface).unwrap();
    sender.set_filter_drop_all().unwrap();
    let mut answers = Answers::listen(interface);

    let begin = Instant::now();
    let mut sent = 0_u32;
    loop {
        let passed = begin.elapsed();
        let due = passed.as_micros() as u64 * BITRATE / (FRAME_BITS * 1_000_000);
        while u64::from(sent) < due {
            sent += 1;
            sender.write_frame(&numbered(sent)).unwrap();
        }
        answers.take();
        if passed.as_secs_f64() >= seconds {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
    }

    let number = |value: &Value| value.as_u64().unwrap();
    let stats = gateway.stats("every frame read or lost, answered or overtaken", |stats| {
        let port = &stats["ports"]["can-1"];
        let [read, lost] = ["frames_in", "overruns"].map(|name| number(&port["device"][name]));
        let [answered, overtaken] = ["frames_out", "skipped_cycles"].map(|name| number(&port[name]));
        read + lost >= u64::from(sent) && answered + overtaken == read
    });
    if stats["ports"]["can-1"]["device"]["overruns"] == 0 {
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
         {lost} there; {answered} answers, {} received",
        f64::from(sent) / seconds,
        answers.count,
    );
    // What the kernel dropped may also have been a returned answer.
    assert!(read <= u64::from(sent) && read + lost >= u64::from(sent), "{port}");
    assert_eq!(number(&port["frames_in"]), read, "no frame is lost that the kernel delivered");
    assert_eq!(number(&port["frames_out"]), answered, "{port}");
    assert_eq!(number(&device["dropped"]), 0, "{port}");
    assert_eq!(answered + number(&port["skipped_cycles"]), read, "each is answered or overtaken by the next");
    assert_eq!(u64::from(answers.count), answered, "answers");
    gateway.end();
    robot.end();
}

fn numbered(number: u32) -> CanFrame {
    let bytes = number.to_le_bytes();
    let data: Vec<u8> = bytes.iter().chain(&bytes).copied().collect();
    CanFrame::new(StandardId::new(1).unwrap(), &data).unwrap()
}

/// The gateway's answers, whose numbers must not miss one.
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
