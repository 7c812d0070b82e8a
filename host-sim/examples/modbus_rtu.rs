//! A Modbus RTU slave on the line at its standard input and output, for tests with other programs:
//! `modbus_rtu ADDRESS`, where both are one pseudoterminal.
//!
//! It shows `proto_core::modbus::rtu::Slave` alone, without an engine. A gateway with such ports needs only a
//! configuration (docs/configuration.md section 4).

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::AsFd;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::thread;
use std::time;

use proto_core::modbus::rtu::{Echo, MAX_ADU, Slave, Timing};
use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::time::{Duration, Instant};

/// Bytes pass through other programs and the scheduler: silences of 3.5 characters are not seen.
const TIMING: Timing = Timing::new(19_200, 11).with_silence(Duration::from_millis(20));

fn main() -> io::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let line = Pipe::open()?;
    match &arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [address] => {
            let address = address.parse().ok().and_then(|address| Slave::new(TIMING, Echo::Absent, address));
            slave(line, address.ok_or_else(|| io::Error::other("an address of 1..=247 is needed"))?)
        }
        _ => Err(io::Error::other("usage: modbus_rtu ADDRESS")),
    }
}

/// What comes in pieces of any size, and where it goes.
struct Pipe {
    received: Receiver<Vec<u8>>,
    out: File,
    start: time::Instant,
}

impl Pipe {
    fn open() -> io::Result<Self> {
        let (sender, received) = mpsc::channel();
        thread::spawn(move || {
            let mut bytes = [0; 64];
            while let Ok(len) = io::stdin().read(&mut bytes)
                && len > 0
                && sender.send(bytes[..len].to_vec()).is_ok()
            {}
        });
        let out = File::from(io::stdout().as_fd().try_clone_to_owned()?);
        Ok(Self { received, out, start: time::Instant::now() })
    }

    fn now(&self) -> Instant {
        Instant::ZERO + Duration::from(self.start.elapsed())
    }

    /// Bytes, none when `deadline` has come; `None` at the end of the line.
    fn wait(&self, deadline: Instant) -> Option<Vec<u8>> {
        let span = deadline.saturating_since(self.now()).min(Duration::from_secs(1));
        match self.received.recv_timeout(span.into()) {
            Ok(bytes) => Some(bytes),
            Err(RecvTimeoutError::Timeout) => Some(Vec::new()),
            Err(RecvTimeoutError::Disconnected) => None,
        }
    }
}

fn slave(mut line: Pipe, mut slave: Slave) -> io::Result<()> {
    let mut bank = Bank { coils: [false; 100], words: [0; 100] };
    let mut out = [0; MAX_ADU];
    eprintln!("ready");
    while let Some(bytes) = line.wait(slave.deadline()) {
        slave.received(&bytes, line.now());
        if let Some(len) = slave.poll(line.now(), &mut bank, &mut out) {
            line.out.write_all(&out[..len])?;
            eprintln!("{:?}", slave.counters());
        }
    }
    Ok(())
}

/// 100 coils and 100 registers, all writable.
struct Bank {
    coils: [bool; 100],
    words: [u16; 100],
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let at = usize::from(address);
        let coils = self.coils.get(at..at + usize::from(count)).ok_or(Exception::IllegalDataAddress)?;
        Coils::pack(coils.iter().copied(), packed).map(|_| ()).ok_or(Exception::DeviceFailure)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let at = usize::from(address);
        let target = self.coils.get_mut(at..at + usize::from(coils.count()));
        let target = target.ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let at = usize::from(address);
        let values = self.words.get(at..at + words.len()).ok_or(Exception::IllegalDataAddress)?;
        words.iter_mut().zip(values).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        let at = usize::from(address);
        let target = self.words.get_mut(at..at + usize::from(registers.count()));
        let target = target.ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(registers.iter()).for_each(|(word, value)| *word = value);
        Ok(())
    }
}
