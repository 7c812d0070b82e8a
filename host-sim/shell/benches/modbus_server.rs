//! The simulated controller's Modbus server compared with a bare epoll server that sends the same number of
//! bytes, at 8 and 64 connections: requests per second, and CPU time of the server thread per request.
//!
//! Rounds of both are interleaved, so that other load of the machine affects both. One client thread keeps
//! one request in flight on every connection.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsFd;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use recipe_config::SimConfig;
use recipe_shell::controller;
use rustix::event::epoll;

/// Function 3, registers 0..118.
const REQUEST: [u8; 12] = [0, 7, 0, 0, 0, 6, 1, 3, 0, 0, 0, 118];
const ANSWER: usize = 9 + 2 * 118;
const ROUNDS: usize = 25;
const ROUND: Duration = Duration::from_millis(120);

fn main() {
    // `cargo test` runs benchmarks too, to check that they compile and start.
    if !std::env::args().any(|arg| arg == "--bench") {
        return;
    }
    let echo = start_echo();
    let mut config = SimConfig::default();
    config.listen.command = 0;
    config.listen.state = 0;
    config.listen.modbus = 0;
    config.listen.udp2011 = 0;
    let handle = controller::start(config, Vec::new()).unwrap();
    let modbus: SocketAddr = handle.place("modbus").parse().unwrap();
    for connections in [8, 64] {
        let mut bare = Side::new("echo", echo, connections);
        let mut ours = Side::new("controller", modbus, connections);
        for _ in 0..ROUNDS {
            bare.round();
            ours.round();
        }
        let (bare, ours) = (bare.medians(), ours.medians());
        println!("{connections} connections    requests/s    server ns/request");
        println!("  bare epoll    {:>12.0}    {:>8.0}", bare.0, bare.1);
        println!("  controller    {:>12.0}    {:>8.0}", ours.0, ours.1);
        println!("  ratio         {:>12.3}    {:>8.3}", ours.0 / bare.0, ours.1 / bare.1);
    }
}

/// One server and its clients.
struct Side {
    thread: &'static str,
    clients: Vec<TcpStream>,
    rates: Vec<f64>,
    costs: Vec<f64>,
}

impl Side {
    fn new(thread: &'static str, server: SocketAddr, connections: usize) -> Self {
        let clients = (0..connections).map(|_| {
            let stream = TcpStream::connect(server).unwrap();
            stream.set_nodelay(true).unwrap();
            stream
        });
        Self { thread, clients: clients.collect(), rates: Vec::new(), costs: Vec::new() }
    }

    fn round(&mut self) {
        let (start, cpu) = (Instant::now(), thread_nanos(self.thread));
        let mut requests = 0_u32;
        let mut answer = [0; ANSWER];
        while start.elapsed() < ROUND {
            for client in &mut self.clients {
                client.write_all(&REQUEST).unwrap();
            }
            for client in &mut self.clients {
                client.read_exact(&mut answer).unwrap();
                requests += 1;
            }
        }
        self.rates.push(f64::from(requests) / start.elapsed().as_secs_f64());
        self.costs.push((thread_nanos(self.thread) - cpu) as f64 / f64::from(requests));
    }

    fn medians(mut self) -> (f64, f64) {
        (median(&mut self.rates), median(&mut self.costs))
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// CPU time of a thread of this process, in nanoseconds.
fn thread_nanos(name: &str) -> u64 {
    for task in std::fs::read_dir("/proc/self/task").unwrap() {
        let path = task.unwrap().path();
        let Ok(comm) = std::fs::read_to_string(path.join("comm")) else { continue };
        if comm.trim() == name {
            let stat = std::fs::read_to_string(path.join("schedstat")).unwrap();
            return stat.split(' ').next().unwrap().parse().unwrap();
        }
    }
    panic!("no thread {name}");
}

/// A minimal server: wait, read, write.
fn start_echo() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    let (running, started) = mpsc::channel();
    let run = move || {
        // From here on the thread has its name.
        running.send(()).unwrap();
        echo(&listener);
    };
    thread::Builder::new().name("echo".to_owned()).spawn(run).unwrap();
    started.recv().unwrap();
    at
}

fn echo(listener: &TcpListener) {
    let poll = epoll::create(epoll::CreateFlags::CLOEXEC).unwrap();
    let add = |fd: &dyn AsFd, id| {
        epoll::add(&poll, fd.as_fd(), epoll::EventData::new_u64(id), epoll::EventFlags::IN).unwrap();
    };
    add(listener, 0);
    let mut clients = BTreeMap::new();
    let mut next = 1;
    let answer = [0; ANSWER];
    let mut events = Vec::with_capacity(256);
    loop {
        events.clear();
        epoll::wait(&poll, rustix::buffer::spare_capacity(&mut events), None).unwrap();
        for event in &events {
            let id = event.data.u64();
            if id == 0 {
                let (client, _) = listener.accept().unwrap();
                client.set_nodelay(true).unwrap();
                add(&client, next);
                clients.insert(next, client);
                next += 1;
                continue;
            }
            let client: &mut TcpStream = clients.get_mut(&id).unwrap();
            match client.read(&mut [0; 4_096]) {
                Ok(1..) => client.write_all(&answer).unwrap(),
                _ => drop(clients.remove(&id)),
            }
        }
    }
}
