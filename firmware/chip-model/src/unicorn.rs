//! The binding to Unicorn, which emulates the instructions of a Cortex-M7. Only this module has `unsafe`.
//!
//! In: memory, registers, and a [`Handler`] that is called for accesses to devices, at the start of each basic
//! block, and at watched addresses. Out: why the core stopped. It does not know exceptions or devices.
//!
//! The library (GPL-2.0) is loaded at run time from the path in `CHIP_UNICORN`; nothing that is shipped
//! links it. Names and numbers are those of unicorn/unicorn.h and unicorn/arm.h, 2.1.4.
//! Memory hooks are not used: with them that version executes loads in IT blocks wrongly.

mod callbacks;
mod library;

use std::cell::Cell;
use std::ffi::{c_int, c_void};
use std::ptr::null_mut;

use self::callbacks::{on_bad_memory, on_block, on_exception, on_read, on_watched, on_write};
use self::library::{Api, OnCode, OnException, OnMemory, OnRead, OnWrite, Uc, api};

/// The environment variable with the path of the library.
pub const LIBRARY: &str = "CHIP_UNICORN";

/// Whether the core continues.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// It continues.
    Continue,
    /// It stops before the next basic block.
    Stop,
}

/// Handles the core's accesses. The core can be stopped only between instructions: one that is stopped in the
/// middle of an access would repeat the access.
pub trait Handler {
    /// A read of a device.
    fn read(&mut self, core: Emulator, address: u32, size: u32) -> u32;
    /// A write to a device.
    fn write(&mut self, core: Emulator, address: u32, value: u32, size: u32);
    /// A basic block is about to be executed; [`Flow::Stop`] prevents it.
    fn block(&mut self, core: Emulator, address: u32, len: u32) -> Flow;
    /// A watched instruction is about to be executed; [`Flow::Stop`] prevents it.
    fn watched(&mut self, core: Emulator, address: u32) -> Flow;
}

/// Why the core stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    /// A handler returned [`Flow::Stop`].
    Stopped,
    /// QEMU's number of an exception that the core raised; 8 is an exception return.
    Exception(u32),
    /// An undefined instruction.
    Undefined,
    /// No memory at the address, or the access is not allowed.
    Memory {
        /// The address.
        address: u32,
        /// Whether it was an instruction fetch.
        is_fetch: bool,
        /// Value and number of bytes of a write.
        written: Option<(u32, u32)>,
    },
}

/// A register of the core, with the library's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(i32)]
#[expect(missing_docs, reason = "the names are the core's")]
pub enum Reg {
    Fpscr = 6,
    Lr = 10,
    Pc = 11,
    Sp = 12,
    R0 = 66,
    R1 = 67,
    R2 = 68,
    R3 = 69,
    R4 = 70,
    R12 = 78,
    S0 = 79,
    Ipsr = 114,
    Control = 117,
    Xpsr = 120,
    Primask = 123,
    Basepri = 124,
    Faultmask = 126,
}

type Mmio = [usize; 2];

/// Access to the core's registers and memory, also for a handler.
#[derive(Clone, Copy)]
pub struct Emulator {
    api: &'static Api,
    uc: Uc,
}

impl Emulator {
    /// The register's value.
    pub fn reg(self, reg: Reg) -> u32 {
        self.numbered(reg as i32)
    }

    /// The bits of one of S0 to S15.
    pub fn single(self, number: u32) -> u32 {
        self.numbered(Reg::S0 as i32 + number as i32)
    }

    /// R4 to R11; 0 is R4.
    pub fn callee_saved(self, number: u32) -> u32 {
        self.numbered(Reg::R4 as i32 + number as i32)
    }

    /// Sets one of R0 to R12.
    pub fn set_general(self, number: u32, value: u32) {
        self.set_numbered(Reg::R0 as i32 + number as i32, value);
    }

    fn numbered(self, number: i32) -> u32 {
        let mut value = 0_u64;
        // SAFETY: all registers of `Reg` have 32 bits; there is room for 64.
        unsafe { (self.api.reg_read)(self.uc, number, (&raw mut value).cast()) };
        value as u32
    }

    /// Sets the register.
    pub fn set(self, reg: Reg, value: u32) {
        self.set_numbered(reg as i32, value);
    }

    /// Sets one of S0 to S15.
    pub fn set_single(self, number: u32, value: u32) {
        self.set_numbered(Reg::S0 as i32 + number as i32, value);
    }

    fn set_numbered(self, number: i32, value: u32) {
        let value = u64::from(value);
        // SAFETY: the library reads at most the 64 bits of `value`; all registers of `Reg` have 32.
        unsafe { (self.api.reg_write)(self.uc, number, (&raw const value).cast()) };
    }

    /// Sets all registers to their values after a reset, except the stack pointer and the program counter, which the
    /// caller sets.
    pub fn reset(self) {
        const THUMB: u32 = 1 << 24;
        for number in (Reg::R0 as i32..=Reg::R12 as i32).chain(Reg::S0 as i32..Reg::S0 as i32 + 32) {
            self.set_numbered(number, 0);
        }
        // CONTROL comes first, because it selects the stack pointer.
        for reg in [Reg::Control, Reg::Ipsr, Reg::Primask, Reg::Basepri, Reg::Faultmask, Reg::Fpscr] {
            self.set(reg, 0);
        }
        self.set(Reg::Xpsr, THUMB);
        self.set(Reg::Lr, u32::MAX);
    }

    /// Reads memory without checking access rights; `false` if there is none.
    pub fn read(self, address: u32, bytes: &mut [u8]) -> bool {
        // SAFETY: the library writes `bytes.len()` bytes.
        0 == unsafe { (self.api.read)(self.uc, address.into(), bytes.as_mut_ptr(), bytes.len() as u64) }
    }

    /// Writes memory without checking access rights; `false` if there is none.
    pub fn write(self, address: u32, bytes: &[u8]) -> bool {
        // SAFETY: the library reads `bytes.len()` bytes.
        0 == unsafe { (self.api.write)(self.uc, address.into(), bytes.as_ptr(), bytes.len() as u64) }
    }

    /// A word of memory; 0 if there is none.
    pub fn word(self, address: u32) -> u32 {
        let mut bytes = [0; 4];
        self.read(address, &mut bytes);
        u32::from_le_bytes(bytes)
    }

    fn stop(self) {
        // SAFETY: may be called from every callback.
        unsafe { (self.api.stop)(self.uc) };
    }
}

/// An emulated Cortex-M7 with its memory.
pub struct Core {
    engine: Emulator,
    /// Boxed, because the callbacks get its address.
    shared: Box<HookState>,
}

struct HookState {
    api: &'static Api,
    handler: Cell<Option<*mut (dyn Handler + 'static)>>,
    exit: Cell<Option<Exit>>,
}

impl Core {
    /// A core without memory.
    ///
    /// # Errors
    /// The library is missing or returns an error.
    pub fn new() -> Result<Self, String> {
        const ARM: c_int = 1;
        // UC_MODE_MCLASS would be a Cortex-M33, without doubles.
        const THUMB: c_int = 16;
        const SET_MODEL: c_int = 7 | 1 << 26 | 1 << 30;
        const CORTEX_M7: c_int = 10;
        let api = api()?;
        let mut uc = null_mut();
        // SAFETY: `uc` is valid for the handle.
        checked("uc_open", unsafe { (api.open)(ARM, THUMB, &raw mut uc) })?;
        let core = Self {
            engine: Emulator { api, uc },
            shared: Box::new(HookState { api, handler: Cell::new(None), exit: Cell::new(None) }),
        };
        // SAFETY: this request takes the model's number.
        checked("uc_ctl", unsafe { (api.ctl)(uc, SET_MODEL, CORTEX_M7) })?;
        core.hook(HOOK_BLOCK, on_block as OnCode as *mut c_void, 1, 0)?;
        core.hook(HOOK_EXCEPTION, on_exception as OnException as *mut c_void, 1, 0)?;
        core.hook(HOOK_BAD_MEMORY, on_bad_memory as OnMemory as *mut c_void, 1, 0)?;
        Ok(core)
    }

    /// Its registers and memory.
    pub fn engine(&self) -> Emulator {
        self.engine
    }

    /// Maps executable memory.
    ///
    /// # Errors
    /// The range is mapped already.
    pub fn map(&self, address: u32, size: u32, is_writable: bool) -> Result<(), String> {
        let access = if is_writable { ALL } else { READ | EXECUTE };
        // SAFETY: the library allocates the memory itself.
        checked("uc_mem_map", unsafe {
            (self.engine.api.map)(self.engine.uc, address.into(), size.into(), access)
        })
    }

    /// Makes a range of memory read-only.
    ///
    /// # Errors
    /// The range is not mapped.
    pub fn make_read_only(&self, address: u32, size: u32) -> Result<(), String> {
        self.set_access(address, size, READ | EXECUTE)
    }

    fn set_access(&self, address: u32, size: u32, access: u32) -> Result<(), String> {
        let Emulator { api, uc } = self.engine;
        // SAFETY: the library only changes rights of its own memory; a range that is not mapped is an error.
        checked("uc_mem_protect", unsafe { (api.protect)(uc, address.into(), size.into(), access) })?;
        self.flush_rights()
    }

    /// Drops the cache of allowed accesses, which the library keeps even if access rights change.
    ///
    /// # Errors
    /// The library returns an error.
    pub fn flush_rights(&self) -> Result<(), String> {
        const FLUSH_TLB: c_int = 11 | 1 << 30;
        let Emulator { api, uc } = self.engine;
        // SAFETY: this request takes nothing.
        checked("uc_ctl", unsafe { (api.ctl)(uc, FLUSH_TLB) })
    }

    /// Makes a range of memory inaccessible, or accessible again.
    ///
    /// # Errors
    /// The range is not mapped.
    pub fn protect(&self, address: u32, size: u32, is_closed: bool) -> Result<(), String> {
        self.set_access(address, size, if is_closed { 0 } else { ALL })
    }

    /// Passes accesses to a range of [`MMIO`] to the handler.
    ///
    /// # Errors
    /// The range is mapped already.
    pub fn map_devices(&self, [address, size]: Mmio) -> Result<(), String> {
        let user = self.user();
        let (read, write) = match address as u32 {
            PERIPHERALS => (on_read::<PERIPHERALS> as OnRead, on_write::<PERIPHERALS> as OnWrite),
            _ => (on_read::<SYSTEM> as OnRead, on_write::<SYSTEM> as OnWrite),
        };
        // SAFETY: `user` lives as long as the core; the callbacks have the types of unicorn.h.
        checked("uc_mmio_map", unsafe {
            (self.engine.api.mmio)(self.engine.uc, address as u64, size as u64, read, user, write, user)
        })
    }

    /// Calls the handler before the instruction at this address is executed.
    ///
    /// # Errors
    /// The library returns an error.
    pub fn watch(&self, address: u32) -> Result<(), String> {
        self.hook(HOOK_CODE, on_watched as OnCode as *mut c_void, address.into(), address.into())
    }

    fn hook(&self, kind: c_int, callback: *mut c_void, begin: u64, end: u64) -> Result<(), String> {
        let mut handle = 0;
        let Emulator { api, uc } = self.engine;
        // SAFETY: each caller passes a callback of the type that unicorn.h has for the kind.
        checked("uc_hook_add", unsafe {
            (api.hook)(uc, &raw mut handle, kind, callback, self.user(), begin, end)
        })
    }

    fn user(&self) -> *mut c_void {
        (&raw const *self.shared).cast_mut().cast()
    }

    /// Drops cached translations of memory that has changed.
    pub fn invalidate(&self, address: u32, len: u32) {
        const REMOVE_CACHE: c_int = 9 | 2 << 26 | 1 << 30;
        let Emulator { api, uc } = self.engine;
        // SAFETY: this request takes a range.
        unsafe { (api.ctl)(uc, REMOVE_CACHE, u64::from(address), u64::from(address) + u64::from(len)) };
    }

    /// Runs from `pc` until the core stops; the program counter then is in its register.
    ///
    /// # Panics
    /// The library fails in a way that no program can cause.
    pub fn run(&mut self, pc: u32, handler: &mut dyn Handler) -> Exit {
        self.run_some(pc, 0, handler)
    }

    /// Runs one instruction.
    ///
    /// # Panics
    /// As [`Core::run`].
    pub fn run_one(&mut self, pc: u32, handler: &mut dyn Handler) -> Exit {
        self.run_some(pc, 1, handler)
    }

    fn run_some(&mut self, pc: u32, count: usize, handler: &mut dyn Handler) -> Exit {
        const NOWHERE: u64 = 0xFFFF_FFFE;
        const NO_MEMORY: std::ops::RangeInclusive<c_int> = 6..=8;
        const FORBIDDEN: std::ops::RangeInclusive<c_int> = 12..=14;
        const UNDEFINED: c_int = 10;
        let handler: *mut (dyn Handler + '_) = handler;
        // SAFETY: only the lifetime is extended; the pointer is cleared before this returns.
        let handler: *mut (dyn Handler + 'static) = unsafe { std::mem::transmute(handler) };
        self.shared.handler.set(Some(handler));
        self.shared.exit.set(None);
        let Emulator { api, uc } = self.engine;
        // No time limit: the library would start a thread for it.
        // SAFETY: the memory that the callbacks use is valid.
        let status = unsafe { (api.start)(uc, u64::from(pc | 1), NOWHERE, 0, count) };
        self.shared.handler.set(None);
        match (self.shared.exit.get(), status) {
            (Some(exit), _) => exit,
            (None, 0) => Exit::Stopped,
            (None, UNDEFINED) => Exit::Undefined,
            (None, status) if NO_MEMORY.contains(&status) || FORBIDDEN.contains(&status) => {
                Exit::Memory { address: 0, is_fetch: false, written: None }
            }
            (None, status) => panic!("uc_emu_start: error {status}, PC {:08X}", self.engine.reg(Reg::Pc)),
        }
    }
}

impl Drop for Core {
    fn drop(&mut self) {
        // SAFETY: nothing is running, and the handle is not used again.
        unsafe { (self.engine.api.close)(self.engine.uc) };
    }
}

fn checked(what: &str, status: c_int) -> Result<(), String> {
    if status == 0 { Ok(()) } else { Err(format!("{what}: error {status}")) }
}

/// Start of the chip's peripherals.
pub const PERIPHERALS: u32 = 0x4000_0000;
/// Start of the core's own peripherals.
pub const SYSTEM: u32 = 0xE000_0000;
/// The ranges of devices: start and size.
pub const MMIO: [Mmio; 2] = [[PERIPHERALS as usize, 0x2000_0000], [SYSTEM as usize, 0x10_0000]];

const READ: u32 = 1;
const EXECUTE: u32 = 4;
const ALL: u32 = 7;
const HOOK_EXCEPTION: c_int = 1;
const HOOK_CODE: c_int = 4;
const HOOK_BLOCK: c_int = 8;
/// Unmapped memory (16, 32, 64) and missing access rights (128, 256, 512).
const HOOK_BAD_MEMORY: c_int = 0x3F0;
