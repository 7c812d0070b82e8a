//! What the core's accesses meet: the devices in virtual time, with their clocks looked after and each
//! access noted.

mod blocks;

use std::collections::VecDeque;

use self::blocks::FOR_EVER;
use crate::access::{Access, Violation};
use crate::device::*;
use crate::devices::{CAN, Devices, Id, MAP};
use crate::exception::masks;
use crate::models::scs::Scs;
use crate::program::SEV;
use crate::unicorn::{Engine, Flow, Handler, Reg, SYSTEM};

/// Why a handler stopped the core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Halt {
    /// It waits for an event, at the instruction before this address.
    Wait(u32),
}

/// Devices, time, and what is noted of them.
pub(crate) struct Board {
    pub(crate) devices: Devices,
    pub(crate) scs: Scs,
    pub(crate) now: Picos,
    /// Up to here the core runs on its own.
    pub(crate) limit: Picos,
    pub(crate) halt: Option<Halt>,
    pub(crate) violation: Option<Violation>,
    pub(crate) guard_changed: bool,
    /// The next instruction is executed, whatever is due.
    pub(crate) is_forced: bool,
    /// The last accesses.
    pub(crate) accesses: VecDeque<Access>,
    pub(crate) keep: usize,
    pub(crate) instructions: u64,
    functions: Functions,
    clocks: Clocks,
    cycle: Picos,
    deadline: Picos,
    is_wanted: bool,
    /// Instructions of the blocks of flash that were met: length in bytes, and number.
    blocks: Vec<(u16, u16)>,
}

impl Board {
    pub(crate) fn new() -> Self {
        let mut board = Self {
            devices: Devices::new(),
            scs: Scs::new(),
            now: 0,
            limit: 0,
            halt: None,
            violation: None,
            guard_changed: false,
            is_forced: false,
            accesses: VecDeque::new(),
            keep: 64,
            instructions: 0,
            functions: [[None; 16]; 11],
            clocks: Clocks::default(),
            cycle: 1,
            deadline: 0,
            is_wanted: false,
            blocks: vec![(0, 0); FLASH_SIZE as usize / 2],
        };
        board.follow_clocks();
        board
    }

    /// Everything but time and what is outside of the chip.
    pub(crate) fn reset(&mut self, by_watchdog: bool) {
        for place in &MAP {
            if place.id != Id::Rcc {
                self.devices.device(place.id).reset();
            }
        }
        if by_watchdog {
            self.devices.rcc.reset_by_watchdog();
        } else {
            self.devices.rcc.reset();
        }
        self.scs.reset();
        self.functions = [[None; 16]; 11];
        self.halt = None;
        self.guard_changed = true;
        self.follow_clocks();
    }

    fn follow_clocks(&mut self) {
        self.clocks = self.devices.rcc.clocks();
        self.cycle = cycle(self.clocks.core);
        self.refresh();
    }

    /// Runs `act` on the devices with what they may know.
    fn with<T>(&mut self, act: impl FnOnce(&mut Devices, &mut Scs, &Moment<'_>) -> T) -> T {
        let is_rmii = self.devices.syscfg.is_rmii();
        let at = Moment { now: self.now, clocks: self.clocks, functions: &self.functions, is_rmii };
        act(&mut self.devices, &mut self.scs, &at)
    }

    /// Deadline and interrupts as they are now.
    fn refresh(&mut self) {
        let (deadline, is_wanted) = self.with(|devices, scs, at| {
            let mut deadline = scs.deadline().unwrap_or(Picos::MAX);
            for place in MAP.iter().filter(|place| place.changes_with_time()) {
                let device = devices.device(place.id);
                deadline = deadline.min(device.deadline(at).unwrap_or(Picos::MAX));
                if let Some(line) = place.line {
                    scs.set_line(line, device.interrupts());
                }
            }
            (deadline, scs.wanted().is_some())
        });
        self.deadline = deadline.min(self.limit);
        self.is_wanted = is_wanted;
    }

    /// When something is due next.
    pub(crate) fn deadline(&mut self) -> Picos {
        self.refresh();
        self.deadline
    }

    /// All devices do what is due by now.
    pub(crate) fn advance(&mut self, core: Engine) {
        let refused = self.with(|devices, scs, at| {
            scs.advance(at);
            let mut memory = core;
            for place in MAP.iter().filter(|place| place.changes_with_time()) {
                let result = devices.device(place.id).advance(at);
                let result = match place.id {
                    Id::Ethernet => result.and_then(|()| devices.ethernet.transfer(&mut memory, at)),
                    _ => result,
                };
                if let Err(refusal) = result {
                    return Some((place.name, refusal));
                }
            }
            None
        });
        if let Some((peripheral, Refusal(reason))) = refused {
            let access = Access {
                at: self.now,
                pc: core.reg(Reg::Pc),
                peripheral,
                register: String::new(),
                value: 0,
                is_write: false,
                times: 0,
            };
            self.violation.get_or_insert(Violation { access, reason });
        }
        self.refresh();
    }

    /// The program writes to flash.
    pub(crate) fn program_flash(&mut self, pc: u32, offset: u32, bytes: &[u8]) {
        let mut value = [0; 4];
        value[..bytes.len()].copy_from_slice(bytes);
        let access = Access {
            at: self.now,
            pc,
            peripheral: "flash",
            register: format!("[{offset:06X}]"),
            value: u32::from_le_bytes(value),
            is_write: true,
            times: 1,
        };
        if let Err(Refusal(reason)) = self.devices.flash.program(offset, bytes, self.now) {
            self.violation.get_or_insert(Violation { access: access.clone(), reason });
        }
        self.note(access);
        self.refresh();
    }

    fn note(&mut self, access: Access) {
        if let Some(last) = self.accesses.back_mut()
            && (last.pc, last.peripheral, last.value, last.is_write)
                == (access.pc, access.peripheral, access.value, access.is_write)
            && last.register == access.register
        {
            last.times += 1;
            return;
        }
        if self.accesses.len() >= self.keep {
            self.accesses.pop_front();
        }
        self.accesses.push_back(access);
    }

    fn reach(&mut self, core: Engine, address: u32, size: u32, value: Option<u32>) -> u32 {
        let (name, register, result) = if address >= SYSTEM {
            let offset = address.wrapping_sub(0xE000_E000);
            let result = self.with(|_, scs, at| match value {
                Some(value) => scs.write(offset, value, size, at).map(|()| value),
                None => scs.read(offset, size, at),
            });
            self.guard_changed |= value.is_some() && (0xD90..0xDB0).contains(&offset);
            ("core", Scs::name(offset), result)
        } else {
            self.reach_device(address, size, value)
        };
        let is_write = value.is_some();
        let access = Access {
            at: self.now,
            pc: core.reg(Reg::Pc),
            peripheral: name,
            register,
            value: *result.as_ref().ok().or(value.as_ref()).unwrap_or(&0),
            is_write,
            times: 1,
        };
        if let Err(Refusal(reason)) = &result {
            self.violation.get_or_insert(Violation { access: access.clone(), reason: reason.clone() });
        }
        self.note(access);
        if is_write && name == "RCC" {
            self.follow_resets();
            self.follow_clocks();
            self.check_speed();
        }
        if is_write && name.starts_with("GPIO") {
            self.functions = std::array::from_fn(|index| self.devices.gpio[index].functions());
        }
        if is_write {
            self.advance(core);
        } else {
            self.refresh();
        }
        result.unwrap_or(0)
    }

    fn reach_device(
        &mut self,
        address: u32,
        size: u32,
        value: Option<u32>,
    ) -> (&'static str, String, Result<u32, Refusal>) {
        let found = MAP.iter().find(|place| (place.base..place.base + place.size).contains(&address));
        let Some(place) = found else {
            return ("nothing", format!("{address:08X}"), refuse("there is nothing that is modelled"));
        };
        let offset = address - place.base;
        if place.id == Id::CanRam {
            let word = (offset / 4) as usize;
            let can = &mut self.devices.can;
            let result = self.devices.rcc.check(CAN.expect("it has one")).and_then(|()| match value {
                _ if size != 4 => refuse("32 bits at a time"),
                Some(value) => can.ram_write(word, value).map(|()| value),
                None => can.ram_read(word),
            });
            return (place.name, format!("[{word}]"), result);
        }
        let result = self.with(|devices, _, at| {
            if let Some(gate) = place.gate {
                devices.rcc.check(gate)?;
            }
            if value.is_none() {
                devices.rcc.settle();
            }
            let device = devices.device(place.id);
            match value {
                Some(_) if size != 4 && !(size == 2 && device.takes_halves()) => {
                    refuse(format!("a write of {} bits", 8 * size))
                }
                Some(value) => device.write(offset, value, at).map(|()| value),
                None => {
                    let word = device.read(offset & !3, at)?;
                    Ok((word >> (8 * (offset & 3))) & (u32::MAX >> (32 - 8 * size)))
                }
            }
        });
        let registers = self.devices.device(place.id).registers();
        let register = registers.iter().find(|register| register.offset == offset & !3);
        let register = register.map_or_else(|| format!("+{offset:03X}"), |register| register.name.into());
        (place.name, register, result)
    }

    /// What is held in reset is as after a reset.
    fn follow_resets(&mut self) {
        for place in &MAP {
            if place.gate.is_some_and(|gate| self.devices.rcc.is_held(gate)) {
                self.devices.device(place.id).reset();
            }
        }
    }

    /// Whether voltage and flash can keep up with the clock.
    fn check_speed(&mut self) {
        let (clocks, fastest) = (self.clocks, self.devices.pwr.fastest(self.now));
        let reason = if clocks.core > fastest {
            format!("the core runs at {} Hz, its voltage allows {fastest}", clocks.core)
        } else if let Err(Refusal(reason)) = self.devices.flash.check_speed(clocks.hclk) {
            reason
        } else {
            return;
        };
        if let Some(access) = self.accesses.back().cloned() {
            self.violation.get_or_insert(Violation { access, reason });
        }
    }
}

impl Handler for Board {
    fn read(&mut self, core: Engine, address: u32, size: u32) -> u32 {
        self.reach(core, address, size, None)
    }

    fn write(&mut self, core: Engine, address: u32, value: u32, size: u32) {
        self.reach(core, address, size, Some(value));
    }

    fn block(&mut self, core: Engine, address: u32, len: u32) -> Flow {
        let is_asked = self.violation.is_some() || self.halt.is_some() || self.guard_changed;
        let is_over = self.now >= self.deadline || is_asked;
        let is_over = is_over || self.is_wanted && self.scs.due(masks(core)).is_some();
        if is_over && !self.is_forced {
            return Flow::Stop;
        }
        let count = self.count(core, address, len);
        if count == u64::from(FOR_EVER) {
            // Nothing but an interrupt leads out of it.
            self.now = self.now.max(self.deadline);
            return Flow::Stop;
        }
        self.instructions += count;
        self.now += count * self.cycle;
        Flow::On
    }

    fn watched(&mut self, core: Engine, address: u32) -> Flow {
        match core.word(address) as u16 {
            SEV => {
                self.scs.event = true;
                Flow::On
            }
            _ => {
                self.halt = Some(Halt::Wait(address));
                Flow::Stop
            }
        }
    }
}

/// Where flash is.
pub(crate) const FLASH: u32 = 0x0800_0000;
/// Both banks.
pub(crate) const FLASH_SIZE: u32 = 0x20_0000;
