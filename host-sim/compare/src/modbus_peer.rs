//! A robot's Modbus server that answers at once and keeps nothing, so that what is measured is the one who asks. It can be
//! many robots, each with a listener.

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsFd;
use std::time::Duration;

use rustix::event::{Timespec, epoll};

/// Header before the unit and the function.
const HEAD: usize = 6;
/// The longest answer.
const ANSWER: usize = 260;

pub(crate) struct Peer {
    poll: rustix::fd::OwnedFd,
    listeners: Vec<TcpListener>,
    /// Connections by the number that epoll has for them: the robot, the socket, and bytes of an unfinished request.
    connections: BTreeMap<u64, (usize, TcpStream, Vec<u8>)>,
    next: u64,
}

impl Peer {
    /// So many robots on free ports.
    pub(crate) fn new(robots: usize) -> Self {
        let poll = epoll::create(epoll::CreateFlags::CLOEXEC).unwrap();
        let listeners: Vec<_> = (0..robots).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
        for (robot, listener) in listeners.iter().enumerate() {
            add(&poll, listener, robot as u64);
        }
        Self { poll, next: robots as u64, listeners, connections: BTreeMap::new() }
    }

    pub(crate) fn address(&self, robot: usize) -> SocketAddr {
        self.listeners[robot].local_addr().unwrap()
    }

    /// Waits for at most `time` and answers what has come; tells the robot and the first value of each request that
    /// writes registers.
    pub(crate) fn serve(&mut self, time: Duration, mut written: impl FnMut(usize, u16)) {
        let mut events = Vec::with_capacity(256);
        let time = Timespec { tv_sec: time.as_secs() as i64, tv_nsec: time.subsec_nanos().into() };
        match epoll::wait(&self.poll, rustix::buffer::spare_capacity(&mut events), Some(&time)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => panic!("epoll: {error}"),
        }
        for event in &events {
            let id = event.data.u64();
            match self.listeners.get(id as usize) {
                Some(listener) => {
                    let (socket, _) = listener.accept().unwrap();
                    socket.set_nodelay(true).unwrap();
                    socket.set_nonblocking(true).unwrap();
                    add(&self.poll, &socket, self.next);
                    self.connections.insert(self.next, (id as usize, socket, Vec::new()));
                    self.next += 1;
                }
                None => {
                    let Some((robot, socket, waiting)) = self.connections.get_mut(&id) else { continue };
                    if !answer(socket, waiting, |value| written(*robot, value)) {
                        self.connections.remove(&id);
                    }
                }
            }
        }
    }
}

fn add(poll: &impl AsFd, socket: &impl AsFd, id: u64) {
    epoll::add(poll, socket, epoll::EventData::new_u64(id), epoll::EventFlags::IN).unwrap();
}

/// Reads once and answers all whole requests; false if the connection has ended.
fn answer(socket: &mut TcpStream, waiting: &mut Vec<u8>, mut written: impl FnMut(u16)) -> bool {
    let mut chunk = [0; 4_096];
    match socket.read(&mut chunk) {
        Ok(0) => return false,
        Ok(count) => waiting.extend_from_slice(&chunk[..count]),
        Err(error) if error.kind() == ErrorKind::WouldBlock => return true,
        Err(_) => return false,
    }
    let mut at = 0;
    while let Some(rest) = waiting.get(at..)
        && rest.len() >= HEAD
    {
        let len = HEAD + usize::from(u16::from_be_bytes([rest[4], rest[5]]));
        let Some(request) = rest.get(..len) else { break };
        let mut buffer = [0; ANSWER];
        let (answer, value) = reply(request, &mut buffer);
        if let Some(value) = value {
            written(value);
        }
        if socket.write_all(answer).is_err() {
            return false;
        }
        at += len;
    }
    waiting.drain(..at);
    true
}

/// The answer, and the first value of what writes registers.
fn reply<'r>(request: &[u8], buffer: &'r mut [u8; ANSWER]) -> (&'r [u8], Option<u16>) {
    let word = |at: usize| u16::from_be_bytes([request[at], request[at + 1]]);
    buffer[..8].copy_from_slice(&request[..8]);
    let (len, value) = match request[7] {
        // Coils and registers: all are 0.
        function @ 1..=4 => {
            let bytes = if function < 3 { word(10).div_ceil(8) } else { 2 * word(10) };
            buffer[8] = bytes as u8;
            (9 + usize::from(bytes), None)
        }
        function @ (5 | 6 | 15 | 16) => {
            buffer[8..12].copy_from_slice(&request[8..12]);
            let value = match function {
                6 => Some(word(10)),
                16 => Some(word(13)),
                _ => None,
            };
            (12, value)
        }
        function => panic!("function {function} is not expected"),
    };
    buffer[4..6].copy_from_slice(&((len - HEAD) as u16).to_be_bytes());
    (&buffer[..len], value)
}
