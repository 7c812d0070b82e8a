//! Exception entry and return. Armv7-M ARM sections B1.5.6 to B1.5.8.
//!
//! The exception frame includes the floating-point registers if they are in use (CONTROL.FPCA); lazy
//! stacking is not modelled. The part of a frame that would be in the stack guard is not written, and
//! MSTKERR is set.

use crate::models::scs::{Masks, Scs};
use crate::unicorn::{Emulator, Reg};

const FRAME: u32 = 0x20;
const EXTENDED: u32 = 0x68;
const SINGLES: u32 = 16;
/// EXC_RETURN: to thread mode, main stack, without floating point.
const TO_THREAD: u32 = 0xFFFF_FFF9;
const TO_HANDLER: u32 = 0xFFFF_FFF1;
const NO_FLOATS: u32 = 1 << 4;
const FLOATS_IN_USE: u32 = 1 << 2;
/// Stacked xPSR: the stack was aligned by one word.
const ALIGNED: u32 = 1 << 9;
/// xPSR: the state of an IT block. The emulator ends basic blocks at each KiB, also inside an IT block.
pub(crate) const IT: u32 = 0x0600_FC00;
const STACKED: [Reg; 6] = [Reg::R0, Reg::R1, Reg::R2, Reg::R3, Reg::R12, Reg::Lr];

/// The core's mask registers.
pub(crate) fn masks(core: Emulator) -> Masks {
    Masks {
        primask: core.reg(Reg::Primask) & 1 != 0,
        faultmask: core.reg(Reg::Faultmask) & 1 != 0,
        basepri: core.reg(Reg::Basepri) as u8,
    }
}

/// Enters an exception; returns the address of its handler.
pub(crate) fn enter(core: Emulator, scs: &mut Scs, number: u16, return_address: u32) -> u32 {
    let guard = scs.guard();
    let (control, status, stack) = (core.reg(Reg::Control), core.reg(Reg::Xpsr), core.reg(Reg::Sp));
    let has_floats = control & FLOATS_IN_USE != 0;
    let frame = stack.wrapping_sub(if has_floats { EXTENDED } else { FRAME }) & !4;
    let aligned = if stack & 4 != 0 { ALIGNED } else { 0 };
    let mut words: Vec<u32> = STACKED.iter().map(|reg| core.reg(*reg)).collect();
    words.extend([return_address & !1, status & !ALIGNED | aligned]);
    if has_floats {
        words.extend((0..SINGLES).map(|number| core.single(number)));
        words.extend([core.reg(Reg::Fpscr), 0]);
    }
    let end = frame.wrapping_add(4 * words.len() as u32);
    if guard.is_none_or(|(start, size)| end <= start || frame >= start + size) {
        let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        core.write(frame, &bytes);
    } else {
        for (address, word) in (frame..).step_by(4).zip(words) {
            if guard.is_some_and(|(start, size)| (start..start + size).contains(&address)) {
                scs.record_fault(1 << 4, 0, true);
            } else {
                core.write(address, &word.to_le_bytes());
            }
        }
    }
    let kind = if status & 0x1FF == 0 { TO_THREAD } else { TO_HANDLER };
    core.set(Reg::Lr, kind & if has_floats { !NO_FLOATS } else { !0 });
    core.set(Reg::Sp, frame);
    core.set(Reg::Control, control & !FLOATS_IN_USE);
    // The handler's first instruction is in no IT block.
    core.set(Reg::Xpsr, status & !IT);
    core.set(Reg::Ipsr, number.into());
    scs.enter(number);
    core.word(scs.vectors() + 4 * u32::from(number))
}

/// Whether a jump to `pc` is an exception return (EXC_RETURN).
pub(crate) fn is_return(pc: u32) -> bool {
    pc >= 0xFFFF_FFE0
}

/// Returns from an exception with the EXC_RETURN `how`; returns the address to continue at.
pub(crate) fn leave(core: Emulator, scs: &mut Scs, how: u32) -> u32 {
    let frame = core.reg(Reg::Sp);
    let has_floats = how & NO_FLOATS == 0;
    let mut basic = [0; FRAME as usize];
    core.read(frame, &mut basic);
    let word = |index: usize| u32::from_le_bytes(basic[4 * index..][..4].try_into().expect("four"));
    for (index, reg) in STACKED.into_iter().enumerate() {
        core.set(reg, word(index));
    }
    let (pc, status) = (word(6), word(7));
    scs.leave();
    if core.reg(Reg::Ipsr) != u32::from(crate::models::scs::HARD_FAULT) {
        core.set(Reg::Faultmask, 0);
    }
    core.set(Reg::Xpsr, status & !ALIGNED);
    core.set(Reg::Ipsr, status & 0x1FF);
    let control = core.reg(Reg::Control);
    if has_floats {
        for number in 0..SINGLES {
            core.set_single(number, core.word(frame + FRAME + 4 * number));
        }
        core.set(Reg::Fpscr, core.word(frame + FRAME + 4 * SINGLES));
        core.set(Reg::Control, control | FLOATS_IN_USE);
    } else {
        core.set(Reg::Control, control & !FLOATS_IN_USE);
    }
    let len = if has_floats { EXTENDED } else { FRAME };
    core.set(Reg::Sp, frame + len + if status & ALIGNED != 0 { 4 } else { 0 });
    pc
}
