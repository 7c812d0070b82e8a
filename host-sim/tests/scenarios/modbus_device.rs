//! A Modbus device of the tests' own, on a serial line or as a TCP server. It shares no code with the gateway, and
//! notes what it was asked and what it carried out.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use recipe_test_kit::until_grown;

use super::field::LineClient;
use super::robot::reserved_ports;

/// What becomes of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Act {
    /// It is carried out and answered.
    Well,
    /// The same, and the reply leaves so much later. What comes meanwhile waits.
    Late(Duration),
    /// It is carried out, and the reply is lost; over TCP with the connection.
    Lost,
    /// It is refused with this exception.
    Refused(u8),
    /// The device is away; over TCP the connection ends.
    Unheard,
}

/// A request that holding registers are read (3) or written (6, 16) with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) function: u8,
    pub(crate) address: u16,
    /// Of 6 and 16: the first value.
    pub(crate) value: u16,
}

impl Request {
    pub(crate) fn is_read(&self) -> bool {
        self.function == 3
    }

    pub(crate) fn is_read_at(&self, address: u16) -> bool {
        self.is_read() && self.address == address
    }
}

type Registers = [u16; 64];
type Decide = dyn FnMut(&Request, &mut Registers) -> Act + Send;

struct Inside {
    unit: u8,
    registers: Registers,
    decide: Box<Decide>,
    /// It repeats what it hears before it answers, as an adapter with a local echo does.
    echoes: bool,
    /// What was carried out: where, and the first value.
    written: Vec<(u16, u16)>,
    /// What was asked so far, and what became of it.
    heard: Vec<(Request, Act)>,
    /// Other requests that came while a late reply was still to be sent.
    overtaking: Vec<Request>,
    connections: u32,
    /// It has no power: nobody listens.
    is_off: bool,
}

/// A running device. It ends when it is dropped.
pub(crate) struct ModbusDevice {
    inside: Arc<Mutex<Inside>>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ModbusDevice {
    fn start(unit: u8, run: impl FnOnce(&Mutex<Inside>, &AtomicBool) + Send + 'static) -> Self {
        let inside = Inside {
            unit,
            registers: [0; 64],
            decide: Box::new(|_, _| Act::Well),
            echoes: false,
            written: Vec::new(),
            heard: Vec::new(),
            overtaking: Vec::new(),
            connections: 0,
            is_off: false,
        };
        let (inside, is_over) = (Arc::new(Mutex::new(inside)), Arc::<AtomicBool>::default());
        let (own, ends) = (Arc::clone(&inside), Arc::clone(&is_over));
        let thread = std::thread::spawn(move || run(&own, &ends));
        Self { inside, is_over, thread: Some(thread) }
    }

    /// The slave of this number on a line.
    pub(crate) fn on_line(line: LineClient, unit: u8) -> Self {
        Self::start(unit, |inside, is_over| serve_line(line, inside, is_over))
    }

    /// The server of this unit, and its address.
    pub(crate) fn on_tcp(unit: u8) -> (Self, SocketAddr) {
        let address = SocketAddr::from(([127, 0, 0, 1], reserved_ports()[0]));
        let listener = TcpListener::bind(address).unwrap();
        let serve = move |inside: &_, is_over: &_| serve_tcp(listener, address, inside, is_over);
        (Self::start(unit, serve), address)
    }

    fn inside(&self) -> MutexGuard<'_, Inside> {
        self.inside.lock().unwrap()
    }

    pub(crate) fn register(&self, register: u16) -> u16 {
        self.inside().registers[usize::from(register)]
    }

    pub(crate) fn set(&self, register: u16, value: u16) {
        self.inside().registers[usize::from(register)] = value;
    }

    /// From now on, this decides what becomes of each request. It may change registers before.
    pub(crate) fn decide(&self, decide: impl FnMut(&Request, &mut Registers) -> Act + Send + 'static) {
        self.inside().decide = Box::new(decide);
    }

    /// Its adapter gives back what it hears, from now on.
    pub(crate) fn echo(&self) {
        self.inside().echoes = true;
    }

    /// What was carried out since this was asked last.
    pub(crate) fn written(&self) -> Vec<(u16, u16)> {
        std::mem::take(&mut self.inside().written)
    }

    /// What else was asked while a late reply was still to be sent.
    pub(crate) fn overtaking(&self) -> Vec<Request> {
        self.inside().overtaking.clone()
    }

    /// Number of connections so far.
    pub(crate) fn connections(&self) -> u32 {
        self.inside().connections
    }

    /// Takes its power, which ends its connection, or gives it back.
    pub(crate) fn off(&self, is_off: bool) {
        self.inside().is_off = is_off;
    }

    /// Number of requests so far of which this became.
    pub(crate) fn count(&self, which: impl Fn(&Request, Act) -> bool) -> usize {
        self.inside().heard.iter().filter(|(request, act)| which(request, *act)).count()
    }

    /// Waits until so many more reads at `address` were answered in time.
    #[track_caller]
    pub(crate) fn until_read(&self, address: u16, more: usize) {
        self.until_more("reads", more, |request, act| request.is_read_at(address) && act == Act::Well);
    }

    /// Waits until so many more such requests came.
    #[track_caller]
    pub(crate) fn until_more(&self, what: &str, more: usize, which: impl Fn(&Request, Act) -> bool) {
        self.until_count(what, self.count(&which) + more, which);
    }

    /// Waits until so many such requests came since the beginning.
    #[track_caller]
    pub(crate) fn until_count(&self, what: &str, count: usize, which: impl Fn(&Request, Act) -> bool) {
        until_grown(what, count as u64, || self.count(&which) as u64);
    }
}

impl Drop for ModbusDevice {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::SeqCst);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

impl Inside {
    /// Carries out a request, of which `pdu` begins with the function; the reply.
    fn carry_out(&mut self, request: Request, pdu: &[u8]) -> Vec<u8> {
        let at = usize::from(request.address);
        if request.is_read() {
            let count = usize::from(u16::from_be_bytes([pdu[3], pdu[4]]));
            let values = self.registers[at..at + count].iter().flat_map(|value| value.to_be_bytes());
            return [3, 2 * count as u8].into_iter().chain(values).collect();
        }
        let values = if request.function == 6 { &pdu[3..5] } else { &pdu[6..] };
        for (place, value) in self.registers[at..].iter_mut().zip(values.chunks_exact(2)) {
            *place = u16::from_be_bytes([value[0], value[1]]);
        }
        self.written.push((request.address, request.value));
        pdu[..5].to_vec()
    }

    /// What becomes of a request, and the reply if there is one.
    fn answer(&mut self, pdu: &[u8]) -> (Act, Option<Vec<u8>>) {
        let request = request_of(pdu);
        let act = (self.decide)(&request, &mut self.registers);
        let reply = match act {
            Act::Well | Act::Late(_) => Some(self.carry_out(request, pdu)),
            Act::Lost => {
                self.carry_out(request, pdu);
                None
            }
            Act::Refused(code) => Some(vec![0x80 | request.function, code]),
            Act::Unheard => None,
        };
        self.heard.push((request, act));
        (act, reply)
    }
}

fn request_of(pdu: &[u8]) -> Request {
    let word = |at: usize| u16::from_be_bytes([pdu[at], pdu[at + 1]]);
    let value = match pdu[0] {
        6 => word(3),
        16 => word(6),
        _ => 0,
    };
    Request { function: pdu[0], address: word(1), value }
}

/// Length of the PDU that begins so; `None` if it is not known yet, 0 if there is no such request.
fn pdu_len(pdu: &[u8]) -> Option<usize> {
    match pdu.first()? {
        3 | 6 => Some(5),
        16 => pdu.get(5).map(|len| 6 + usize::from(*len)),
        _ => Some(0),
    }
}

/// The first request that has come as a whole, without address and checksum. Bytes before it are no frame.
fn next_on_line(unit: u8, bytes: &mut Vec<u8>) -> Option<Vec<u8>> {
    while !bytes.is_empty() {
        let len = pdu_len(bytes.get(1..)?)?;
        let whole = len + 3;
        if bytes[0] == unit && len > 0 {
            let frame = bytes.get(..whole)?;
            if crc(&frame[..len + 1]) == frame[len + 1..] {
                return Some(bytes.drain(..whole).collect::<Vec<u8>>()[1..=len].to_vec());
            }
        }
        bytes.remove(0);
    }
    None
}

fn serve_line(mut line: LineClient, inside: &Mutex<Inside>, is_over: &AtomicBool) {
    let (unit, mut bytes) = (inside.lock().unwrap().unit, Vec::new());
    while !is_over.load(Ordering::SeqCst) {
        let came = line.take_some(PIECE);
        if inside.lock().unwrap().echoes && !came.is_empty() {
            line.send(&came);
        }
        bytes.extend(came);
        while let Some(pdu) = next_on_line(unit, &mut bytes) {
            let answer = inside.lock().unwrap().answer(&pdu);
            let (act, Some(reply)) = answer else { continue };
            if let Act::Late(time) = act {
                std::thread::sleep(time);
                bytes.extend(line.take_all());
                let mut waiting = bytes.clone();
                let early = std::iter::from_fn(|| next_on_line(unit, &mut waiting));
                // The same bytes again are a repetition.
                let others = early.filter(|other| *other != pdu).map(|pdu| request_of(&pdu));
                inside.lock().unwrap().overtaking.extend(others);
            }
            let mut frame = [&[unit], &reply[..]].concat();
            frame.extend(crc(&frame));
            line.send(&frame);
        }
    }
}

/// Serves one connection after the other.
fn serve_tcp(listener: TcpListener, address: SocketAddr, inside: &Mutex<Inside>, is_over: &AtomicBool) {
    let mut listener = Some(listener);
    let must_end = || is_over.load(Ordering::SeqCst) || inside.lock().unwrap().is_off;
    while !is_over.load(Ordering::SeqCst) {
        if must_end() {
            listener = None;
            std::thread::sleep(PIECE);
            continue;
        }
        let listener = listener.get_or_insert_with(|| TcpListener::bind(address).unwrap());
        listener.set_nonblocking(true).unwrap();
        match listener.accept() {
            Ok((stream, _)) => {
                stream.set_nonblocking(false).unwrap();
                stream.set_nodelay(true).unwrap();
                stream.set_read_timeout(Some(PIECE)).unwrap();
                inside.lock().unwrap().connections += 1;
                serve_connection(stream, inside, must_end);
            }
            Err(_) => std::thread::sleep(PIECE),
        }
    }
}

/// Serves it until either side ends it.
fn serve_connection(mut stream: TcpStream, inside: &Mutex<Inside>, must_end: impl Fn() -> bool) {
    const HEADER: usize = 7;
    let (mut bytes, mut piece) = (Vec::new(), [0; 512]);
    while !must_end() {
        match stream.read(&mut piece) {
            Ok(len @ 1..) => bytes.extend_from_slice(&piece[..len]),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            _ => return,
        }
        while bytes.len() > HEADER {
            // The unit is counted.
            let whole = HEADER - 1 + usize::from(u16::from_be_bytes([bytes[4], bytes[5]]));
            if bytes.len() < whole {
                break;
            }
            let frame: Vec<u8> = bytes.drain(..whole).collect();
            let (protocol, unit) = (&frame[2..4], inside.lock().unwrap().unit);
            assert_eq!((protocol, frame[6]), (&[0, 0][..], unit), "{frame:02X?}");
            let answer = inside.lock().unwrap().answer(&frame[HEADER..]);
            let (act, Some(reply)) = answer else { return };
            if let Act::Late(time) = act {
                std::thread::sleep(time);
            }
            let len = [0, 1 + reply.len() as u8];
            if stream.write_all(&[&frame[..4], &len, &frame[6..7], &reply].concat()).is_err() {
                return;
            }
        }
    }
}

/// The CRC of Modbus RTU, low byte first.
fn crc(bytes: &[u8]) -> [u8; 2] {
    let mut crc = 0xFFFF_u16;
    for byte in bytes {
        crc ^= u16::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 };
        }
    }
    crc.to_le_bytes()
}

/// Longest wait for bytes, so that an end is noticed.
const PIECE: Duration = Duration::from_millis(2);
