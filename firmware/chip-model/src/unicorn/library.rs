//! The functions of the library, as unicorn/unicorn.h declares them.

use std::ffi::{OsString, c_int, c_void};
use std::sync::OnceLock;

use libloading::Library;

use super::LIBRARY;

/// The library's handle of a core.
pub(super) type Uc = *mut c_void;

/// The functions of the library. It is never unloaded, so they stay valid.
pub(super) struct Api {
    pub(super) open: unsafe extern "C" fn(c_int, c_int, *mut Uc) -> c_int,
    pub(super) close: unsafe extern "C" fn(Uc) -> c_int,
    pub(super) ctl: unsafe extern "C" fn(Uc, c_int, ...) -> c_int,
    pub(super) map: unsafe extern "C" fn(Uc, u64, u64, u32) -> c_int,
    pub(super) protect: unsafe extern "C" fn(Uc, u64, u64, u32) -> c_int,
    pub(super) read: unsafe extern "C" fn(Uc, u64, *mut u8, u64) -> c_int,
    pub(super) write: unsafe extern "C" fn(Uc, u64, *const u8, u64) -> c_int,
    pub(super) mmio: unsafe extern "C" fn(Uc, u64, u64, OnRead, *mut c_void, OnWrite, *mut c_void) -> c_int,
    pub(super) hook:
        unsafe extern "C" fn(Uc, *mut usize, c_int, *mut c_void, *mut c_void, u64, u64, ...) -> c_int,
    pub(super) reg_read: unsafe extern "C" fn(Uc, c_int, *mut c_void) -> c_int,
    pub(super) reg_write: unsafe extern "C" fn(Uc, c_int, *const c_void) -> c_int,
    pub(super) start: unsafe extern "C" fn(Uc, u64, u64, u64, usize) -> c_int,
    pub(super) stop: unsafe extern "C" fn(Uc) -> c_int,
}

pub(super) type OnRead = extern "C" fn(Uc, u64, u32, *mut c_void) -> u64;
pub(super) type OnWrite = extern "C" fn(Uc, u64, u32, u64, *mut c_void);
pub(super) type OnCode = extern "C" fn(Uc, u64, u32, *mut c_void);
pub(super) type OnException = extern "C" fn(Uc, u32, *mut c_void);
pub(super) type OnMemory = extern "C" fn(Uc, c_int, u64, c_int, i64, *mut c_void) -> bool;

impl Api {
    fn load() -> Result<Self, String> {
        let path: OsString = std::env::var_os(LIBRARY)
            .ok_or_else(|| format!("{LIBRARY} does not say where libunicorn.so.2 is (docs/chip.md)"))?;
        // SAFETY: the library's initialisers have no effect on this program.
        let library = unsafe { Library::new(&path) };
        let library = library.map_err(|error| format!("{}: {error}", path.display()))?;
        macro_rules! symbols {
            ($($field:ident = $name:literal),* $(,)?) => {
                Self { $($field: {
                    // SAFETY: the field's type is that of the function in unicorn.h.
                    let symbol = unsafe { library.get($name) };
                    *symbol.map_err(|error| error.to_string())?
                }),* }
            };
        }
        let api = symbols! {
            open = b"uc_open", close = b"uc_close", ctl = b"uc_ctl", map = b"uc_mem_map",
            protect = b"uc_mem_protect", read = b"uc_mem_read", write = b"uc_mem_write",
            mmio = b"uc_mmio_map", hook = b"uc_hook_add", reg_read = b"uc_reg_read",
            reg_write = b"uc_reg_write", start = b"uc_emu_start", stop = b"uc_emu_stop",
        };
        std::mem::forget(library);
        Ok(api)
    }
}

pub(super) fn api() -> Result<&'static Api, String> {
    static API: OnceLock<Result<Api, String>> = OnceLock::new();
    API.get_or_init(Api::load).as_ref().map_err(Clone::clone)
}
