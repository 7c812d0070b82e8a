//! Proves that nothing in proto-core, recipe-store, recipe-update, recipe-api or recipe-sparkplug panics.
//!
//! This program calls every function of these crates that processes data of a device, a peer, a file or flash, with
//! values that are unknown to the compiler. Its panic handler needs a symbol that does not exist, so the program links
//! only if the optimiser has removed every panic. The signatures of recipe-update come from a library that contains
//! panics; with it, every call of a panic is checked instead. `.ci/run` builds the program with the options of the
//! firmware, and prints how much stack each of these functions takes (docs/architecture.md section 4).
//!
//! The program is never run on a board. On a host it makes the same calls once, which shows little.
#![cfg_attr(target_os = "none", no_std, no_main)]

mod configuration;
mod devices;
mod engine;
mod protocols;
mod recipes;
mod remote;
mod rtu;
mod sparkplug;
mod state;
mod store;
mod update;
mod words;
mod zeros;

use core::fmt::Write;
use core::hint::black_box;

/// Bytes whose contents and length are unknown to the compiler, as if sent by a peer.
fn bytes() -> &'static [u8] {
    static BYTES: [u8; 2048] = [0; 2048];
    black_box(&BYTES[..])
}

/// A value unknown to the compiler.
fn any<T>(value: T) -> T {
    black_box(value)
}

/// A writer that may fail at any time.
struct FailingWriter;

impl Write for FailingWriter {
    fn write_str(&mut self, text: &str) -> core::fmt::Result {
        black_box(text);
        any(Ok(()))
    }
}

/// A buffer of unknown length.
fn out_buf(buffer: &mut [u8]) -> &mut [u8] {
    black_box(buffer)
}

fn exercise() {
    configuration::all();
    devices::all();
    engine::all();
    recipes::all();
    protocols::all();
    rtu::all();
    state::all();
    zeros::all();
    if !matches!(VARIANT, Variant::Core) {
        remote::all();
        sparkplug::all();
        store::all();
    }
    if matches!(VARIANT, Variant::Signed) {
        update::all();
    }
    match VARIANT {
        Variant::Proof | Variant::Core | Variant::Shown | Variant::Signed => {}
        Variant::Provoked => _ = black_box(bytes()[any(7_usize)]),
        Variant::Words => words::all(),
    }
}

/// Variant of the build, from the environment variable `NO_PANIC`.
#[derive(Clone, Copy)]
enum Variant {
    /// The proof: a panic does not link.
    Proof,
    /// Only proto-core, whose stack use is known; the others format text through function pointers.
    Core,
    /// With an unchecked index, to show that the proof can fail.
    Provoked,
    /// Panics link, to show where they are.
    Shown,
    /// Also the `Display` of errors; `core`'s formatting contains panics.
    Words,
    /// Also recipe-update; its library for signatures and hashes contains panics.
    Signed,
}

const VARIANT: Variant = match option_env!("NO_PANIC") {
    Some(name) => match name.as_bytes() {
        b"core" => Variant::Core,
        b"provoked" => Variant::Provoked,
        b"shown" => Variant::Shown,
        b"words" => Variant::Words,
        b"signed" => Variant::Signed,
        _ => Variant::Proof,
    },
    None => Variant::Proof,
};

#[cfg(not(target_os = "none"))]
fn main() {
    exercise();
}

#[cfg(target_os = "none")]
mod image {
    #[cortex_m_rt::entry]
    fn main() -> ! {
        super::exercise();
        loop {
            cortex_m::asm::nop();
        }
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        unsafe extern "C" {
            safe fn proto_core_can_panic() -> !;
        }
        match super::VARIANT {
            super::Variant::Proof | super::Variant::Core | super::Variant::Provoked => proto_core_can_panic(),
            super::Variant::Shown | super::Variant::Words | super::Variant::Signed => loop {},
        }
    }

    fn on_any_interrupt() {}

    #[unsafe(link_section = ".vector_table.interrupts")]
    #[unsafe(no_mangle)]
    static __INTERRUPTS: [fn(); 32] = [on_any_interrupt; 32];
}
