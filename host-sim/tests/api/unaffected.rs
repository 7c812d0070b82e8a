//! What an attack on the console costs the cell: counters and latencies of the same gateway, with and without.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use recipe_test_kit::{HostSim, example, latency, until};
use serde_json::Value;

use crate::kit::*;

/// A panel that sends a frame every 4 ms and reads what comes back.
struct Panel {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Panel {
    fn start(port: SocketAddr) -> Self {
        let (stop, sent) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let (own_stop, own_sent) = (Arc::clone(&stop), Arc::clone(&sent));
        let mut line = TcpStream::connect(port).unwrap();
        line.set_nodelay(true).unwrap();
        let thread = std::thread::spawn(move || {
            let mut back = line.try_clone().unwrap();
            back.set_nonblocking(true).unwrap();
            let mut next = Instant::now();
            while !own_stop.load(Relaxed) {
                let nth = own_sent.fetch_add(1, Relaxed) + 1;
                line.set_nonblocking(false).unwrap();
                line.write_all(&[255, 255, nth as u8, 238, 238]).unwrap();
                line.set_nonblocking(true).unwrap();
                while back.read(&mut [0; 4_096]).is_ok_and(|count| count > 0) {}
                next += CYCLE;
                std::thread::sleep(next.saturating_duration_since(Instant::now()));
            }
        });
        Self { stop, sent, thread: Some(thread) }
    }
}

impl Drop for Panel {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

/// What a gateway did in some time.
#[derive(Debug)]
struct Measure {
    /// Counters that must not move, with what they have grown by.
    losses: Vec<(&'static str, u64)>,
    /// Cycles that were kept, and that were left out.
    cycles: (u64, u64),
    /// Values that were too old when their turn came.
    expired: u64,
    /// Of each histogram: name, number of samples, and the buckets of the median, of 99 % and of the longest.
    latency: Vec<(String, u64, [usize; 3])>,
}

impl std::fmt::Display for Measure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "cycles {} kept, {} left out; {} values expired",
            self.cycles.0, self.cycles.1, self.expired
        )?;
        for (name, count, places) in &self.latency {
            let [median, most, longest] = places.map(|bucket| 1_u64 << bucket);
            write!(f, "; {name}: {count}, p50 < {median} µs, p99 < {most} µs, all < {longest} µs")?;
        }
        Ok(())
    }
}

/// Lets the cell work for some time. Every frame of the panel must arrive.
#[track_caller]
fn measure(gateway: &HostSim, panel: &Panel) -> Measure {
    let before = gateway.fresh();
    std::thread::sleep(WINDOW);
    let after = gateway.fresh();
    let number = |stats: &Value, path: &str| stats.pointer(path).and_then(Value::as_u64).unwrap();
    let grown = |path: &str| number(&after, path) - number(&before, path);
    let losses = LOSSES.map(|path| (path, grown(path)));
    let cycles = (grown("/ports/rs485-1/frames_out"), grown("/ports/rs485-1/skipped_cycles"));
    let expired = grown("/ports/rs485-1/values_expired");
    let sent = panel.sent.load(Relaxed);
    gateway.stats("all frames", |stats| number(stats, "/ports/rs485-1/frames_in") >= sent);
    let latency = ["handed_over", "arrived", "lateness", "modbus"].map(|name| {
        let (count, places) = latency::grown(&before, &after, name);
        (name.to_owned(), count, places)
    });
    Measure { losses: losses.to_vec(), cycles, expired, latency: latency.to_vec() }
}

impl Measure {
    /// Whether it is as good as without an attack: nothing is lost, and 99 % take no longer than one bucket more.
    fn is_like(&self, quiet: &Self) -> Result<(), String> {
        if let Some((what, count)) = self.losses.iter().find(|(_, count)| *count > 0) {
            return Err(format!("{what}: {count}"));
        }
        let all = self.cycles.0 + self.cycles.1;
        if self.cycles.1 > quiet.cycles.1 + all / 100 {
            return Err(format!("{} of {all} cycles left out, {} without", self.cycles.1, quiet.cycles.1));
        }
        if self.expired > quiet.expired + all / 100 {
            return Err(format!("{} values expired, {} without", self.expired, quiet.expired));
        }
        for ((name, count, [median, most, _]), (_, _, [quiet_median, quiet_most, _])) in
            self.latency.iter().zip(&quiet.latency)
        {
            if *count == 0 {
                return Err(format!("{name} has no sample"));
            }
            if *median > quiet_median + 1 || *most > quiet_most + 1 {
                return Err(format!("{name} is slower"));
            }
        }
        Ok(())
    }
}

/// Hostile clients, as threads of the lowest priority: they take what the gateway gives, not its processor.
struct Attack {
    stop: Arc<AtomicBool>,
    pause: Arc<AtomicBool>,
    /// Connections that only take room.
    made: Arc<AtomicU64>,
    threads: Vec<JoinHandle<()>>,
}

impl Attack {
    fn start(console: SocketAddr) -> Self {
        let mut attack =
            Self { stop: Arc::default(), pause: Arc::default(), made: Arc::default(), threads: Vec::new() };
        let wrong = format!(
            "POST /api/v1/confirm HTTP/1.1\r\nHost: {console}\r\nAuthorization: Bearer {}\r\n\r\n",
            "0".repeat(32)
        );
        // One who tries keys gets an answer at first; once all places are taken, perhaps never again.
        until("a key is refused", || {
            send(console, wrong.as_bytes()).filter(|answer| answer.starts_with("HTTP/1.1 401")).map(drop)
        });
        attack.begin(move || drop(send(console, wrong.as_bytes())));
        for target in ["stream?frames=1", "stream?frames=1", "capture.pcapng", "stream?frames=1"] {
            let asked = format!("GET /api/v1/{target} HTTP/1.1\r\nHost: {console}\r\n\r\n");
            let reads = attack.threads.len() < 4;
            let (stop, pause) = (Arc::clone(&attack.stop), Arc::clone(&attack.pause));
            attack.begin(move || {
                let Ok(mut stream) = TcpStream::connect(console) else { return };
                let _ = stream.write_all(asked.as_bytes());
                let _ = stream.set_read_timeout(Some(Duration::from_millis(50)));
                let until = Instant::now() + Duration::from_secs(1);
                while Instant::now() < until && !stop.load(Relaxed) && !pause.load(Relaxed) {
                    match reads.then(|| stream.read(&mut [0; 65_536])) {
                        Some(Ok(0)) => return,
                        Some(_) => {}
                        // Greedy: it asks for everything and takes nothing.
                        None => std::thread::sleep(Duration::from_millis(5)),
                    }
                }
            });
        }
        let mut slow: Option<TcpStream> = None;
        attack.begin(move || {
            let stream = slow.get_or_insert_with(|| TcpStream::connect(console).unwrap());
            if stream.write_all(b"G").is_err() {
                slow = None;
            }
            std::thread::sleep(Duration::from_millis(5));
        });
        let mut held = VecDeque::new();
        let made = Arc::clone(&attack.made);
        attack.begin(move || {
            let Ok(mut stream) = TcpStream::connect(console) else { return };
            if held.len() % 2 == 0 {
                let _ = stream.write_all(b"GET /api/v1/status HTTP/1.1\r\n");
            }
            held.push_back(stream);
            made.fetch_add(1, Relaxed);
            if held.len() > 1_000 {
                held.pop_front();
            }
        });
        attack
    }

    fn begin(&mut self, mut step: impl FnMut() + Send + 'static) {
        let (stop, pause) = (Arc::clone(&self.stop), Arc::clone(&self.pause));
        self.threads.push(std::thread::spawn(move || {
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
            while !stop.load(Relaxed) {
                if pause.load(Relaxed) {
                    std::thread::sleep(Duration::from_millis(1));
                } else {
                    step();
                }
            }
        }));
    }
}

impl Drop for Attack {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

#[test]
fn an_attack_on_the_console_changes_neither_counters_nor_latencies_of_the_cell() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("robot.toml"), ROBOT).unwrap();
    let key = write_key(&folder).display().to_string();
    let robot = BINARY.controller(&folder.path().join("robot.toml"), &[]);
    let extra =
        ["--bind", "rs485-1=tcp-listen:127.0.0.1:0", "--console", "127.0.0.1:0", "--console-key", &key];
    let gateway = BINARY.gateway(&example("rs485-system.toml"), &robot, &extra);
    let console = gateway.at("console");
    gateway.stats("links", |stats| stats["links"]["modbus"]["state"] == "up");
    let panel = Panel::start(gateway.at("ports/rs485-1"));
    gateway.stats("frames", |stats| stats["ports"]["rs485-1"]["frames_in"].as_u64() > Some(100));
    let attack = Attack::start(console);
    until("1000 connections", || (attack.made.load(Relaxed) >= 1_000).then_some(()));
    let mut found = Err("not tried".to_owned());
    for _ in 0..MAX_TRIES {
        attack.pause.store(true, Relaxed);
        std::thread::sleep(SETTLE);
        let quiet = measure(&gateway, &panel);
        attack.pause.store(false, Relaxed);
        std::thread::sleep(SETTLE);
        let attacked = measure(&gateway, &panel);
        println!("quiet     {quiet}\nattacked  {attacked}");
        found = attacked.is_like(&quiet);
        if found.is_ok() {
            break;
        }
        // Other load of the machine comes and goes, while an attack's effect stays.
        println!("{found:?}");
    }
    found.unwrap();
    drop(attack);
    let info = until("there is room again", || {
        let asked = format!("GET /api/v1/info HTTP/1.1\r\nHost: {console}\r\n\r\n");
        let answer = send(console, asked.as_bytes()).filter(|answer| answer.starts_with("HTTP/1.1 200"));
        answer.map(|answer| parse(&answer).json())
    });
    println!("{}", info["console"]);
    let counters = &info["console"]["counters"];
    assert!(counters["turned_away"].as_u64() > Some(900), "{info}");
    let requests = &info["console"]["requests"];
    let wrong = requests["wrong_key"].as_u64().unwrap() + requests["locked_out"].as_u64().unwrap();
    assert!(wrong > 0, "{info}");
}

/// Counters that an attack must not move.
const LOSSES: [&str; 9] = [
    "/ports/rs485-1/resync_bytes",
    "/ports/rs485-1/tail_mismatches",
    "/ports/rs485-1/discarded_bytes",
    "/ports/rs485-1/asleep",
    "/ports/rs485-1/timeouts",
    "/ports/rs485-1/downs",
    "/links/modbus/timeouts",
    "/links/modbus/losses",
    "/links/state/losses",
];
const CYCLE: Duration = Duration::from_millis(4);
const WINDOW: Duration = Duration::from_millis(1_500);
const SETTLE: Duration = Duration::from_millis(300);
const MAX_TRIES: usize = 6;
