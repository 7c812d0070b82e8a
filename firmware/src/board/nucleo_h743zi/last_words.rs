//! What a fault or a hang leaves behind for the next start: RAM keeps its contents when the watchdog
//! starts the board again, and the program then has a log that somebody may read.

use core::fmt::{self, Write};
use core::sync::atomic::{AtomicU8, AtomicU32, Ordering};

use cortex_m::peripheral::SCB;
use cortex_m_rt::ExceptionFrame;
use firmware::fmt::Text;
use firmware::identity::hash;
use firmware::tasks::watchdog::running;
use firmware::warn;

const ROOM: usize = 128;

/// What is kept; after a cold start, anything.
#[unsafe(link_section = ".uninit.last_words")]
static KEPT: Kept = Kept {
    len: AtomicU32::new(0),
    sum: AtomicU32::new(0),
    text: [const { AtomicU8::new(0) }; ROOM],
    after: AtomicU32::new(0),
};

#[repr(C, align(8))]
struct Kept {
    /// How many bytes of the text are meant.
    len: AtomicU32,
    /// What they hash to.
    sum: AtomicU32,
    text: [AtomicU8; ROOM],
    /// Written last: a part of a word of 64 bits waits in the RAM's buffer for the next write, and a
    /// reset would take it away.
    after: AtomicU32,
}

/// Through a box that the compiler does not look into: it would take the zeros above for what is there.
fn kept() -> &'static Kept {
    core::hint::black_box(&KEPT)
}

/// Writes as much as there is room for.
struct Words(usize);

impl Write for Words {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for (place, byte) in kept().text.iter().skip(self.0).zip(text.bytes()) {
            place.store(byte, Ordering::Relaxed);
            self.0 += 1;
        }
        Ok(())
    }
}

impl Words {
    /// The task that was running, and all is kept.
    fn end(mut self) {
        let _ = match running() {
            Some(task) => write!(self, ", task {task}"),
            None => self.write_str(", no task"),
        };
        kept().len.store(self.0 as u32, Ordering::Relaxed);
        kept().sum.store(sum(&text(self.0)), Ordering::Relaxed);
        kept().after.store(0, Ordering::Relaxed);
        cortex_m::asm::dsb();
    }
}

/// Keeps what is known of a fault. After a stack overflow its place is not.
pub(super) fn keep(frame: &ExceptionFrame) {
    // SAFETY: reads of the core's fault registers, which have no effect.
    let (cause, memory, bus) = unsafe {
        let scb = &*SCB::PTR;
        (scb.cfsr.read(), scb.mmfar.read(), scb.bfar.read())
    };
    let mut words = Words(0);
    // A panic ends in an undefined instruction: the log had its message.
    let kind = if cause & UNDEFINED_INSTRUCTION != 0 { "panic at" } else { "fault at" };
    let _ = write!(words, "{kind} {:08X}, from {:08X}, CFSR {cause:08X}", frame.pc(), frame.lr());
    if cause & MEMORY_ADDRESS_VALID != 0 {
        let _ = write!(words, ", address {memory:08X}");
    }
    if cause & BUS_ADDRESS_VALID != 0 {
        let _ = write!(words, ", address {bus:08X}");
    }
    words.end();
}

/// Keeps which task has the processor while the watchdog starves.
pub(super) fn keep_hang() {
    let mut words = Words(0);
    let _ = words.write_str("the watchdog was not fed");
    words.end();
}

/// It was none after all.
pub(super) fn forget() {
    kept().len.store(0, Ordering::Relaxed);
}

/// Tells what was kept, once.
pub(super) fn tell() {
    let len = kept().len.swap(0, Ordering::Relaxed) as usize;
    if !(1..=ROOM).contains(&len) {
        return;
    }
    let bytes = text(len);
    if sum(&bytes) == kept().sum.load(Ordering::Relaxed)
        && let Some(Ok(text)) = bytes.get(..len).map(core::str::from_utf8)
    {
        warn!("previous run: {}", Text(&text));
    }
}

fn text(len: usize) -> [u8; ROOM] {
    let mut bytes = [0; ROOM];
    for (place, byte) in bytes.iter_mut().zip(&kept().text).take(len) {
        *place = byte.load(Ordering::Relaxed);
    }
    bytes
}

fn sum(bytes: &[u8]) -> u32 {
    hash(bytes) as u32
}

/// Of CFSR.
const MEMORY_ADDRESS_VALID: u32 = 1 << 7;
const BUS_ADDRESS_VALID: u32 = 1 << 15;
const UNDEFINED_INSTRUCTION: u32 = 1 << 16;
