//! The crash record: a text about a fault or a hang. It is in RAM that keeps its contents during a reset by the
//! watchdog, and the next start logs it.

use core::fmt::{self, Write};
use core::sync::atomic::{AtomicU8, AtomicU32, Ordering};

use cortex_m::peripheral::SCB;
use cortex_m_rt::ExceptionFrame;
use firmware::fmt::DisplayText;
use firmware::identity::hash;
use firmware::tasks::watchdog::running;
use firmware::warn;

const MAX_TEXT: usize = 128;

#[unsafe(link_section = ".uninit.crash_record")]
static RECORD: Record = Record {
    len: AtomicU32::new(0),
    sum: AtomicU32::new(0),
    text: [const { AtomicU8::new(0) }; MAX_TEXT],
    after: AtomicU32::new(0),
};

#[repr(C, align(8))]
struct Record {
    len: AtomicU32,
    sum: AtomicU32,
    text: [AtomicU8; MAX_TEXT],
    /// Written last, to flush the word before it: the RAM's controller holds back an incomplete 64-bit word until the
    /// next write, and a reset would lose it.
    after: AtomicU32,
}

/// The record, passed through `black_box`; otherwise the compiler could assume that it has its initial zeros.
fn record() -> &'static Record {
    core::hint::black_box(&RECORD)
}

/// Writes text, truncated at the capacity. The number is the length so far.
struct CrashWriter(usize);

impl Write for CrashWriter {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for (place, byte) in record().text.iter().skip(self.0).zip(text.bytes()) {
            place.store(byte, Ordering::Relaxed);
            self.0 += 1;
        }
        Ok(())
    }
}

impl CrashWriter {
    /// Appends the running task and completes the record.
    fn end(mut self) {
        let _ = match running() {
            Some(task) => write!(self, ", task {task}"),
            None => self.write_str(", no task"),
        };
        record().len.store(self.0 as u32, Ordering::Relaxed);
        record().sum.store(sum(&text(self.0)), Ordering::Relaxed);
        record().after.store(0, Ordering::Relaxed);
        cortex_m::asm::dsb();
    }
}

/// Saves a fault. After a stack overflow, the exception frame and the addresses in it may be wrong.
pub(super) fn save_fault(frame: &ExceptionFrame) {
    // SAFETY: these are the core's fault registers, which always exist; reading them has no side effects.
    let (cause, memory, bus) = unsafe {
        let scb = &*SCB::PTR;
        (scb.cfsr.read(), scb.mmfar.read(), scb.bfar.read())
    };
    let mut writer = CrashWriter(0);
    // A panic ends in an undefined instruction, after its message was logged.
    let kind = if cause & UNDEFINED_INSTRUCTION != 0 { "panic at" } else { "fault at" };
    let _ = write!(writer, "{kind} {:08X}, from {:08X}, CFSR {cause:08X}", frame.pc(), frame.lr());
    if cause & MEMORY_ADDRESS_VALID != 0 {
        let _ = write!(writer, ", address {memory:08X}");
    }
    if cause & BUS_ADDRESS_VALID != 0 {
        let _ = write!(writer, ", address {bus:08X}");
    }
    writer.end();
}

/// Saves which task was running when the watchdog was not fed.
pub(super) fn save_hang() {
    let mut writer = CrashWriter(0);
    let _ = writer.write_str("the watchdog was not fed");
    writer.end();
}

/// Clears the record: the hang has ended.
pub(super) fn clear() {
    record().len.store(0, Ordering::Relaxed);
}

/// Logs the record, and clears it.
pub(super) fn log() {
    let len = record().len.swap(0, Ordering::Relaxed) as usize;
    if !(1..=MAX_TEXT).contains(&len) {
        return;
    }
    let bytes = text(len);
    if sum(&bytes) == record().sum.load(Ordering::Relaxed)
        && let Some(Ok(text)) = bytes.get(..len).map(core::str::from_utf8)
    {
        warn!("previous run: {}", DisplayText(&text));
    }
}

fn text(len: usize) -> [u8; MAX_TEXT] {
    let mut bytes = [0; MAX_TEXT];
    for (place, byte) in bytes.iter_mut().zip(&record().text).take(len) {
        *place = byte.load(Ordering::Relaxed);
    }
    bytes
}

fn sum(bytes: &[u8]) -> u32 {
    hash(bytes) as u32
}

// Flags of CFSR.
const MEMORY_ADDRESS_VALID: u32 = 1 << 7;
const BUS_ADDRESS_VALID: u32 = 1 << 15;
const UNDEFINED_INSTRUCTION: u32 = 1 << 16;
