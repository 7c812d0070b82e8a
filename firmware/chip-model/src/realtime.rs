//! The chip in real time, with sockets for its serial lines, CAN bus and Ethernet.
//!
//! Virtual time is never ahead of real time. If the host is too slow it falls behind and catches up later; the
//! [`Figures`] say by how much. Input from a socket gets the virtual time at which it was read.

mod can;
mod network;
mod serial;
mod socket;

use std::fmt;
use std::io::Write;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::device::*;
use crate::{Chip, Devices, Led, Stopped};
use can::Can;
use network::Network;
pub use network::exec_if_requested;
use serial::Serial;
use socket::{Client, Listener};

/// What the board is connected to. An address is `HOST:PORT` or the path of a socket.
#[derive(Debug, Default)]
pub struct Backends {
    /// RS-485 A and B.
    pub serial: Vec<String>,
    /// CAN, as slcan.
    pub can: Option<String>,
    /// Options of QEMU's user network; may be empty.
    pub network: Option<String>,
    /// Path of QEMU's QMP socket.
    pub qmp: Option<String>,
    /// Address of the control socket ([`Runner::execute`]).
    pub control: Option<String>,
}

/// Statistics of a run.
#[derive(Debug, Clone, Copy, Default)]
pub struct Figures {
    /// Real time.
    pub wall: Duration,
    /// Virtual time.
    pub virtual_time: Picos,
    /// The largest lag of virtual time.
    pub most_behind: Picos,
    /// How long the lag was above 10 ms.
    pub late: Duration,
    /// Executed instructions.
    pub instructions: u64,
    /// Interrupts taken.
    pub interrupts: u64,
    /// Feeds of the watchdog.
    pub feeds: u64,
    /// Resets by the watchdog.
    pub resets: u64,
    /// Resets that the program asked for.
    pub restarts: u64,
    /// Ethernet frames that the chip received, dropped and sent.
    pub ethernet: [u64; 3],
    /// Bytes that the chip received and sent on both serial lines.
    pub serial: [u64; 2],
    /// Frames that the chip received and sent on CAN.
    pub can: [u64; 2],
}

/// One line of JSON.
impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |time: Picos| time as f64 / SECOND as f64;
        let Self { instructions, interrupts, feeds, resets, restarts, ethernet, serial, can, .. } = self;
        write!(
            f,
            "{{\"wall_s\": {:.6}, \"virtual_s\": {:.6}, \"most_behind_s\": {:.6}, \"late_s\": {:.3}, \
             \"instructions\": {instructions}, \"interrupts\": {interrupts}, \"feeds\": {feeds}, \
             \"resets\": {resets}, \"restarts\": {restarts}, \"ethernet_taken\": {}, \"ethernet_dropped\": {}, \"ethernet_sent\": {}, \
             \"serial_in\": {}, \"serial_out\": {}, \"can_in\": {}, \"can_out\": {}}}",
            self.wall.as_secs_f64(),
            seconds(self.virtual_time),
            seconds(self.most_behind),
            self.late.as_secs_f64(),
            ethernet[0],
            ethernet[1],
            ethernet[2],
            serial[0],
            serial[1],
            can[0],
            can[1],
        )
    }
}

/// Why a run ended by itself.
#[derive(Debug)]
pub enum RunEnd {
    /// A violation of the program.
    Stopped(Stopped),
    /// Something that the run needs is gone.
    Lost(String),
}

/// The chip with its sockets.
pub struct Runner {
    chip: Chip,
    serial: Vec<Serial>,
    can: Option<Can>,
    network: Option<Network>,
    control: Option<Listener>,
    control_clients: Vec<(Client, Vec<u8>)>,
    pace: Pace,
    figures: Figures,
    feeds: u64,
}

/// The virtual time that corresponds to real time.
struct Pace {
    begin: Instant,
    stopped: Option<Instant>,
}

impl Pace {
    fn now(&self) -> Picos {
        let now = self.stopped.unwrap_or_else(Instant::now);
        now.saturating_duration_since(self.begin).as_nanos() as Picos * 1_000
    }

    fn stop(&mut self) {
        self.stopped.get_or_insert_with(Instant::now);
    }

    fn resume(&mut self) {
        if let Some(since) = self.stopped.take() {
            self.begin += since.elapsed();
        }
    }
}

/// Maximum virtual time between two checks of the sockets.
const SLICE: Picos = MILLI;
/// Events within this time are handled together.
const COALESCE: Picos = MILLI / 4;
/// The longest sleep.
const LONGEST: Picos = 100 * MILLI;
/// A larger lag counts as late.
const LATE: Picos = 10 * MILLI;
/// The lag is reported when it first reaches each multiple of this.
const HELD_UP: Picos = 250 * MILLI;

impl Runner {
    /// Opens the sockets and starts QEMU, which may not be ready yet.
    ///
    /// # Errors
    /// A socket cannot be opened, or QEMU cannot be started.
    pub fn new(chip: Chip, wiring: &Backends) -> Result<Self, String> {
        let listen = |place: &String| Listener::new(place);
        let serial = wiring.serial.iter().map(|place| listen(place).map(Serial::new));
        Ok(Self {
            chip,
            serial: serial.collect::<Result<_, _>>()?,
            can: wiring.can.as_ref().map(|place| listen(place).map(Can::new)).transpose()?,
            network: match &wiring.network {
                Some(options) => Some(Network::new(options, wiring.qmp.as_deref())?),
                None => None,
            },
            control: wiring.control.as_ref().map(listen).transpose()?,
            control_clients: Vec::new(),
            pace: Pace { begin: Instant::now(), stopped: None },
            figures: Figures::default(),
            feeds: 0,
        })
    }

    /// Runs until `end` is readable. Writes the log's lines to `log`.
    ///
    /// # Errors
    /// The run ended by itself.
    pub fn run(&mut self, end: &UnixStream, log: &mut dyn Write) -> Result<(), RunEnd> {
        self.pace = Pace { begin: Instant::now(), stopped: None };
        loop {
            // While the core sleeps, the sockets need not be checked before its next event.
            let awake = self.chip.sleeps_until().unwrap_or(0).max(self.chip.now() + SLICE);
            let target = self.pace.now().min(awake);
            let result = if target > self.chip.now() { self.chip.run_until(target) } else { Ok(()) };
            for (at, line) in self.chip.log.drain(..) {
                let written = writeln!(log, "{:12.3} ms  {line}", at as f64 / MILLI as f64);
                written.map_err(|error| RunEnd::Lost(format!("its log: {error}")))?;
            }
            result.map_err(RunEnd::Stopped)?;
            self.update_figures();
            self.exchange().map_err(RunEnd::Lost)?;
            if self.wait(end) {
                return Ok(());
            }
        }
    }

    /// The chip.
    pub fn chip(&mut self) -> &mut Chip {
        &mut self.chip
    }

    /// The statistics so far.
    pub fn figures(&mut self) -> Figures {
        let mut figures = self.figures;
        figures.instructions = self.chip.instructions();
        figures.interrupts = self.chip.interrupts();
        figures.feeds = self.feeds;
        figures.resets = self.chip.resets.len() as u64;
        figures.restarts = self.chip.restarts.len() as u64;
        let ethernet = &self.chip.devices().ethernet;
        let [taken, dropped] = [ethernet.received, ethernet.dropped];
        figures.ethernet = [taken, dropped, self.network.as_ref().map_or(0, |network| network.frames_out)];
        figures.serial = self.serial.iter().fold([0; 2], |[bytes_in, bytes_out], serial| {
            [bytes_in + serial.bytes_in, bytes_out + serial.bytes_out]
        });
        figures.can = self.can.as_ref().map_or([0; 2], |can| [can.frames_in, can.frames_out]);
        figures
    }

    fn exchange(&mut self) -> Result<(), String> {
        let (now, clocks) = (self.chip.now(), self.chip.clocks());
        let devices = self.chip.devices();
        for (serial, usart) in self.serial.iter_mut().zip([&mut devices.usart2, &mut devices.uart7]) {
            serial.exchange(usart, clocks, now);
        }
        if let Some(can) = &mut self.can {
            can.exchange(&mut devices.can, clocks, now);
        }
        if let Some(network) = &mut self.network {
            network.exchange(&mut devices.ethernet, now)?;
        }
        self.feeds += devices.watchdog.feeds.drain(..).count() as u64;
        self.serve_control();
        Ok(())
    }

    /// Updates the statistics of time.
    fn update_figures(&mut self) {
        let wall = Duration::from_nanos(self.pace.now() / 1_000);
        let behind = self.pace.now().saturating_sub(self.chip.now());
        if behind > LATE {
            self.figures.late += wall.saturating_sub(self.figures.wall);
        }
        // If a test fails at this time, the log shows that the machine was too slow.
        if behind / HELD_UP > self.figures.most_behind / HELD_UP {
            eprintln!("the chip is {:.3} s behind real time", behind as f64 / SECOND as f64);
        }
        self.figures.most_behind = self.figures.most_behind.max(behind);
        self.figures.wall = wall;
        self.figures.virtual_time = self.chip.now();
    }

    /// Waits for the next event of the chip or of a socket; returns `true` if the run is to end.
    fn wait(&mut self, end: &UnixStream) -> bool {
        let now = self.pace.now();
        let is_busy = self.serial.iter().any(Serial::is_busy) || self.can.as_ref().is_some_and(Can::is_busy);
        let is_behind = now > self.chip.now() + COALESCE;
        let next = match self.chip.sleeps_until() {
            _ if self.pace.stopped.is_some() => now + LONGEST,
            _ if is_behind => now,
            Some(next) if next <= self.chip.now() => now,
            Some(_) if is_busy => now + SLICE / 2,
            Some(next) => next.max(now + COALESCE).min(now + LONGEST),
            None => now + COALESCE,
        };
        let next = self.network.as_ref().and_then(Network::next).map_or(next, |at| next.min(at.max(now)));
        let wait = next.saturating_sub(now) / 1_000;
        let timeout = Timespec { tv_sec: 0, tv_nsec: wait as i64 };
        let mut fds = vec![PollFd::new(end, PollFlags::IN)];
        self.serial.iter().for_each(|serial| serial.poll(&mut fds));
        self.can.iter().for_each(|can| can.poll(&mut fds));
        fds.extend(self.network.iter().map(Network::poll));
        fds.extend(self.control.iter().map(Listener::poll));
        fds.extend(self.control_clients.iter().map(|(client, _)| client.poll(true)));
        // An error such as EINTR does no harm: everything is checked again.
        let _ = poll(&mut fds, Some(&timeout));
        !fds[0].revents().is_empty()
    }

    fn serve_control(&mut self) {
        let Some(control) = &self.control else { return };
        let new = std::iter::from_fn(|| control.accept());
        self.control_clients.extend(new.map(|client| (client, Vec::new())));
        let mut asked = Vec::new();
        for (index, (client, line)) in self.control_clients.iter_mut().enumerate() {
            line.extend(client.read(256));
            while let Some(end) = line.iter().position(|&byte| byte == b'\n') {
                let words = line.drain(..=end).collect::<Vec<u8>>();
                asked.push((index, String::from_utf8_lossy(&words).trim().to_owned()));
            }
        }
        for (index, words) in asked {
            let answer = self.execute(&words);
            self.control_clients[index].0.write(format!("{answer}\n").as_bytes());
        }
        self.control_clients.retain(|(client, _)| !client.is_gone());
    }

    /// Executes a command of the control socket and returns the line to answer: `cable out`, `cable in`; `press MS`
    /// (the button); `power` (it fails and comes back); `leds` (the last changes of each, as JSON); `stop` (time stands
    /// still, as under a debugger), `go`; `figures`; `save START LEN PATH` (memory, to a file).
    pub fn execute(&mut self, words: &str) -> String {
        let now = self.chip.now();
        match words.splitn(4, ' ').collect::<Vec<_>>().as_slice() {
            ["cable", "out"] => self.chip.devices().ethernet.phy.unplug(),
            ["cable", "in"] => self.chip.devices().ethernet.phy.plug(now),
            ["press", span] => match span.parse::<u32>() {
                Ok(span) => self.chip.devices().press_button(now, Picos::from(span) * MILLI),
                Err(_) => return format!("a number of milliseconds is needed: {words}"),
            },
            ["power"] => self.chip.cut_power(),
            ["leds"] => return leds(self.chip.devices()),
            ["stop"] => self.pace.stop(),
            ["go"] => self.pace.resume(),
            ["figures"] => return self.figures().to_string(),
            ["save", start, len, path] => {
                let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16);
                let (Ok(start), Ok(len)) = (number(start), number(len)) else {
                    return "two hexadecimal numbers are needed".into();
                };
                let mut bytes = vec![0; len as usize];
                if !self.chip.engine().read(start, &mut bytes) {
                    return "no such memory".into();
                }
                if let Err(error) = std::fs::write(path, bytes) {
                    return format!("{path}: {error}");
                }
            }
            _ => return format!("unknown: {words}"),
        }
        "done".into()
    }
}

/// The last changes of each LED, in order: time in ms, and whether it is lit from then on.
fn leds(devices: &Devices) -> String {
    let led = |led: Led| {
        let mut last: Vec<_> = devices.led(led).rev().take(MOST_CHANGES).collect();
        last.reverse();
        let change = |(at, is_lit)| format!("[{:.3}, {is_lit}]", at as f64 / MILLI as f64);
        last.into_iter().map(change).collect::<Vec<String>>().join(", ")
    };
    let [green, yellow, red] = [Led::Green, Led::Yellow, Led::Red].map(led);
    format!("{{\"LD1\": [{green}], \"LD2\": [{yellow}], \"LD3\": [{red}]}}")
}

/// Of each LED.
const MOST_CHANGES: usize = 64;
