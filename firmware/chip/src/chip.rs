//! The whole chip on its board: memory, core, devices and virtual time.
//!
//! In: the program, the configuration image, what happens at the pins. Out: what the program did there,
//! its log, and the first thing it was not allowed to do.
//!
//! Time is counted in instructions, one a cycle; while the core waits for an event it jumps to the next
//! deadline of a device. Nothing else moves it, so a run is the same each time and everywhere. A run
//! that keeps pace with the clock on the wall is made of short ones ([`crate::realtime`]).

use defmt_decoder::StreamDecoder;

use crate::board::{Access, Board, Devices, FLASH, FLASH_SIZE, Halt, Violation};
use crate::device::*;
use crate::exception::{enter, is_return, leave, masks};
use crate::models::scs::HARD_FAULT;
use crate::program::{Program, texts};
use crate::unicorn::{Core, Engine, Exit, MMIO, Reg};

/// Where the configuration image is.
pub const CONFIG: u32 = 0x081C_0000;
const SYSTEM_FLASH: u32 = 0x1FF0_0000;
const UNIQUE_ID: u32 = 0x1FF1_E800;
/// RAM: start, size, and what it holds when power has come.
const RAM: [(u32, u32, u8); 2] = [(0x2000_0000, 0x2_0000, 0x5A), (0x2400_0000, 0x8_0000, 0xA5)];

/// The chip.
pub struct Chip {
    core: Core,
    board: Board,
    program: &'static Program,
    image: Vec<u8>,
    /// Flash words whose check bits do not match.
    torn: Vec<u32>,
    pc: u32,
    is_locked_up: bool,
    /// It waits for an event.
    is_asleep: bool,
    /// Steps since the log was read.
    unread: u32,
    /// Start and size of the memory that nobody reaches.
    closed: Option<(u32, u32)>,
    /// Times in a row that a deadline was not ahead.
    stuck: u32,
    decoder: Option<Box<dyn StreamDecoder + Send + Sync>>,
    /// Each line of the log, and when it was read.
    pub log: Vec<(Picos, String)>,
    /// When the watchdog has reset the chip.
    pub resets: Vec<Picos>,
    /// Where the program faulted: the instruction, CFSR's new bits.
    pub faults: Vec<(u32, u32)>,
    /// How often the core waited for an event with nothing to do.
    pub waits: u64,
}

/// Why a run ended early.
#[derive(Debug)]
pub struct Stopped {
    /// What was not allowed.
    pub violation: Violation,
    /// Where that is.
    pub place: String,
}

impl std::fmt::Display for Stopped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}\n    at {}", self.violation, self.place)
    }
}

impl Chip {
    /// The board with that program, and a configuration image in flash; power has just come.
    ///
    /// # Errors
    /// The library is missing.
    pub fn new(program: &'static Program, image: &[u8]) -> Result<Self, String> {
        let mut flash = vec![0xFF; FLASH_SIZE as usize];
        for (address, bytes) in &program.segments {
            let place = address.checked_sub(FLASH).ok_or("a segment that is not in flash")? as usize;
            flash.get_mut(place..place + bytes.len()).ok_or("too long")?.copy_from_slice(bytes);
        }
        flash[(CONFIG - FLASH) as usize..][..image.len()].copy_from_slice(image);
        let mut chip = Self {
            core: Core::new()?,
            board: Board::new(),
            program,
            image: flash,
            torn: Vec::new(),
            pc: 0,
            is_locked_up: false,
            is_asleep: false,
            unread: 0,
            closed: None,
            stuck: 0,
            decoder: program.log_reader(),
            log: Vec::new(),
            resets: Vec::new(),
            faults: Vec::new(),
            waits: 0,
        };
        let ram = RAM.map(|(_, size, fill)| vec![fill; size as usize]);
        chip.start(&ram)?;
        Ok(chip)
    }

    /// A new core with that RAM, at the reset vector.
    fn start(&mut self, ram: &[Vec<u8>; 2]) -> Result<(), String> {
        self.core = Core::new()?;
        let core = &self.core;
        core.map(FLASH, FLASH_SIZE, false)?;
        core.map(SYSTEM_FLASH, 0x2_0000, false)?;
        for ((address, size, _), bytes) in RAM.iter().zip(ram) {
            core.map(*address, *size, true)?;
            core.engine().write(*address, bytes);
        }
        core.engine().write(FLASH, &self.image);
        core.engine().write(UNIQUE_ID, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        for range in MMIO {
            core.devices(range)?;
        }
        for address in &self.program.waits {
            core.watch(*address)?;
        }
        for address in &self.torn {
            core.watch_reads(*address, address + 31)?;
        }
        let engine = core.engine();
        engine.set(Reg::Sp, engine.word(FLASH));
        engine.set(Reg::Lr, u32::MAX);
        self.pc = engine.word(FLASH + 4);
        self.is_locked_up = false;
        self.is_asleep = false;
        self.closed = None;
        Ok(())
    }

    /// A flash word (32 bytes) whose writing was cut off: reading it is a bus fault from the next start on.
    ///
    /// # Errors
    /// The library does not take it.
    pub fn tear(&mut self, address: u32) -> Result<(), String> {
        self.torn.push(address & !31);
        self.core.watch_reads(address & !31, (address & !31) + 31)
    }

    /// Another instruction in the program, until the next reset.
    pub fn patch(&mut self, address: u32, code: &[u8]) {
        self.engine().write(address, code);
        self.core.forget(address, code.len() as u32);
    }

    /// Memory and registers.
    pub fn engine(&self) -> Engine {
        self.core.engine()
    }

    /// The program.
    pub fn program(&self) -> &'static Program {
        self.program
    }

    /// The present.
    pub fn now(&self) -> Picos {
        self.board.now
    }

    /// The models.
    pub fn devices(&mut self) -> &mut Devices {
        &mut self.board.devices
    }

    /// Instructions that were executed.
    pub fn instructions(&self) -> u64 {
        self.board.instructions
    }

    /// Interrupts and exceptions that were taken.
    pub fn interrupts(&self) -> u64 {
        self.board.scs.taken.iter().sum()
    }

    /// The last accesses, and how many are kept from now on.
    pub fn accesses(&mut self, keep: usize) -> impl Iterator<Item = &Access> {
        self.board.keep = keep;
        self.board.accesses.iter()
    }

    /// Where the program is.
    pub fn place(&self) -> String {
        self.program.place(self.pc & !1)
    }

    /// The clock tree.
    pub fn clocks(&self) -> Clocks {
        self.board.devices.rcc.clocks()
    }

    /// While the core waits for an event: when a device will do something next.
    pub fn sleeps_until(&mut self) -> Option<Picos> {
        self.board.limit = Picos::MAX;
        (self.is_asleep || self.is_locked_up).then(|| self.board.deadline())
    }

    /// Runs up to an instant.
    ///
    /// # Errors
    /// The program did what it may not.
    pub fn run_until(&mut self, end: Picos) -> Result<(), Stopped> {
        while self.board.now < end {
            self.board.limit = end;
            self.step(end);
            self.unread += 1;
            if self.is_asleep || self.unread >= LOG_PERIOD || self.board.now >= end || self.board.violation.is_some() {
                self.unread = 0;
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
        self.board.advance(engine);
        if self.board.devices.watchdog.bites().is_some_and(|at| self.board.now >= at) {
            self.bite();
            return;
        }
        if self.is_locked_up {
            self.idle(end);
            return;
        }
        if let Some(number) = self.board.scs.due(masks(engine)) {
            self.is_asleep = false;
            self.take(number, self.pc);
        }
        if self.is_asleep {
            self.wait(end);
            return;
        }
        self.follow_guard();
        let exit = self.core.run(self.pc, &mut self.board);
        self.pc = engine.reg(Reg::Pc);
        match (exit, self.board.halt.take()) {
            (_, Some(Halt::Wait(address))) => {
                self.pc = address + 2;
                self.wait(end);
            }
            (_, Some(Halt::Torn(address, pc))) => {
                self.pc = pc;
                self.fault(PRECISE_BUS, address);
            }
            (Exit::Stopped, None) => {}
            (Exit::Exception(8), None) => self.leave(),
            (Exit::Exception(_) | Exit::Memory { is_fetch: true, .. }, None) if is_return(self.pc) => {
                self.leave();
            }
            (Exit::Undefined | Exit::Exception(_), None) => self.fault(UNDEFINED, 0),
            (Exit::Memory { address, is_fetch }, None) => {
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

    fn take(&mut self, number: u16, return_address: u32) {
        self.pc = enter(self.core.engine(), &mut self.board.scs, number, return_address);
        self.board.guard_changed = true;
    }

    fn leave(&mut self) {
        self.pc = leave(self.core.engine(), &mut self.board.scs, self.pc);
        self.board.guard_changed = true;
    }

    fn fault(&mut self, status: u32, address: u32) {
        self.faults.push((self.pc, status));
        if self.board.scs.would_lock_up() {
            self.is_locked_up = true;
            return;
        }
        self.board.scs.note_fault(status, address, true);
        self.take(HARD_FAULT, self.pc);
    }

    fn follow_guard(&mut self) {
        if !std::mem::take(&mut self.board.guard_changed) {
            return;
        }
        // Each change makes the library forget where memory is.
        let guard = self.board.scs.guard();
        if guard == self.closed {
            return;
        }
        let (start, size, _) = RAM[0];
        let opened = self.core.guard(start, size, false);
        let closed = guard.map(|(start, size)| self.core.guard(start, size, true));
        opened.and(closed.unwrap_or(Ok(()))).expect("the guard is in the DTCM");
        self.closed = guard;
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
            && self.board.devices.watchdog.bites().is_none_or(|at| self.board.now < at)
        {
            self.idle(end);
        }
    }

    /// Nothing runs until a device has something to do.
    fn idle(&mut self, end: Picos) {
        let next = self.board.deadline().min(end);
        self.stuck = if next > self.board.now { 0 } else { self.stuck + 1 };
        assert!(self.stuck < 1_000, "a model's deadline is over and over: {next}");
        self.board.now = self.board.now.max(next);
        let engine = self.engine();
        self.board.advance(engine);
    }

    /// The watchdog resets the chip; RAM keeps what it holds.
    fn bite(&mut self) {
        self.resets.push(self.board.now);
        let engine = self.engine();
        let ram = RAM.map(|(address, size, _)| {
            let mut bytes = vec![0; size as usize];
            engine.read(address, &mut bytes);
            bytes
        });
        self.board.reset(true);
        self.start(&ram).expect("it has started before");
        self.decoder = self.program.log_reader();
    }

    /// What the debugger reads of the log: the ring of the first channel (SEGGER's RTT).
    fn read_log(&mut self) {
        let engine = self.core.engine();
        let Some(channel) = self.program.rtt.map(|address| address + 24) else { return };
        let mut words = [0; 16];
        engine.read(channel + 4, &mut words);
        let word = |index: usize| u32::from_le_bytes(words[4 * index..][..4].try_into().expect("four"));
        let (buffer, size, write, read) = (word(0), word(1), word(2), word(3));
        let is_ring = buffer >= RAM[1].0 && size <= 0x1_0000 && write < size && read < size;
        if !is_ring || write == read {
            return;
        }
        let mut bytes = vec![0; size as usize];
        engine.read(buffer, &mut bytes);
        bytes.rotate_left(read as usize);
        bytes.truncate(((write + size - read) % size) as usize);
        engine.write(channel + 16, &write.to_le_bytes());
        if let Some(decoder) = &mut self.decoder {
            let now = self.board.now;
            self.log.extend(texts(decoder.as_mut(), &bytes).into_iter().map(|text| (now, text)));
        }
    }
}

/// The log is read at least each so many steps.
const LOG_PERIOD: u32 = 16;
/// Of CFSR: an instruction that there is not.
const UNDEFINED: u32 = 1 << 16;
/// A precise bus fault, with its address.
const PRECISE_BUS: u32 = 1 << 9 | 1 << 15;
/// A fetch from where nothing is.
const FETCH: u32 = 1 << 8;
/// An access to the guard, with its address.
const GUARDED: u32 = 1 << 1 | 1 << 7;
