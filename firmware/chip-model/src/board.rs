//! The bus: routes the core's accesses to the devices, advances these in virtual time, checks clocks and
//! resets, and records each access.

mod blocks;

use std::borrow::Cow;
use std::collections::VecDeque;

use self::blocks::ENDLESS;
use crate::access::{Access, Violation};
use crate::device::*;
use crate::devices::{CAN, DeviceEntry, Devices, Id, MAP};
use crate::exception::masks;
use crate::models::rcc::Cause;
use crate::models::scs::Scs;
use crate::program::SEV;
use crate::unicorn::{Emulator, Flow, Handler, Reg, SYSTEM};

/// Why a handler stopped the core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Halt {
    /// At the WFE or WFI at this address.
    Wait(u32),
}

/// Devices, virtual time and the access record.
pub(crate) struct Board {
    pub(crate) devices: Devices,
    pub(crate) scs: Scs,
    pub(crate) now: Picos,
    /// The core runs at most up to this time.
    pub(crate) limit: Picos,
    pub(crate) halt: Option<Halt>,
    pub(crate) violation: Option<Violation>,
    pub(crate) guard_changed: bool,
    /// Execute the next instruction even if something is due.
    pub(crate) is_single_step: bool,
    /// The last accesses.
    pub(crate) accesses: VecDeque<Access>,
    pub(crate) max_accesses: usize,
    pub(crate) instructions: u64,
    functions: Functions,
    clocks: Clocks,
    cycle: Picos,
    deadline: Picos,
    has_pending: bool,
    /// Time of the next event at each place of [`MAP`].
    next: [Picos; MAP.len()],
    /// Length in bytes and number of instructions of each basic block seen in flash, by its address.
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
            is_single_step: false,
            accesses: VecDeque::new(),
            max_accesses: 64,
            instructions: 0,
            functions: [[None; 16]; 11],
            clocks: Clocks::default(),
            cycle: 1,
            deadline: 0,
            has_pending: false,
            next: [Picos::MAX; MAP.len()],
            blocks: vec![(0, 0); FLASH_SIZE as usize / 2],
        };
        board.update_clocks();
        board
    }

    /// Resets the chip, without a cause at power-on; virtual time and what is outside the chip stay as they are.
    pub(crate) fn reset(&mut self, cause: Option<Cause>) {
        for place in &MAP {
            if place.id != Id::Rcc {
                self.devices.device(place.id).reset();
            }
        }
        match cause {
            Some(cause) => self.devices.rcc.reset_by(cause),
            None => self.devices.rcc.reset(),
        }
        self.scs.reset();
        self.functions = [[None; 16]; 11];
        self.halt = None;
        self.guard_changed = true;
        self.update_clocks();
    }

    fn update_clocks(&mut self) {
        self.clocks = self.devices.rcc.clocks();
        self.cycle = cycle(self.clocks.core);
        self.refresh();
    }

    /// Calls `act` with the devices and the present [`Context`].
    fn with_devices<T>(&mut self, act: impl FnOnce(&mut Devices, &mut Scs, &Context<'_>) -> T) -> T {
        let is_rmii = self.devices.syscfg.is_rmii();
        let at = Context { now: self.now, clocks: self.clocks, functions: &self.functions, is_rmii };
        act(&mut self.devices, &mut self.scs, &at)
    }

    /// Updates the next event and the interrupt line of each device.
    fn refresh(&mut self) {
        self.refresh_those(|_, _| true);
    }

    /// As [`Self::refresh`], for the devices for which `is_meant` is true: only these can have changed.
    fn refresh_those(&mut self, is_meant: impl Fn(&DeviceEntry, Picos) -> bool) {
        let mut next = self.next;
        let (deadline, has_pending) = self.with_devices(|devices, scs, at| {
            let mut deadline = scs.deadline().unwrap_or(Picos::MAX);
            for (place, next) in MAP.iter().zip(&mut next).filter(|(place, _)| place.changes_with_time()) {
                if is_meant(place, *next) {
                    let device = devices.device(place.id);
                    *next = device.deadline(at).unwrap_or(Picos::MAX);
                    if let Some(line) = place.line {
                        scs.set_line(line, device.interrupt_line());
                    }
                }
                deadline = deadline.min(*next);
            }
            (deadline, scs.most_urgent().is_some())
        });
        self.next = next;
        self.deadline = deadline.min(self.limit);
        self.has_pending = has_pending;
    }

    /// Time of the next event of any device. Takes into account what was done to devices from outside the board.
    pub(crate) fn deadline(&mut self) -> Picos {
        self.refresh();
        self.deadline
    }

    /// As [`Self::deadline`], if nothing was done to devices from outside the board.
    pub(crate) fn known_deadline(&self) -> Picos {
        self.deadline
    }

    /// Lets all devices do what is due.
    pub(crate) fn advance(&mut self, core: Emulator) {
        self.advance_those(core, |_, _| true);
    }

    /// As [`Self::advance`], if nothing but time has changed since the last call or the last access.
    pub(crate) fn advance_due(&mut self, core: Emulator) {
        let now = self.now;
        self.advance_those(core, |_, next| next <= now);
    }

    fn advance_those(&mut self, core: Emulator, is_meant: impl Fn(&DeviceEntry, Picos) -> bool) {
        let next = self.next;
        let refused = self.with_devices(|devices, scs, at| {
            scs.advance(at);
            let mut memory = core;
            let places = MAP.iter().zip(next).filter(|(place, _)| place.changes_with_time());
            for (place, _) in places.filter(|(place, next)| is_meant(place, *next)) {
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
                register: "".into(),
                value: 0,
                is_write: false,
                times: 0,
            };
            self.violation.get_or_insert(Violation { access, reason });
        }
        self.refresh_those(is_meant);
    }

    /// A write by the program to flash memory.
    pub(crate) fn program_flash(&mut self, pc: u32, offset: u32, bytes: &[u8]) {
        let mut value = [0; 4];
        value[..bytes.len()].copy_from_slice(bytes);
        let access = Access {
            at: self.now,
            pc,
            peripheral: "flash",
            register: format!("[{offset:06X}]").into(),
            value: u32::from_le_bytes(value),
            is_write: true,
            times: 1,
        };
        if let Err(Refusal(reason)) = self.devices.flash.program(offset, bytes, self.now) {
            self.violation.get_or_insert(Violation { access: access.clone(), reason });
        }
        self.record(access);
        self.refresh_those(|place, _| place.id == Id::Flash);
    }

    fn record(&mut self, access: Access) {
        if let Some(last) = self.accesses.back_mut()
            && (last.pc, last.peripheral, last.value, last.is_write)
                == (access.pc, access.peripheral, access.value, access.is_write)
            && last.register == access.register
        {
            last.times += 1;
            return;
        }
        if self.accesses.len() >= self.max_accesses {
            self.accesses.pop_front();
        }
        self.accesses.push_back(access);
    }

    fn access(&mut self, core: Emulator, address: u32, size: u32, value: Option<u32>) -> u32 {
        let holds = |place: &&DeviceEntry| (place.base..place.base + place.size).contains(&address);
        let place = if address >= SYSTEM { None } else { MAP.iter().find(holds) };
        let (name, register, result) = if address >= SYSTEM {
            let offset = address.wrapping_sub(0xE000_E000);
            let result = self.with_devices(|_, scs, at| match value {
                Some(value) => scs.write(offset, value, size, at).map(|()| value),
                None => scs.read(offset, size, at),
            });
            self.guard_changed |= value.is_some() && (0xD90..0xDB0).contains(&offset);
            ("core", Scs::name(offset), result)
        } else {
            self.access_device(place, address, size, value)
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
        self.record(access);
        let accessed = place.map(|place| if place.id == Id::CanRam { Id::Can } else { place.id });
        let is_accessed = |place: &DeviceEntry| Some(place.id) == accessed;
        let now = self.now;
        match accessed {
            _ if !is_write => self.refresh_those(|place, _| is_accessed(place)),
            // Clocks and pin functions affect all devices.
            Some(Id::Rcc) => {
                self.apply_resets();
                self.update_clocks();
                self.check_speed();
                self.advance(core);
            }
            Some(Id::Gpio(_)) => {
                self.functions = std::array::from_fn(|index| self.devices.gpio[index].functions());
                self.advance(core);
            }
            Some(Id::Pwr | Id::Syscfg) => self.advance(core),
            _ => self.advance_those(core, |place, next| is_accessed(place) || next <= now),
        }
        result.unwrap_or(0)
    }

    fn access_device(
        &mut self,
        place: Option<&DeviceEntry>,
        address: u32,
        size: u32,
        value: Option<u32>,
    ) -> (&'static str, Cow<'static, str>, Result<u32, Refusal>) {
        let Some(place) = place else {
            return (
                "nothing",
                format!("{address:08X}").into(),
                refuse("nothing is modelled at this address"),
            );
        };
        let offset = address - place.base;
        if place.id == Id::CanRam {
            let word = (offset / 4) as usize;
            let can = &mut self.devices.can;
            let result = self.devices.rcc.check(CAN.expect("FDCAN1 has a gate")).and_then(|()| match value {
                _ if size != 4 => refuse("32 bits at a time"),
                Some(value) => can.ram_write(word, value).map(|()| value),
                None => can.ram_read(word),
            });
            return (place.name, format!("[{word}]").into(), result);
        }
        let result = self.with_devices(|devices, _, at| {
            if let Some(gate) = place.gate {
                devices.rcc.check(gate)?;
            }
            if value.is_none() {
                devices.rcc.settle();
            }
            let device = devices.device(place.id);
            match value {
                Some(_) if size != 4 && !(size == 2 && device.accepts_halfwords()) => {
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
        let register =
            register.map_or_else(|| format!("+{offset:03X}").into(), |register| register.name.into());
        (place.name, register, result)
    }

    /// Resets the devices whose reset bit is set.
    fn apply_resets(&mut self) {
        for place in &MAP {
            if place.gate.is_some_and(|gate| self.devices.rcc.is_held(gate)) {
                self.devices.device(place.id).reset();
            }
        }
    }

    /// Checks that the core voltage and the flash wait states allow the present clock.
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
    fn read(&mut self, core: Emulator, address: u32, size: u32) -> u32 {
        self.access(core, address, size, None)
    }

    fn write(&mut self, core: Emulator, address: u32, value: u32, size: u32) {
        self.access(core, address, size, Some(value));
    }

    fn block(&mut self, core: Emulator, address: u32, len: u32) -> Flow {
        let must_stop = self.violation.is_some() || self.halt.is_some() || self.guard_changed;
        let must_stop = must_stop || self.scs.wants_reset();
        // A program that reads flash as soon as the registers report the end of programming must see what it has
        // written.
        let must_stop = must_stop || self.devices.flash.has_changed();
        let is_due = self.now >= self.deadline || must_stop;
        let is_due = is_due || self.has_pending && self.scs.due(masks(core)).is_some();
        if is_due && !self.is_single_step {
            return Flow::Stop;
        }
        let count = self.count(core, address, len);
        if count == u64::from(ENDLESS) {
            // Only an interrupt can end this loop.
            self.now = self.now.max(self.deadline);
            return Flow::Stop;
        }
        self.instructions += count;
        self.now += count * self.cycle;
        Flow::Continue
    }

    fn watched(&mut self, core: Emulator, address: u32) -> Flow {
        match core.word(address) as u16 {
            SEV => {
                self.scs.event = true;
                Flow::Continue
            }
            _ => {
                self.halt = Some(Halt::Wait(address));
                Flow::Stop
            }
        }
    }
}

/// Address of flash.
pub(crate) const FLASH: u32 = 0x0800_0000;
/// Size of both banks together.
pub(crate) const FLASH_SIZE: u32 = 0x20_0000;
