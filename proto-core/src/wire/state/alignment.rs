//! Checks whether bytes are a packet: the stream has no mark that shows where a packet begins (docs/wire/state.md
//! section 3, D8).
//!
//! In: the bytes of one packet, and what earlier packets of its connection showed. Out: why they cannot be a packet. No
//! single item decides: a NaN makes only its own item unknown. Reserved items and items that users write are not
//! checked.

use core::fmt;

use super::places::{BLOCK, BOOL_BLOCKS, BOOL_BYTES, BOOLS, FARTHEST_RAD, LIMITS, STATES, TCP_POSE};
use super::view::{LEN, StateView};
use crate::wire::runs::copy;

/// Why bytes are not an aligned packet (docs/wire/state.md section 3, D8).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Misaligned {
    /// Too many of the first six joint positions are not finite or beyond ±1000 rad.
    JointPosition {
        /// Number of such positions.
        wrong: u8,
        /// Number allowed.
        allowed: u8,
        /// The first such joint, 1..=6.
        joint: u8,
        /// Its position, in rad.
        position: f32,
    },
    /// Too many bool bytes are neither 0 nor 1.
    Bools {
        /// Number of such bytes.
        wrong: u16,
        /// Number allowed.
        allowed: u16,
    },
    /// The state codes are not those of a started controller, and too many quantities are not finite, too large for
    /// their unit, or tiny without being 0.
    Quantities {
        /// Number of such quantities.
        wrong: u16,
        /// Number allowed.
        allowed: u16,
    },
    /// The state codes have changed, and the arm is too far from its position in the previous packet.
    Elsewhere {
        /// The largest distance of a joint (rad) or of a coordinate of the TCP (m).
        distance: f32,
        /// The distance allowed.
        allowed: f32,
    },
}

impl fmt::Display for Misaligned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::JointPosition { wrong, allowed, joint, position } => {
                write!(f, "{wrong} joint positions are not within ±{FARTHEST_RAD} rad, ")?;
                write!(f, "the first that of joint {joint}, {position} rad; at most {allowed} may be so")
            }
            Self::Bools { wrong, allowed } => {
                write!(f, "{wrong} bool bytes are neither 0 nor 1; at most {allowed}")
            }
            Self::Quantities { wrong, allowed } => {
                write!(f, "{wrong} quantities are impossible, and the state codes are not a started ")?;
                write!(f, "controller's; at most {allowed}")
            }
            Self::Elsewhere { distance, allowed } => {
                write!(f, "the state codes have changed, and the arm is {distance} rad or m from where it ")?;
                write!(f, "was one packet ago; at most {allowed}")
            }
        }
    }
}

impl core::error::Error for Misaligned {}

impl StateView<'_> {
    /// Checks whether the bytes can be a packet, as far as a single packet shows it (D8). Reserved items and items that
    /// users write are not checked. [`StateStream`](super::StateStream) also compares the packet with the previous one.
    ///
    /// # Errors
    /// [`Misaligned`], with the reason.
    pub fn check_alignment(&self) -> Result<(), Misaligned> {
        check(self.as_bytes(), is_started(codes(self.as_bytes())))
    }
}

/// What earlier packets of a connection showed.
#[derive(Debug, Clone)]
pub(super) struct Earlier {
    /// The newest state codes of a started controller.
    codes: Option<[u8; 4]>,
    /// Joint positions in the previous packet, and the TCP's position; meaningless without `codes`.
    joints: [u8; JOINTS],
    tcp: [u8; TCP],
}

impl Earlier {
    /// The state before a connection's first packet.
    pub(super) const NONE: Self = Self { codes: None, joints: [0; JOINTS], tcp: [0; TCP] };

    /// Whether the bytes can be the connection's next packet; if so, remembers their codes and position.
    pub(super) fn check(&mut self, bytes: &[u8; LEN]) -> Result<(), Misaligned> {
        let codes = codes(bytes);
        let is_as_before = self.codes == Some(codes);
        let is_started = is_as_before || is_started(codes);
        check(bytes, is_started)?;
        if !is_as_before {
            self.check_change(bytes, is_started)?;
            if is_started {
                self.codes = Some(codes);
            }
        }
        copy(&mut self.joints, part::<JOINTS>(bytes, 0));
        copy(&mut self.tcp, part::<TCP>(bytes, TCP_POSE));
        Ok(())
    }

    /// Checks the position, because the codes differ from the previous ones.
    fn check_change(&self, bytes: &[u8; LEN], is_started: bool) -> Result<(), Misaligned> {
        if self.codes.is_none() {
            return Ok(());
        }
        let mut distance = farthest(&self.joints, part::<JOINTS>(bytes, 0));
        // The TCP of a started controller jumps when a program selects another tool.
        if !is_started {
            distance = distance.max(farthest(&self.tcp, part::<TCP>(bytes, TCP_POSE)));
        }
        if distance > ALLOWED_DISTANCE {
            return Err(Misaligned::Elsewhere { distance, allowed: ALLOWED_DISTANCE });
        }
        Ok(())
    }
}

fn check(bytes: &[u8; LEN], is_started: bool) -> Result<(), Misaligned> {
    let joints: &[u8; JOINTS] = part(bytes, 0);
    let wrong = wrong_joints(joints);
    if wrong > ALLOWED_WRONG_JOINTS {
        return Err(first_wrong_joint(joints, wrong));
    }
    if !are_bools(bytes) {
        let wrong = wrong_bools(bytes);
        if wrong > ALLOWED_WRONG_BOOLS {
            return Err(Misaligned::Bools { wrong, allowed: ALLOWED_WRONG_BOOLS });
        }
    }
    if is_started { Ok(()) } else { check_quantities(bytes) }
}

/// Checks all quantities. A shifted packet mostly has invalid codes, or all zeros, in place of a started controller's.
fn check_quantities(bytes: &[u8; LEN]) -> Result<(), Misaligned> {
    let wrong = bytes.as_chunks().0.iter().zip(&LIMITS).map(|(item, &most)| {
        let size = (u32::from_le_bytes(*item) & !SIGN) as i32;
        // Without a branch, the compiler can check several per instruction.
        u32::from((most != 0) & ((size > most) | (size != 0) & (size < LEAST)))
    });
    let wrong: u32 = wrong.sum();
    let wrong = u16::try_from(wrong).unwrap_or(u16::MAX);
    if wrong > ALLOWED_WRONG_QUANTITIES {
        return Err(Misaligned::Quantities { wrong, allowed: ALLOWED_WRONG_QUANTITIES });
    }
    Ok(())
}

fn codes(bytes: &[u8; LEN]) -> [u8; 4] {
    *part(bytes, STATES)
}

/// Whether these are the codes of a controller that has finished its start. One of them may be unknown in section 4,
/// because versions differ.
fn is_started([mode, robot, program, safety]: [u8; 4]) -> bool {
    let unknown = [mode > 2, robot > 7, program > 5, safety > 15 && safety != 99];
    robot != 0 && safety > 1 && unknown.into_iter().filter(|unknown| *unknown).count() <= 1
}

fn part<const N: usize>(bytes: &[u8; LEN], from: usize) -> &[u8; N] {
    bytes.get(from..).and_then(|bytes| bytes.first_chunk()).unwrap_or(&[0; N])
}

fn wrong_joints(joints: &[u8; JOINTS]) -> u8 {
    joints.as_chunks().0.iter().map(|joint| u8::from(is_wrong_joint(joint))).sum()
}

fn is_wrong_joint(joint: &[u8; 4]) -> bool {
    u32::from_le_bytes(*joint) & !SIGN > FARTHEST_RAD.to_bits()
}

fn first_wrong_joint(joints: &[u8; JOINTS], wrong: u8) -> Misaligned {
    let mut named = (1..=6).zip(joints.as_chunks().0);
    let (joint, position) = named.find(|(_, bytes)| is_wrong_joint(bytes)).unwrap_or((0, &[0; 4]));
    let position = f32::from_le_bytes(*position);
    Misaligned::JointPosition { wrong, allowed: ALLOWED_WRONG_JOINTS, joint, position }
}

/// Whether every bool is 0 or 1. Checks many at a time, since nearly every packet passes.
fn are_bools(bytes: &[u8; LEN]) -> bool {
    let mut words = 0;
    for run in BOOL_BLOCKS {
        let run = bytes.get(run.from..).and_then(|behind| behind.get(..run.len)).unwrap_or(&[]);
        words = run.as_chunks::<BLOCK>().0.iter().fold(words, |all, word| all | u128::from_ne_bytes(*word));
    }
    let single = BOOL_BYTES.iter().fold(0, |all, &at| all | bytes.get(at).copied().unwrap_or(0));
    words & u128::from_ne_bytes([0xFE; BLOCK]) == 0 && single & 0xFE == 0
}

fn wrong_bools(bytes: &[u8; LEN]) -> u16 {
    let all = BOOLS.iter().filter_map(|run| bytes.get(run.from..)?.get(..run.len)).flatten();
    all.map(|&byte| u16::from(byte > 1)).sum()
}

/// The largest difference of two finite floats at the same place.
fn farthest(before: &[u8], now: &[u8]) -> f32 {
    let items = before.as_chunks().0.iter().zip(now.as_chunks().0);
    let differences = items.map(|(a, b)| (f32::from_le_bytes(*a) - f32::from_le_bytes(*b)).abs());
    differences.filter(|difference| difference.is_finite()).fold(0.0, f32::max)
}

/// Length of six joint positions in bytes.
const JOINTS: usize = 24;
/// Length of the TCP's X, Y and Z in bytes.
const TCP: usize = 12;

const SIGN: u32 = 0x8000_0000;

/// Bits of 2^-119, 1.5e-36. Integers and bools read as floats are smaller; squared rounding errors (1e-33) are larger.
const LEAST: i32 = 0x0400_0000;

/// Two encoders may be unreadable at a time; a shift is also noticed without the joints.
const ALLOWED_WRONG_JOINTS: u8 = 2;

/// Versions differ in the contents of a few bool bytes (D8).
const ALLOWED_WRONG_BOOLS: u16 = 8;

/// A value that cannot be read is NaN; two are allowed.
const ALLOWED_WRONG_QUANTITIES: u16 = 2;

/// In rad or m. No joint and no TCP moves this far in 100 ms.
const ALLOWED_DISTANCE: f32 = 0.5;

#[cfg(test)]
mod tests;
