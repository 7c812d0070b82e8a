//! Support for programs on QEMU's `mps2-an500` that do not use the board: interrupt vectors, exit after a panic,
//! arguments and files of the host.

use core::ffi::CStr;
use core::fmt::Display;

use semihosting::experimental::env;
use semihosting::fs::File;
use semihosting::io::Read;

/// Ends QEMU with a message.
pub(crate) fn fail(what: &str, why: &dyn Display) -> ! {
    semihosting::eprintln!("{what}: {why}");
    semihosting::process::exit(1)
}

/// Passes the path in the `nth` semihosting argument to a function.
pub(crate) fn with_path<T>(nth: usize, then: impl FnOnce(&CStr) -> T) -> T {
    let Ok(args) = env::args::<1024>() else { fail("arguments", &"too long") };
    let mut name = [0; 1024];
    let path = (&args).nth(nth).and_then(Result::ok).unwrap_or("");
    if path.is_empty() {
        fail("arguments", &"a path is missing");
    }
    if let Some(buf) = name.get_mut(..path.len()) {
        buf.copy_from_slice(path.as_bytes());
    }
    match CStr::from_bytes_until_nul(&name) {
        Ok(name) => then(name),
        Err(_) => fail("arguments", &"no path"),
    }
}

/// Whether there is an `nth` semihosting argument and `is_true` returns true for it.
#[allow(dead_code, reason = "not every program has one that may be left out")]
pub(crate) fn is_argument(nth: usize, is_true: impl FnOnce(&str) -> bool) -> bool {
    let Ok(args) = env::args::<1024>() else { fail("arguments", &"too long") };
    (&args).nth(nth).and_then(Result::ok).is_some_and(is_true)
}

/// Reads the file that the `nth` argument names.
#[allow(dead_code, reason = "not every program reads one")]
pub(crate) fn read_file(nth: usize, buf: &'static mut [u8]) -> &'static [u8] {
    let Ok(mut file) = with_path(nth, |path| File::open(path)) else { fail("file", &"cannot be opened") };
    let mut len = 0;
    loop {
        let Some(free @ [_, ..]) = buf.get_mut(len..) else { fail("file", &"longer than the room for it") };
        match file.read(free) {
            Ok(0) => return &buf[..len],
            Ok(count) => len += count,
            Err(_) => fail("file", &"cannot be read"),
        }
    }
}

#[panic_handler]
fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
    semihosting::eprintln!("{info}");
    semihosting::process::exit(101)
}

#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &cortex_m_rt::ExceptionFrame) -> ! {
    semihosting::eprintln!("hard fault at {:08X}", frame.pc());
    semihosting::process::exit(102)
}

fn on_interrupt() {
    panic!("an interrupt that was not enabled");
}

#[unsafe(link_section = ".vector_table.interrupts")]
#[unsafe(no_mangle)]
static __INTERRUPTS: [fn(); 32] = [on_interrupt; 32];
