//! A USB device without hardware: a port of the kernel's `vhci_hcd` is connected to a socket, with the
//! protocol USB/IP (the kernel's Documentation/usb/usbip_protocol.rst).
//!
//! In: a [`Function`], which handles transfers. Out: the device on a port, with the kernel's driver for it.
//! Does not know what the transfers mean. Full speed, control transfers and one bulk endpoint for each
//! direction; nothing is ever late or lost.

use std::collections::VecDeque;
use std::fs;
use std::io::{Read, Write};
use std::net::Shutdown;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Mutex, MutexGuard};

use recipe_test_kit::until;

/// The function of a device.
pub(crate) trait Function: Send + 'static {
    /// Carries out a control request and returns the answer; `None` for a stall.
    fn control(&mut self, request: Request, data: &[u8]) -> Option<Vec<u8>>;
    /// Takes a packet of the bulk endpoint from the host.
    fn take(&mut self, packet: &[u8]);
    /// The next packet for the bulk endpoint to the host.
    fn next(&mut self) -> Option<Vec<u8>>;
}

/// The used parts of a control transfer's setup packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Request {
    /// Direction, kind and recipient.
    pub(crate) kind: u8,
    pub(crate) code: u8,
    pub(crate) value: u16,
}

/// A device that is plugged in; dropping it unplugs it.
pub(crate) struct Plugged<F: Function> {
    port: u32,
    device: Arc<Mutex<Device<F>>>,
}

impl<F: Function> Plugged<F> {
    /// Plugs it into the first free port.
    #[track_caller]
    pub(crate) fn new(function: F) -> Self {
        let (ours, kernels) = UnixStream::pair().unwrap();
        let mut from_host = ours.try_clone().unwrap();
        let device = Device { function, socket: ours, waiting: VecDeque::new() };
        let device = Arc::new(Mutex::new(device));
        let serving = Arc::clone(&device);
        std::thread::spawn(move || while serve(&mut from_host, &serving).is_some() {});
        let port = until("a free USB port", || ports().into_iter().find(|port| port.is_free)).number;
        let attach = format!("{port} {} {DEVICE_ID} {FULL_SPEED}", kernels.as_raw_fd());
        fs::write(format!("{HUB}/attach"), attach).unwrap();
        Self { port, device }
    }

    /// Calls `look` with the function, then sends what the function has for the host.
    pub(crate) fn with<T>(&self, look: impl FnOnce(&mut F) -> T) -> T {
        let mut device = lock(&self.device);
        let seen = look(&mut device.function);
        device.send();
        seen
    }
}

impl<F: Function> Drop for Plugged<F> {
    fn drop(&mut self) {
        let _ = lock(&self.device).socket.shutdown(Shutdown::Both);
        if !std::thread::panicking() {
            until("the port is free", || {
                ports().iter().any(|port| port.number == self.port && port.is_free).then_some(())
            });
        }
    }
}

struct Device<F> {
    function: F,
    socket: UnixStream,
    /// Numbers of the host's transfers that wait for packets.
    waiting: VecDeque<u32>,
}

impl<F: Function> Device<F> {
    /// Answers the transfers that wait, as far as there are packets.
    fn send(&mut self) {
        while let Some(&number) = self.waiting.front() {
            let Some(packet) = self.function.next() else { return };
            self.waiting.pop_front();
            self.answer(SUBMIT_ANSWER, number, OK, packet.len(), &packet);
        }
    }

    /// Ends a transfer; errors are ignored, since the host may be gone.
    fn answer(&mut self, kind: u32, number: u32, status: i32, length: usize, data: &[u8]) {
        let mut bytes = Vec::with_capacity(HEADER + data.len());
        for word in [kind, number, 0, 0, 0, status.cast_unsigned(), u32::try_from(length).unwrap()] {
            bytes.extend(word.to_be_bytes());
        }
        bytes.resize(HEADER, 0);
        bytes.extend(data);
        let _ = self.socket.write_all(&bytes);
    }

    fn submitted(&mut self, header: &Header, data: &[u8]) {
        let number = header.word(1);
        if header.word(4) == CONTROL_ENDPOINT {
            let [kind, code, v0, v1, _, _, l0, l1] = header.setup();
            let request = Request { kind, code, value: u16::from_le_bytes([v0, v1]) };
            let most = usize::from(u16::from_le_bytes([l0, l1]));
            match self.function.control(request, data) {
                None => self.answer(SUBMIT_ANSWER, number, STALL, 0, &[]),
                Some(reply) if header.is_to_host() => {
                    let reply = &reply[..reply.len().min(most)];
                    self.answer(SUBMIT_ANSWER, number, OK, reply.len(), reply);
                }
                Some(_) => self.answer(SUBMIT_ANSWER, number, OK, data.len(), &[]),
            }
        } else if header.is_to_host() {
            self.waiting.push_back(number);
        } else {
            self.answer(SUBMIT_ANSWER, number, OK, data.len(), &[]);
            self.function.take(data);
        }
        self.send();
    }

    fn unlinked(&mut self, header: &Header) {
        let unlinked = header.word(5);
        let waited = self.waiting.iter().position(|&number| number == unlinked);
        let status = if waited.and_then(|at| self.waiting.remove(at)).is_some() { RESET } else { OK };
        self.answer(UNLINK_ANSWER, header.word(1), status, 0, &[]);
    }
}

/// Serves the host's next command; `None` if it has unplugged the device.
fn serve<F: Function>(from_host: &mut UnixStream, device: &Mutex<Device<F>>) -> Option<()> {
    let mut header = Header([0; HEADER]);
    from_host.read_exact(&mut header.0).ok()?;
    match header.word(0) {
        SUBMIT => {
            let length = if header.is_to_host() { 0 } else { header.word(6) };
            let mut data = vec![0; usize::try_from(length).unwrap()];
            from_host.read_exact(&mut data).ok()?;
            lock(device).submitted(&header, &data);
        }
        UNLINK => lock(device).unlinked(&header),
        command => panic!("no command of USB/IP: {command:#x}"),
    }
    Some(())
}

/// A command of the host: words in network order, and the setup packet.
struct Header([u8; HEADER]);

impl Header {
    fn word(&self, index: usize) -> u32 {
        u32::from_be_bytes(self.0[4 * index..][..4].try_into().unwrap())
    }

    fn is_to_host(&self) -> bool {
        self.word(3) == 1
    }

    fn setup(&self) -> [u8; 8] {
        self.0[40..].try_into().unwrap()
    }
}

struct Port {
    number: u32,
    is_free: bool,
}

/// The ports for devices up to high speed.
fn ports() -> Vec<Port> {
    let status = fs::read_to_string(format!("{HUB}/status"));
    let status = status.unwrap_or_else(|error| panic!("{HUB}: {error}; modprobe vhci_hcd"));
    let words = status.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let ports = words.filter(|words| words.first() == Some(&"hs"));
    ports.map(|words| Port { number: words[1].parse().unwrap(), is_free: words[2] == FREE }).collect()
}

/// Also if a test has failed while it held the lock.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

const HUB: &str = "/sys/devices/platform/vhci_hcd.0";
/// The state of an empty port.
const FREE: &str = "004";
const DEVICE_ID: u32 = 1;
const FULL_SPEED: u32 = 2;
const HEADER: usize = 48;
const CONTROL_ENDPOINT: u32 = 0;
const SUBMIT: u32 = 1;
const UNLINK: u32 = 2;
const SUBMIT_ANSWER: u32 = 3;
const UNLINK_ANSWER: u32 = 4;
const OK: i32 = 0;
const STALL: i32 = -libc::EPIPE;
const RESET: i32 = -libc::ECONNRESET;
