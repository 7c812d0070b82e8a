//! A candleLight adapter: its firmware's protocol (gs_usb), a CAN controller that counts errors as ISO
//! 11898-1 has it, and the bus that it is on.
//!
//! In: what the driver sends, and what happens on the bus. Out: what the driver hears, and the frames that
//! were on the bus. Refuses to know USB/IP and the kernel. Time does not pass here: a frame that can leave
//! leaves at once, what takes an adapter 100 ms is told by the test.
//!
//! As the firmware of 2026 for bxCAN does it (candleLight_fw, `src/can_common.c`, `src/can/bxcan.c`): a
//! frame is echoed when it is in one of three mailboxes, before it was on the bus.

use std::collections::VecDeque;

use super::usb::{Function, Request};

/// What frames meet on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Bus {
    /// Somebody acknowledges.
    Sound,
    /// Nobody else is there.
    Empty,
    /// No bit comes back as it was sent.
    Shorted,
}

/// How an adapter gets on the bus again after bus-off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Restart {
    /// By its firmware, which empties the mailboxes and says so: since 2026.
    Firmware,
    /// By its controller, which sends what is in the mailboxes; the firmware says that it is error-active:
    /// since 2020.
    Controller,
    /// The same, and nobody says anything: before.
    Unsaid,
}

/// The adapter.
pub(crate) struct CandleLight {
    bus: Bus,
    /// Bit/s, once the driver has set it.
    bitrate: Option<u32>,
    on: bool,
    transmit_errors: u16,
    receive_errors: u16,
    /// The state that was told last.
    told: State,
    /// From the driver, not in a mailbox yet.
    queue: VecDeque<HostFrame>,
    mailboxes: VecDeque<HostFrame>,
    to_host: VecDeque<HostFrame>,
    /// Frames that were on the bus, as `501#0102`.
    sent: Vec<String>,
    /// How many the driver has sent.
    given: usize,
    /// How many frames of others the driver was told.
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
            told: State::Active,
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

    /// The frames that were on the bus since the last call, as `501#0102`.
    pub(crate) fn sent(&mut self) -> Vec<String> {
        std::mem::take(&mut self.sent)
    }

    /// How many frames the driver has sent so far, whatever became of them.
    pub(crate) fn given(&self) -> usize {
        self.given
    }

    /// How many frames of others the driver was told so far.
    pub(crate) fn heard(&self) -> u64 {
        self.heard
    }

    /// The bus is like this from now on.
    pub(crate) fn becomes(&mut self, bus: Bus) {
        self.bus = bus;
        self.work();
    }

    /// Somebody else sends a frame.
    pub(crate) fn hears(&mut self, frame: &str) {
        self.hear(HostFrame::heard(frame, 0));
    }

    /// Somebody else sent more than the adapter could keep, and then this. Firmware that tells of it
    /// marks the frame; candleLight's own never does.
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

    /// Somebody else sends frames that cannot be read, at another bit rate perhaps.
    pub(crate) fn hears_noise(&mut self, frames: u16) {
        for _ in 0..frames {
            self.receive_errors = (self.receive_errors + 1).min(PASSIVE);
            self.tell_state();
        }
    }

    /// Gets on the bus again after bus-off.
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
            Restart::Unsaid => self.told = State::Active,
        }
        self.work();
    }

    fn state(&self) -> State {
        State::of(self.transmit_errors.max(self.receive_errors))
    }

    /// Whatever can be done now is done.
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

    /// Tries to send the first frame. `false` when there is none, or when trying again changes nothing.
    fn try_to_send(&mut self) -> bool {
        let Some(frame) = self.mailboxes.front() else { return false };
        match self.bus {
            Bus::Sound => {
                self.sent.push(frame.text());
                self.mailboxes.pop_front();
                self.transmit_errors = self.transmit_errors.saturating_sub(1);
            }
            // An error-passive sender does not count that nobody acknowledges: it never goes bus-off.
            Bus::Empty if self.transmit_errors >= PASSIVE => return false,
            Bus::Empty | Bus::Shorted => self.transmit_errors += 8,
        }
        self.tell_state();
        true
    }

    /// An error frame, if the state is another than the one that was told.
    fn tell_state(&mut self) {
        let state = self.state();
        if !self.on || state == self.told {
            return;
        }
        self.told = state;
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
        // It counts no further than this, once it is not bus-off.
        data[6] = self.transmit_errors.min(255) as u8;
        data[7] = self.receive_errors.min(255) as u8;
        self.to_host.push_back(HostFrame::error(ERROR_CONTROLLER | ERROR_COUNTERS, data));
    }

    fn start(&mut self) {
        (self.transmit_errors, self.receive_errors) = (0, 0);
        self.told = State::Active;
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
            // Features, clock, bounds of both segments, of the jump width, and of the prescaler.
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

    /// In the second byte of an error frame: of the receiver, or, one place higher, of the sender.
    fn flag(self, place: u32) -> u8 {
        match self {
            Self::Active => 0x40,
            Self::Warning => 0x04 << place,
            Self::Passive => 0x10 << place,
            Self::BusOff => 0,
        }
    }
}

/// `struct gs_host_frame`: which echo it is, id and flags, length, channel, flags, reserved, data.
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

    /// A data frame with a standard id, from its text.
    fn heard(frame: &str, flags: u8) -> Self {
        let (id, data) = frame.split_once('#').unwrap();
        let places = (0..data.len()).step_by(2);
        let data: Vec<u8> = places.map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap()).collect();
        Self::new(u32::from_str_radix(id, 16).unwrap(), flags, &data)
    }

    /// As can-utils write it.
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

/// Full speed, 0x1d50:0x606f.
const DEVICE: [u8; 18] = [18, 1, 0x00, 0x02, 0, 0, 0, 64, 0x50, 0x1D, 0x6F, 0x60, 0, 0, 1, 1, 1, 1];
/// One interface of the vendor's class, with endpoints 0x81 and 0x02 for bulk transfers of 64 bytes.
const CONFIGURATION: [u8; 32] = [
    9, 2, 32, 0, 1, 1, 0, 0x80, 75, // 150 mA
    9, 4, 0, 0, 2, 0xFF, 0xFF, 0xFF, 0, //
    7, 5, 0x81, 2, 64, 0, 0, //
    7, 5, 0x02, 2, 64, 0, 0,
];
/// Kinds of control requests: of USB itself, and the vendor's to the interface.
const GET_FROM_DEVICE: u8 = 0x80;
const SET_DEVICE: u8 = 0x00;
const SET_INTERFACE: u8 = 0x01;
const GET: u8 = 0xC1;
const SET: u8 = 0x41;
/// USB's own.
const GET_STATUS: u8 = 0;
const CLEAR_FEATURE: u8 = 1;
const GET_DESCRIPTOR: u8 = 6;
const SET_CONFIGURATION: u8 = 9;
const SET_ALTERNATE: u8 = 11;
/// The vendor's.
const HOST_FORMAT: u8 = 0;
const BIT_TIMING: u8 = 1;
const MODE: u8 = 2;
const BIT_TIMING_LIMITS: u8 = 4;
const DEVICE_CONFIG: u8 = 5;
const MODE_START: u32 = 1;
const ONE_SHOT: u32 = 1 << 3;
/// Hz.
const CLOCK: u32 = 48_000_000;
/// Of a frame that is no echo.
const NO_ECHO: u32 = u32::MAX;
/// Frames were lost before this one.
const FLAG_OVERFLOW: u8 = 1;
/// Error frames, as Linux has them in linux/can/error.h.
const ERROR_FLAG: u32 = 0x2000_0000;
const ERROR_CONTROLLER: u32 = 0x004;
const ERROR_BUS_OFF: u32 = 0x040;
const ERROR_RESTARTED: u32 = 0x100;
const ERROR_COUNTERS: u32 = 0x200;
/// Where error states begin.
const WARNING: u16 = 96;
const PASSIVE: u16 = 128;
const BUS_OFF: u16 = 256;
/// Of the controller.
const MAILBOXES: usize = 3;
