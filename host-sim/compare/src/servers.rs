//! Modbus TCP servers with 8 and 64 connections, each of which always has one request for 118 registers in flight: the
//! simulated controller's, libmodbus', tokio-modbus', and a bare epoll loop that answers with as many bytes without
//! looking at the request. All of them have the scheduling that the controller asks for, which decides how often a
//! server is woken; who asks has an ordinary one.

use std::collections::BTreeMap;
use std::future::{Ready, ready};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsFd;
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clap::ValueEnum;
use recipe_io::realtime::{self, Scheduling};
use recipe_test_kit::Process;
use rustix::event::epoll;
use rustix::process::Pid;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use tokio_modbus::prelude::{ExceptionCode, Request, Response};
use tokio_modbus::server::Service;
use tokio_modbus::server::tcp::{Server, accept_tcp_connection};

use crate::cell_files;
use crate::figures::{processor_time, quantile};
use crate::programs;

/// Function 3, registers 0..118.
const REQUEST: [u8; 12] = [0, 7, 0, 0, 0, 6, 1, 3, 0, 0, 0, 118];
const ANSWER: usize = 9 + 2 * 118;
const ROUND: Duration = Duration::from_millis(120);

/// A server that this program can be.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Kind {
    /// Wait, read, write.
    Epoll,
    /// The server of tokio-modbus on one thread.
    TokioModbus,
}

/// Compares them, and prints a table for each number of connections. If they are `apart`, who asks has one processor,
/// and the servers share another one: the scheduler decides nothing.
pub(crate) fn compare(rounds: usize, apart: bool) {
    let controller = cell_files::controller();
    let epoll = Other::start(programs::this().args(["serve", "epoll"]));
    let tokio_modbus = Other::start(programs::this().args(["serve", "tokio-modbus"]));
    let libmodbus = Other::start(&mut programs::in_c("modbus_server", &["-lmodbus"]));
    if apart {
        let others = [&epoll, &tokio_modbus, &libmodbus].map(|other| other.process.pid());
        keep_apart(others.into_iter().chain([controller.pid()]));
    }
    for connections in [8, 64] {
        let mut sides = [
            Side::new("bare epoll", epoll.address, epoll.process.pid(), connections),
            Side::new("controller", controller.at("modbus"), controller.pid(), connections),
            Side::new("libmodbus", libmodbus.address, libmodbus.process.pid(), connections),
            Side::new("tokio-modbus", tokio_modbus.address, tokio_modbus.process.pid(), connections),
        ];
        for _ in 0..rounds {
            sides.iter_mut().for_each(Side::round);
        }
        println!("{connections} connections    requests/s    beside bare epoll    server ns/request");
        let bare = quantile(&mut sides[0].rates, 0.5);
        for side in &mut sides {
            let (rate, cost) = (quantile(&mut side.rates, 0.5), quantile(&mut side.costs, 0.5));
            println!("  {:<14} {rate:>12.0} {:>20.3} {cost:>20.0}", side.name, rate / bare);
        }
    }
}

/// Puts this thread on the first processor that it may use, and these processes on the second one.
fn keep_apart(servers: impl Iterator<Item = Pid>) {
    let allowed = sched_getaffinity(None).expect("the system says which processors there are");
    let mut processors =
        (0..CpuSet::MAX_CPU).filter(|&processor| allowed.is_set(processor)).map(|processor| {
            let mut one = CpuSet::new();
            one.set(processor);
            one
        });
    let (Some(own), Some(theirs)) = (processors.next(), processors.next()) else {
        panic!("they cannot be kept apart: this program may use one processor only")
    };
    sched_setaffinity(None, &own).expect("an allowed processor");
    for server in servers {
        let threads = std::fs::read_dir(format!("/proc/{server}/task")).expect("it runs");
        for thread in threads {
            let name = thread.expect("a thread").file_name();
            let thread = name.to_str().and_then(|name| name.parse().ok()).and_then(Pid::from_raw);
            sched_setaffinity(thread, &theirs).expect("a thread of our own, on an allowed processor");
        }
    }
}

/// A server that is a process, other than host-sim.
struct Other {
    process: Process,
    address: SocketAddr,
}

impl Other {
    /// Starts it on a port that is free now.
    fn start(command: &mut Command) -> Self {
        let address =
            TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a free port");
        let process = Process::start(command.arg(address.to_string()));
        assert_eq!(process.line(), "ready");
        Self { process, address }
    }
}

/// One server and its clients.
struct Side {
    name: &'static str,
    process: Pid,
    clients: Vec<TcpStream>,
    rates: Vec<f64>,
    costs: Vec<f64>,
}

impl Side {
    fn new(name: &'static str, server: SocketAddr, process: Pid, connections: usize) -> Self {
        let clients = (0..connections).map(|_| {
            let stream = TcpStream::connect(server).unwrap_or_else(|error| panic!("{name}: {error}"));
            stream.set_nodelay(true).unwrap();
            stream
        });
        Self { name, process, clients: clients.collect(), rates: Vec::new(), costs: Vec::new() }
    }

    fn round(&mut self) {
        let (start, used) = (Instant::now(), processor_time(self.process));
        let mut requests = 0_u32;
        let mut answer = [0; ANSWER];
        while start.elapsed() < ROUND {
            for client in &mut self.clients {
                client.write_all(&REQUEST).unwrap();
            }
            for client in &mut self.clients {
                client.read_exact(&mut answer).unwrap_or_else(|error| panic!("{}: {error}", self.name));
                requests += 1;
            }
            assert_eq!(answer[..9], [0, 7, 0, 0, 0, 239, 1, 3, 236], "{}", self.name);
        }
        self.rates.push(f64::from(requests) / start.elapsed().as_secs_f64());
        self.costs.push((processor_time(self.process) - used).as_nanos() as f64 / f64::from(requests));
    }
}

/// Is a server, until the process is killed.
pub(crate) fn serve(kind: Kind, address: SocketAddr) {
    realtime::apply(Scheduling::FifoIfAllowed);
    match kind {
        Kind::Epoll => serve_bare(address),
        Kind::TokioModbus => serve_with_tokio(address),
    }
}

fn serve_bare(address: SocketAddr) {
    let listener = TcpListener::bind(address).unwrap();
    println!("ready");
    let poll = epoll::create(epoll::CreateFlags::CLOEXEC).unwrap();
    let add = |fd: &dyn AsFd, id| {
        epoll::add(&poll, fd.as_fd(), epoll::EventData::new_u64(id), epoll::EventFlags::IN).unwrap();
    };
    add(&listener, 0);
    let mut clients = BTreeMap::new();
    let mut next = 1;
    let mut answer = [0; ANSWER];
    answer[..9].copy_from_slice(&[0, 7, 0, 0, 0, 239, 1, 3, 236]);
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
            let Some(client) = clients.get_mut(&id) else { continue };
            match client.read(&mut [0; 4_096]) {
                Ok(1..) => client.write_all(&answer).unwrap(),
                _ => drop(clients.remove(&id)),
            }
        }
    }
}

/// Registers that all connections share, as its examples have them.
#[derive(Debug, Clone)]
struct Registers(Arc<Mutex<Vec<u16>>>);

impl Service for Registers {
    type Request = Request<'static>;
    type Response = Response;
    type Exception = ExceptionCode;
    type Future = Ready<Result<Response, ExceptionCode>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        ready(match request {
            Request::ReadHoldingRegisters(first, count) => {
                let registers = self.0.lock().expect("no holder panics");
                let found = registers.get(first.into()..usize::from(first) + usize::from(count));
                found
                    .map(|found| Response::ReadHoldingRegisters(found.to_vec()))
                    .ok_or(ExceptionCode::IllegalDataAddress)
            }
            _ => Err(ExceptionCode::IllegalFunction),
        })
    }
}

fn serve_with_tokio(address: SocketAddr) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let listener = tokio::net::TcpListener::bind(address).await.unwrap();
        println!("ready");
        let registers = Registers(Arc::new(Mutex::new(vec![0; 512])));
        let new_service = |_| Ok(Some(registers.clone()));
        let connected = |stream, peer| async move { accept_tcp_connection(stream, peer, new_service) };
        Server::new(listener).serve(&connected, |error| eprintln!("{error}")).await.unwrap();
    });
}
