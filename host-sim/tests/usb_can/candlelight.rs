//! A candleLight adapter: its firmware's protocol (gs_usb), a CAN controller that counts errors by ISO
//! 11898-1, and its bus.
//!
//! In: what the driver sends, and events on the bus. Out: what the driver receives, and the frames that were
//! on the bus. Does not know USB/IP and the kernel. There is no time: frames are sent at once, and the test
//! triggers what takes an adapter 100 ms.
//!
//! Like the firmware of 2026 for bxCAN (candleLight_fw, `src/can_common.c`, `src/can/bxcan.c`), it echoes a
//! frame when it is put into one of three mailboxes, before it is on the bus.

use std::collections::VecDeque;

use super::usb::{Function, Request};

/// The state of the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Bus {
    /// Another node acknowledges.
    Sound,
    /// There is no other node.
    Empty,
    /// Every bit is read back wrong.
    Shorted,
}

/// How an adapter recovers from bus-off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Restart {
    /// The firmware empties the mailboxes and reports it: since 2026.
    Firmware,
    /// The CAN controller sends what is in the mailboxes, and the firmware reports error-active: since 2020.
    Controller,
    /// Same, without a report: before 2020.
    Silent,
}

/// The adapter.
pub(crate) struct CandleLight {
    bus: Bus,
    /// In bit/s; `None` until the driver has set it.
    bitrate: Option<u32>,
    on: bool,
    transmit_errors: u16,
    receive_errors: u16,
    /// The state that was last reported.
    reported: State,
    /// Frames from the driver that are not in a mailbox yet.
    queue: VecDeque<HostFrame>,
    mailboxes: VecDeque<HostFrame>,
    to_host: VecDeque<HostFrame>,
    /// Frames that were on the bus, such as `501#0102`.
    sent: Vec<String>,
    /// Number of frames from the driver.
    given: usize,
    /// Number of other nodes' frames that were passed to the driver.
    heard: u64,
}

impl CandleLight {
    pub(crate) fn new() -> Self {
        Self {
            bus: Bus::Sound,
            bitrate: None,
            on: false,
            transmit_errors: 0,
            receive_errors: 0,
            reported: State::Active,
            queue: VecDeque::new(),
            mailboxes: VecDeque::new(),
            to_host: VecDeque::new(),
            sent: Vec::new(),
            given: 0,
            heard: 0,
        }
    }

    pub(crate) fn bitrate(&self) -> Option<u32> {
        self.bitrate
    }

    pub(crate) fn is_on(&self) -> bool {
        self.on
    }

    /// The frames that were on the bus since the last call, such as `501#0102`.
    pub(crate) fn sent(&mut self) -> Vec<String> {
        std::mem::take(&mut self.sent)
    }

    /// Number of frames that the driver has sent so far, whether they were on the bus or not.
    pub(crate) fn given(&self) -> usize {
        self.given
    }

    /// Number of other nodes' frames that were passed to the driver so far.
    pub(crate) fn heard(&self) -> u64 {
        self.heard
    }

    /// Changes the state of the bus.
    pub(crate) fn becomes(&mut self, bus: Bus) {
        self.bus = bus;
        self.work();
    }

    /// Another node sends a frame.
    pub(crate) fn receive_from_bus(&mut self, frame: &str) {
        self.hear(HostFrame::heard(frame, 0));
    }

    /// Another node sends this frame after others that the adapter has lost. Some firmware marks such a frame;
    /// candleLight's never does.
    pub(crate) fn hears_after_a_loss(&mut self, frame: &str) {
        self.hear(HostFrame::heard(frame, FLAG_OVERFLOW));
    }

    fn hear(&mut self, frame: HostFrame) {
        if self.on && self.state() != State::BusOff {
            self.heard += 1;
            self.to_host.push_back(frame);
            self.receive_errors = self.receive_errors.saturating_sub(1);
            self.work();
        }
    }

    /// Another node sends unreadable frames, as with another bit rate.
    pub(crate) fn hears_noise(&mut self, frames: u16) {
        for _ in 0..frames {
            self.receive_errors = (self.receive_errors + 1).min(PASSIVE);
            self.tell_state();
        }
    }

    /// Recovers from bus-off.
    pub(crate) fn restarts(&mut self, how: Restart) {
        assert_eq!(self.state(), State::BusOff);
        (self.transmit_errors, self.receive_errors) = (0, 0);
        match how {
            Restart::Firmware => {
                self.mailboxes.clear();
                self.to_host.push_back(HostFrame::error(ERROR_RESTARTED, [0; 8]));
                self.tell_state();
            }
            Restart::Controller => self.tell_state(),
            Restart::Silent => self.reported = State::Active,
        }
        self.work();
    }

    fn state(&self) -> State {
        State::of(self.transmit_errors.max(self.receive_errors))
    }

    /// Sends what can be sent, and fills the mailboxes.
    fn work(&mut self) {
        self.tell_state();
        while self.on {
            if self.mailboxes.len() < MAILBOXES
                && let Some(frame) = self.queue.pop_front()
            {
                self.to_host.push_back(frame);
                self.mailboxes.push_back(frame);
            } else if self.state() == State::BusOff || !self.try_to_send() {
                return;
            }
        }
    }

    /// Tries to send the first frame. Returns false if there is none, or if another try would change nothing.
    fn try_to_send(&mut self) -> bool {
        let Some(frame) = self.mailboxes.front() else { return false };
        match self.bus {
            Bus::Sound => {
                self.sent.push(frame.text());
                self.mailboxes.pop_front();
                self.transmit_errors = self.transmit_errors.saturating_sub(1);
            }
            // An error-passive sender does not count missing acknowledgements, so it never goes bus-off.
            Bus::Empty if self.transmit_errors >= PASSIVE => return false,
            Bus::Empty | Bus::Shorted => self.transmit_errors += 8,
        }
        self.tell_state();
        true
    }

    /// Reports the state by an error frame, if it has changed.
    fn tell_state(&mut self) {
        let state = self.state();
        if !self.on || state == self.reported {
            return;
        }
        self.reported = state;
        if state == State::BusOff {
            self.to_host.push_back(HostFrame::error(ERROR_BUS_OFF, [0; 8]));
            return;
        }
        let (sender, receiver) = (State::of(self.transmit_errors), State::of(self.receive_errors));
        let mut data = [0; 8];
        if sender >= receiver {
            data[1] |= sender.flag(1);
        }
        if receiver >= sender {
            data[1] |= receiver.flag(0);
        }
        // The counter stops here unless the node is bus-off.
        data[6] = self.transmit_errors.min(255) as u8;
        data[7] = self.receive_errors.min(255) as u8;
        self.to_host.push_back(HostFrame::error(ERROR_CONTROLLER | ERROR_COUNTERS, data));
    }

    fn start(&mut self) {
        (self.transmit_errors, self.receive_errors) = (0, 0);
        self.reported = State::Active;
        self.on = true;
        self.work();
    }

    fn stop(&mut self) {
        self.on = false;
        self.queue.clear();
        self.mailboxes.clear();
        self.to_host.clear();
    }
}

impl Function for CandleLight {
    fn control(&mut self, request: Request, data: &[u8]) -> Option<Vec<u8>> {
        let word = |index: usize| {
            let bytes = data.get(4 * index..)?.first_chunk()?;
            Some(u32::from_le_bytes(*bytes))
        };
        match (request.kind, request.code) {
            (GET_FROM_DEVICE, GET_DESCRIPTOR) => match request.value.to_be_bytes() {
                [1, _] => Some(DEVICE.to_vec()),
                [2, _] => Some(CONFIGURATION.to_vec()),
                [3, 0] => Some(vec![4, 3, 0x09, 0x04]),
                [3, _] => Some(string("candleLight without hardware")),
                _ => None,
            },
            (GET_FROM_DEVICE, GET_STATUS) => Some(vec![0, 0]),
            (SET_DEVICE | SET_INTERFACE, SET_CONFIGURATION | CLEAR_FEATURE | SET_ALTERNATE) => Some(vec![]),
            (SET, HOST_FORMAT) => Some(vec![]),
            (GET, DEVICE_CONFIG) => Some(words(&[0, 2, 1])),
            // Features, clock, limits of both segments, of the jump width, and of the prescaler.
            (GET, BIT_TIMING_LIMITS) => Some(words(&[ONE_SHOT, CLOCK, 1, 16, 1, 8, 4, 1, 1_024, 1])),
            (SET, BIT_TIMING) => {
                let (propagation, first, second, prescaler) = (word(0)?, word(1)?, word(2)?, word(4)?);
                let quanta = 1 + propagation + first + second;
                self.bitrate = Some(CLOCK.checked_div(prescaler * quanta)?);
                Some(vec![])
            }
            (SET, MODE) => {
                if word(0)? == MODE_START {
                    self.start();
                } else {
                    self.stop();
                }
                Some(vec![])
            }
            _ => None,
        }
    }

    fn take(&mut self, packet: &[u8]) {
        let frame = HostFrame(packet.try_into().expect("a frame of the driver"));
        self.given += 1;
        if self.on {
            self.queue.push_back(frame);
            self.work();
        }
    }

    fn next(&mut self) -> Option<Vec<u8>> {
        Some(self.to_host.pop_front()?.0.to_vec())
    }
}

/// A CAN controller's error state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum State {
    Active,
    Warning,
    Passive,
    BusOff,
}

impl State {
    fn of(errors: u16) -> Self {
        match errors {
            0..WARNING => Self::Active,
            WARNING..PASSIVE => Self::Warning,
            PASSIVE..BUS_OFF => Self::Passive,
            BUS_OFF.. => Self::BusOff,
        }
    }

    /// The bit in the second byte of an error frame for the receiver; the next higher one is for the sender.
    fn flag(self, place: u32) -> u8 {
        match self {
            Self::Active => 0x40,
            Self::Warning => 0x04 << place,
            Self::Passive => 0x10 << place,
            Self::BusOff => 0,
        }
    }
}

/// `struct gs_host_frame`: echo id, CAN id and flags, length, channel, flags, reserved, data.
#[derive(Debug, Clone, Copy)]
struct HostFrame([u8; 20]);

impl HostFrame {
    fn new(id: u32, flags: u8, data: &[u8]) -> Self {
        let mut bytes = [0; 20];
        bytes[..4].copy_from_slice(&NO_ECHO.to_le_bytes());
        bytes[4..8].copy_from_slice(&id.to_le_bytes());
        bytes[8] = u8::try_from(data.len()).unwrap();
        bytes[10] = flags;
        bytes[12..][..data.len()].copy_from_slice(data);
        Self(bytes)
    }

    fn error(class: u32, data: [u8; 8]) -> Self {
        Self::new(ERROR_FLAG | class, 0, &data)
    }

    /// A data frame with a standard id, from text such as `501#0102`.
    fn heard(frame: &str, flags: u8) -> Self {
        let (id, data) = frame.split_once('#').unwrap();
        let places = (0..data.len()).step_by(2);
        let data: Vec<u8> = places.map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap()).collect();
        Self::new(u32::from_str_radix(id, 16).unwrap(), flags, &data)
    }

    /// As text in the format of can-utils.
    fn text(&self) -> String {
        let id = u32::from_le_bytes(self.0[4..8].try_into().unwrap());
        let data = &self.0[12..][..usize::from(self.0[8])];
        data.iter().fold(format!("{id:03X}#"), |text, byte| format!("{text}{byte:02X}"))
    }
}

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// A string descriptor.
fn string(text: &str) -> Vec<u8> {
    let text: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let mut bytes = vec![u8::try_from(2 + text.len()).unwrap(), 3];
    bytes.extend(text);
    bytes
}

/// The device descriptor: full speed, 0x1d50:0x606f.
const DEVICE: [u8; 18] = [18, 1, 0x00, 0x02, 0, 0, 0, 64, 0x50, 0x1D, 0x6F, 0x60, 0, 0, 1, 1, 1, 1];
/// The configuration descriptor: one vendor-specific interface, with endpoints 0x81 and 0x02 for bulk transfers
/// of 64 bytes.
const CONFIGURATION: [u8; 32] = [
    9, 2, 32, 0, 1, 1, 0, 0x80, 75, // 150 mA
    9, 4, 0, 0, 2, 0xFF, 0xFF, 0xFF, 0, //
    7, 5, 0x81, 2, 64, 0, 0, //
    7, 5, 0x02, 2, 64, 0, 0,
];
/// Kinds of control requests: standard ones, and vendor-specific ones to the interface.
const GET_FROM_DEVICE: u8 = 0x80;
const SET_DEVICE: u8 = 0x00;
const SET_INTERFACE: u8 = 0x01;
const GET: u8 = 0xC1;
const SET: u8 = 0x41;
/// Standard requests.
const GET_STATUS: u8 = 0;
const CLEAR_FEATURE: u8 = 1;
const GET_DESCRIPTOR: u8 = 6;
const SET_CONFIGURATION: u8 = 9;
const SET_ALTERNATE: u8 = 11;
/// Vendor-specific requests.
const HOST_FORMAT: u8 = 0;
const BIT_TIMING: u8 = 1;
const MODE: u8 = 2;
const BIT_TIMING_LIMITS: u8 = 4;
const DEVICE_CONFIG: u8 = 5;
const MODE_START: u32 = 1;
const ONE_SHOT: u32 = 1 << 3;
/// Clock in Hz.
const CLOCK: u32 = 48_000_000;
/// Echo id of a frame that is no echo.
const NO_ECHO: u32 = u32::MAX;
/// Flag: frames were lost before this one.
const FLAG_OVERFLOW: u8 = 1;
/// Error frames (linux/can/error.h).
const ERROR_FLAG: u32 = 0x2000_0000;
const ERROR_CONTROLLER: u32 = 0x004;
const ERROR_BUS_OFF: u32 = 0x040;
const ERROR_RESTARTED: u32 = 0x100;
const ERROR_COUNTERS: u32 = 0x200;
/// Values of the error counters at which error states begin.
const WARNING: u16 = 96;
const PASSIVE: u16 = 128;
const BUS_OFF: u16 = 256;
/// Modes of the channel.
const MAILBOXES: usize = 3;
