//! The whole chip on its board: memory, core, devices and virtual time.
//!
//! In: the program, the configuration image, signals at the pins. Out: signals at the pins, the program's log,
//! and its first violation.
//!
//! Each instruction takes one cycle; while the core sleeps, time jumps to the next deadline of a device.
//! Nothing else advances time, so every run is the same on every machine. Real time is made of short runs
//! ([`crate::realtime`]).

mod flash;
mod log;

use std::collections::BTreeMap;

use defmt_decoder::StreamDecoder;

use self::flash::is_flash;
use crate::access::{Access, Violation};
use crate::board::{Board, FLASH, FLASH_SIZE, Halt};
use crate::device::*;
use crate::devices::Devices;
use crate::exception::{enter, is_return, leave, masks};
use crate::models::flash::Contents;
use crate::models::rcc::Cause;
use crate::models::scs::HARD_FAULT;
use crate::program::Program;
use crate::unicorn::{Core, Emulator, Exit, MMIO, Reg};

/// Address of the configuration image.
pub const CONFIG: u32 = 0x081C_0000;
const SYSTEM_FLASH: u32 = 0x1FF0_0000;
const UNIQUE_ID: u32 = 0x1FF1_E800;
/// RAM: address, size, and the byte it is filled with at power-on.
const RAM: [(u32, u32, u8); 2] = [(0x2000_0000, 0x2_0000, 0x5A), (0x2400_0000, 0x8_0000, 0xA5)];

/// The chip.
pub struct Chip {
    core: Core,
    board: Board,
    program: &'static Program,
    pc: u32,
    is_locked_up: bool,
    /// It is in WFE or WFI.
    is_asleep: bool,
    /// Steps since the log was read.
    steps_unread: u32,
    /// Pages of flash with other access rights in the emulator than read-only.
    pages: BTreeMap<u32, flash::PageAccess>,
    /// The range of the MPU's guard region that is in effect.
    closed: Option<(u32, u32)>,
    /// Consecutive deadlines that were not in the future.
    stalled: u32,
    decoder: Option<Box<dyn StreamDecoder + Send + Sync>>,
    /// The lines of the log, with the time at which each was read.
    pub log: Vec<(Picos, String)>,
    /// Times of the watchdog's resets.
    pub resets: Vec<Picos>,
    /// Times of the resets that the program asked for.
    pub restarts: Vec<Picos>,
    /// Faults: address of the instruction, and the bits set in CFSR.
    pub faults: Vec<(u32, u32)>,
    /// How often the core went to sleep.
    pub waits: u64,
    /// How often the power was cut.
    pub power_cuts: u64,
}

/// Why a run ended early.
#[derive(Debug)]
pub struct Stopped {
    /// What the program did wrong.
    pub violation: Violation,
    /// The function in which that happened.
    pub place: String,
}

impl std::fmt::Display for Stopped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}\n    at {}", self.violation, self.place)
    }
}

impl Chip {
    /// A board after power-on, with the program and the configuration image in flash.
    ///
    /// # Errors
    /// The emulator's library is missing.
    pub fn new(program: &'static Program, image: &[u8]) -> Result<Self, String> {
        let mut board = Board::new();
        for (address, bytes) in &program.segments {
            let place = address.checked_sub(FLASH).filter(|place| place + bytes.len() as u32 <= FLASH_SIZE);
            board.devices.flash.load(place.ok_or("a segment that is not in flash")?, bytes);
        }
        board.devices.flash.load(CONFIG - FLASH, image);
        let mut chip = Self {
            core: Core::new()?,
            board,
            program,
            pc: 0,
            is_locked_up: false,
            is_asleep: false,
            steps_unread: 0,
            pages: BTreeMap::new(),
            closed: None,
            stalled: 0,
            decoder: program.log_reader(),
            log: Vec::new(),
            resets: Vec::new(),
            restarts: Vec::new(),
            faults: Vec::new(),
            waits: 0,
            power_cuts: 0,
        };
        chip.connect()?;
        chip.fill_ram();
        chip.start()?;
        Ok(chip)
    }

    /// Connects a new core to its memory and devices.
    fn connect(&mut self) -> Result<(), String> {
        let core = &self.core;
        core.map(FLASH, FLASH_SIZE, false)?;
        core.map(SYSTEM_FLASH, 0x2_0000, false)?;
        for (address, size, _) in RAM {
            core.map(address, size, true)?;
        }
        core.engine().write(UNIQUE_ID, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        for range in MMIO {
            core.map_devices(range)?;
        }
        self.program.waits.iter().try_for_each(|address| core.watch(*address))
    }

    /// Starts the core at the reset vector. Reuses the emulator's core, which keeps its translations of the program.
    fn start(&mut self) -> Result<(), String> {
        if let Some((start, size)) = self.closed.take() {
            self.core.protect(start, size, false)?;
        }
        self.restore_flash()?;
        let engine = self.core.engine();
        engine.reset();
        engine.set(Reg::Sp, engine.word(FLASH));
        self.pc = engine.word(FLASH + 4);
        self.is_locked_up = false;
        self.is_asleep = false;
        self.decoder = self.program.log_reader();
        Ok(())
    }

    /// Fills RAM as after power-on.
    fn fill_ram(&self) {
        for (address, size, fill) in RAM {
            self.engine().write(address, &vec![fill; size as usize]);
        }
    }

    /// Makes a flash word (32 bytes) torn, as a power failure during programming does: reading it is a bus fault.
    ///
    /// # Errors
    /// The emulator refuses it.
    pub fn tear(&mut self, address: u32) -> Result<(), String> {
        self.board.devices.flash.tear(address - FLASH);
        self.close_page(address)
    }

    /// Whether all bytes from an address on are in flash.
    pub fn has_flash(&self, address: u32, len: usize) -> bool {
        let room = address.checked_sub(FLASH).and_then(|offset| FLASH_SIZE.checked_sub(offset));
        room.is_some_and(|room| len <= room as usize)
    }

    /// Programs flash without checks, like a debugger.
    ///
    /// # Panics
    /// There is no such flash.
    pub fn load(&mut self, address: u32, bytes: &[u8]) {
        self.board.devices.flash.load(address - FLASH, bytes);
        self.restore_flash().expect("there is flash");
    }

    /// Replaces the contents of flash.
    ///
    /// # Panics
    /// There is no such flash.
    pub fn hold(&mut self, contents: &Contents) {
        self.board.devices.flash.hold(contents);
        self.restore_flash().expect("there is flash");
    }

    /// The supply fails and comes back: the chip starts again with the contents of flash.
    pub fn cut_power(&mut self) {
        self.power_cuts += 1;
        self.board.reset(None);
        self.fill_ram();
        self.start().expect("it has started before");
    }

    /// Replaces instructions of the program until the next reset.
    pub fn patch(&mut self, address: u32, code: &[u8]) {
        self.engine().write(address, code);
        self.core.invalidate(address, code.len() as u32);
    }

    /// Access to memory and the core's registers.
    pub fn engine(&self) -> Emulator {
        self.core.engine()
    }

    /// The program.
    pub fn program(&self) -> &'static Program {
        self.program
    }

    /// Virtual time.
    pub fn now(&self) -> Picos {
        self.board.now
    }

    /// The models of the peripherals.
    pub fn devices(&mut self) -> &mut Devices {
        &mut self.board.devices
    }

    /// Number of executed instructions.
    pub fn instructions(&self) -> u64 {
        self.board.instructions
    }

    /// Number of interrupts and exceptions taken.
    pub fn interrupts(&self) -> u64 {
        self.board.scs.taken.iter().sum()
    }

    /// The last accesses; from now on, `keep` of them are recorded.
    pub fn accesses(&mut self, keep: usize) -> impl Iterator<Item = &Access> {
        self.board.max_accesses = keep;
        self.board.accesses.iter()
    }

    /// The program counter and its function.
    pub fn place(&self) -> String {
        self.program.place(self.pc & !1)
    }

    /// Frequencies of the clock tree.
    pub fn clocks(&self) -> Clocks {
        self.board.devices.rcc.clocks()
    }

    /// While the core sleeps: the time of the next event of a device.
    pub fn sleeps_until(&mut self) -> Option<Picos> {
        self.board.limit = Picos::MAX;
        (self.is_asleep || self.is_locked_up).then(|| self.board.deadline())
    }

    /// Runs until `end`.
    ///
    /// # Errors
    /// A violation.
    pub fn run_until(&mut self, end: Picos) -> Result<(), Stopped> {
        self.board.limit = end;
        // The caller may have changed anything since the last run.
        let engine = self.engine();
        self.board.advance(engine);
        while self.board.now < end {
            self.step(end);
            if self.board.devices.flash.has_failed() {
                self.read_log();
                self.cut_power();
            }
            self.steps_unread += 1;
            if self.is_asleep
                || self.steps_unread >= LOG_PERIOD
                || self.board.now >= end
                || self.board.violation.is_some()
            {
                self.steps_unread = 0;
                self.read_log();
            }
            if let Some(violation) = self.board.violation.clone() {
                let place = self.program.place(violation.access.pc);
                return Err(Stopped { violation, place });
            }
        }
        Ok(())
    }

    fn step(&mut self, end: Picos) {
        let engine = self.engine();
        self.board.advance_due(engine);
        if self.board.devices.watchdog.expires_at().is_some_and(|at| self.board.now >= at) {
            self.resets.push(self.board.now);
            self.reset(Cause::Watchdog);
            return;
        }
        if self.board.scs.wants_reset() {
            self.restarts.push(self.board.now);
            self.reset(Cause::Program);
            return;
        }
        if self.is_locked_up {
            self.idle(end);
            return;
        }
        if let Some(number) = self.board.scs.due(masks(engine)) {
            self.is_asleep = false;
            self.enter_exception(number, self.pc);
        }
        if self.is_asleep {
            self.wait(end);
            return;
        }
        self.update_guard();
        self.update_flash();
        let exit = self.core.run(self.pc, &mut self.board);
        self.pc = engine.reg(Reg::Pc);
        match (exit, self.board.halt.take()) {
            (_, Some(Halt::Wait(address))) => {
                self.pc = address + 2;
                self.wait(end);
            }
            (Exit::Stopped, None) => {}
            (Exit::Exception(8), None) => self.leave_exception(),
            (Exit::Exception(_) | Exit::Memory { is_fetch: true, .. }, None) if is_return(self.pc) => {
                self.leave_exception();
            }
            (Exit::Undefined | Exit::Exception(_), None) => self.fault(UNDEFINED, 0),
            (Exit::Memory { address, written: Some(written), .. }, None) if is_flash(address) => {
                self.program_flash(address, written);
            }
            (Exit::Memory { address, is_fetch: false, .. }, None)
                if is_flash(address) && self.has_torn(address) =>
            {
                self.read_torn(address);
            }
            (Exit::Memory { address, is_fetch, .. }, None) => {
                let guard = self.board.scs.guard();
                let is_guard = guard.is_some_and(|(start, size)| (start..start + size).contains(&address));
                match (is_guard, is_fetch) {
                    (true, _) => self.fault(GUARDED, address),
                    (false, true) => self.fault(FETCH, address),
                    (false, false) => self.fault(PRECISE_BUS, address),
                }
            }
        }
    }

    fn enter_exception(&mut self, number: u16, return_address: u32) {
        self.pc = enter(self.core.engine(), &mut self.board.scs, number, return_address);
        self.board.guard_changed = true;
    }

    fn leave_exception(&mut self) {
        self.pc = leave(self.core.engine(), &mut self.board.scs, self.pc);
        self.board.guard_changed = true;
    }

    fn fault(&mut self, status: u32, address: u32) {
        self.faults.push((self.pc, status));
        if self.board.scs.would_lock_up() {
            self.is_locked_up = true;
            return;
        }
        self.board.scs.record_fault(status, address, true);
        self.enter_exception(HARD_FAULT, self.pc);
    }

    fn update_guard(&mut self) {
        if !std::mem::take(&mut self.board.guard_changed) {
            return;
        }
        let guard = self.board.scs.guard();
        if guard == self.closed {
            return;
        }
        let core = &self.core;
        let opened = self.closed.take().map_or(Ok(()), |(start, size)| core.protect(start, size, false));
        let closed = guard.map_or(Ok(()), |(start, size)| core.protect(start, size, true));
        self.closed = guard;
        opened.and(closed).expect("the guard is in RAM");
    }

    /// WFE (Armv7-M ARM B1.5.18).
    fn wait(&mut self, end: Picos) {
        if std::mem::take(&mut self.board.scs.event) {
            return;
        }
        self.waits += u64::from(!self.is_asleep);
        self.is_asleep = true;
        let engine = self.engine();
        while self.board.now < end
            && self.board.scs.due(masks(engine)).is_none()
            && self.board.violation.is_none()
            && self.board.devices.watchdog.expires_at().is_none_or(|at| self.board.now < at)
        {
            self.idle(end);
        }
    }

    /// Advances time to the next event of a device.
    fn idle(&mut self, end: Picos) {
        let next = self.board.known_deadline().min(end);
        self.stalled = if next > self.board.now { 0 } else { self.stalled + 1 };
        assert!(self.stalled < 1_000, "a model's deadline does not advance: {next}");
        self.board.now = self.board.now.max(next);
        let engine = self.engine();
        self.board.advance_due(engine);
    }

    /// Resets the chip; flash and RAM keep their contents. Reads the log first, because the program then clears its
    /// buffer.
    fn reset(&mut self, cause: Cause) {
        self.read_log();
        self.board.reset(Some(cause));
        self.start().expect("it has started before");
    }
}

/// Maximum number of steps between two reads of the log.
const LOG_PERIOD: u32 = 16;
/// CFSR: UNDEFINSTR.
const UNDEFINED: u32 = 1 << 16;
/// CFSR: PRECISERR and BFARVALID.
const PRECISE_BUS: u32 = 1 << 9 | 1 << 15;
/// CFSR: IBUSERR.
const FETCH: u32 = 1 << 8;
/// CFSR: DACCVIOL and MMARVALID.
const GUARDED: u32 = 1 << 1 | 1 << 7;
