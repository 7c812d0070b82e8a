//! How a program starts and prints: on a host, and on a Cortex-M7 in QEMU (`mps2-an500`).

#[cfg(not(target_os = "none"))]
pub(crate) use std::println as say;

#[cfg(target_os = "none")]
pub(crate) use semihosting::println as say;

#[cfg(target_os = "none")]
mod bare {
    use semihosting::{eprintln, process};

    #[cortex_m_rt::entry]
    fn main() -> ! {
        crate::superloop();
        process::exit(0)
    }

    #[panic_handler]
    fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
        eprintln!("{info}");
        process::exit(101)
    }

    fn on_interrupt() {}

    #[unsafe(link_section = ".vector_table.interrupts")]
    #[unsafe(no_mangle)]
    static __INTERRUPTS: [fn(); 32] = [on_interrupt; 32];
}
