//! A checked view over the bytes of one packet, and the test whether they are one (D8).

use core::fmt;

use super::places::BOOLS;
use super::{LEN, OperationMode, ProgramState, StatePacket, States};
use crate::sysvar::SysVar;
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

/// The bytes of one packet. There is an accessor for each field; none can fail or panic.
#[derive(Debug, Clone, Copy)]
pub struct StateView<'a> {
    bytes: &'a [u8; LEN],
}

/// Why bytes are not a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum StateError {
    /// There are too few or too many.
    WrongLength {
        /// Bytes of a packet.
        expected: usize,
        /// Bytes that were given.
        actual: usize,
    },
}

impl fmt::Display for StateError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::WrongLength { expected, actual } => {
                write!(f, "a state packet has {expected} bytes, not {actual}")
            }
        }
    }
}

impl core::error::Error for StateError {}

/// Why a packet does not begin where the bytes do (docs/wire/state.md section 3, D8).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Misaligned {
    /// A joint position is not finite or beyond ±1000 rad.
    JointPosition {
        /// 1..=6.
        joint: u8,
        /// What stands there, rad.
        position: f32,
    },
    /// Too many bool bytes are neither 0 nor 1.
    Bools {
        /// How many are not.
        wrong: u16,
        /// How many may be.
        allowed: u16,
    },
}

impl fmt::Display for Misaligned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::JointPosition { joint, position } => {
                write!(f, "the position of joint {joint} is {position} rad; at most ±{FARTHEST_RAD}")
            }
            Self::Bools { wrong, allowed } => {
                write!(f, "{wrong} bool bytes are neither 0 nor 1; at most {allowed}")
            }
        }
    }
}

impl core::error::Error for Misaligned {}

impl<'a> StateView<'a> {
    /// Looks at exactly one packet.
    ///
    /// # Errors
    /// [`StateError`] when `bytes` are more or fewer.
    #[inline]
    pub fn new(bytes: &'a [u8]) -> Result<Self, StateError> {
        match bytes.try_into() {
            Ok(bytes) => Ok(Self { bytes }),
            Err(_) => Err(StateError::WrongLength { expected: LEN, actual: bytes.len() }),
        }
    }

    /// Looks at one packet.
    pub const fn from_array(bytes: &'a [u8; LEN]) -> Self {
        Self { bytes }
    }

    /// The packet's bytes.
    pub const fn as_bytes(&self) -> &'a [u8; LEN] {
        self.bytes
    }

    /// Whether the bytes can be a packet: the stream has no mark to find its beginning by (D8).
    /// Reserved items and codes are never looked at.
    ///
    /// # Errors
    /// [`Misaligned`] names the first thing no packet has.
    pub fn check_alignment(&self) -> Result<(), Misaligned> {
        let positions = self.joint_position();
        let within = |position: f32| position.abs() <= FARTHEST_RAD;
        for (joint, &position) in (1u8..=6).zip(&positions) {
            if !within(position) {
                return Err(Misaligned::JointPosition { joint, position });
            }
        }
        let mut wrong = 0u16;
        for run in BOOLS {
            let bools = self.bytes.get(run.from..).and_then(|bytes| bytes.get(..run.len)).unwrap_or(&[]);
            if !are_bools(bools) {
                wrong = wrong.saturating_add(bools.iter().map(|&byte| u16::from(byte > 1)).sum());
            }
        }
        if wrong > ALLOWED_WRONG_BOOLS {
            return Err(Misaligned::Bools { wrong, allowed: ALLOWED_WRONG_BOOLS });
        }
        Ok(())
    }

    /// The packet as a plain value.
    #[inline]
    pub fn to_packet(&self) -> StatePacket {
        let mut packet = StatePacket::ZERO;
        packet.fill(self.bytes);
        packet
    }

    /// Every field into a packet that exists: as [`Self::to_packet`], without a second packet on
    /// the stack.
    pub fn read_into(&self, packet: &mut StatePacket) {
        packet.fill(self.bytes);
    }

    /// The four state machines, as `dialect` numbers them.
    pub fn states(&self, dialect: &Dialect) -> States {
        States {
            mode: OperationMode::from_code(self.operation_mode()),
            robot: dialect.robot_state(self.robot_state()),
            program: ProgramState::from_code(self.program_state()),
            safety: dialect.safety_state(self.safety_state()),
        }
    }

    /// The global speed in percent, where the dialect's controller sends it.
    pub fn global_speed(&self, dialect: &Dialect) -> Option<u8> {
        self.bytes.get(usize::from(dialect.global_speed?)).copied()
    }

    /// The value of a variable that stands in the packet, inputs too: what they read back as.
    /// `None` for a variable that does not stand there.
    ///
    /// A byte variable's bits are packed lowest first (D13) and masked (D22); a bool byte that is
    /// not 0 counts as 1.
    pub fn read_var(&self, var: SysVar) -> Option<Scalar> {
        let place = var.stream()?;
        let bytes = self.bytes.get(usize::from(place.offset)..)?;
        if var.is_bits() {
            Some(Scalar::Byte(super::copy::pack(bytes.first_chunk()?) & var.valid_bits()))
        } else {
            Scalar::decode(var.ty(), bytes)
        }
    }
}

/// Whether every byte is 0 or 1: seen four at a time, since nearly every packet is right.
fn are_bools(bytes: &[u8]) -> bool {
    let (words, rest) = bytes.as_chunks::<4>();
    let words = words.iter().fold(0, |all, word| all | u32::from_ne_bytes(*word));
    let rest = rest.iter().fold(0, |all, byte| all | byte);
    words & 0xFEFE_FEFE == 0 && rest & 0xFE == 0
}

/// No joint turns this far; what stands in other fields mostly does not read as so small a float.
const FARTHEST_RAD: f32 = 1000.0;

/// Versions differ in what they put into a few bool bytes (D8).
const ALLOWED_WRONG_BOOLS: u16 = 8;
