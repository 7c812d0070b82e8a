//! A checked view over the bytes of one packet.

use core::fmt;

use crate::wire::dialect::Dialect;
use crate::wire::state::States;

/// Size of a state packet in bytes.
pub const LEN: usize = 1468;

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
    /// Too few or too many bytes.
    WrongLength {
        /// Length of a packet.
        expected: usize,
        /// Number of bytes.
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

impl<'a> StateView<'a> {
    /// A view of exactly one packet.
    ///
    /// # Errors
    /// [`StateError`] if `bytes` has another length.
    pub fn new(bytes: &'a [u8]) -> Result<Self, StateError> {
        match bytes.try_into() {
            Ok(bytes) => Ok(Self { bytes }),
            Err(_) => Err(StateError::WrongLength { expected: LEN, actual: bytes.len() }),
        }
    }

    /// A view of one packet.
    pub const fn from_array(bytes: &'a [u8; LEN]) -> Self {
        Self { bytes }
    }

    /// The packet's bytes.
    pub const fn as_bytes(&self) -> &'a [u8; LEN] {
        self.bytes
    }

    /// The codes of mode, robot, program and safety state.
    pub fn state_codes(&self) -> [u8; 4] {
        [self.operation_mode(), self.robot_state(), self.program_state(), self.safety_state()]
    }

    /// The four state machines, as `dialect` numbers them.
    pub fn states(&self, dialect: &Dialect) -> States {
        dialect.states(self.state_codes())
    }

    /// The global speed in percent, if the dialect's controller sends it.
    pub fn global_speed(&self, dialect: &Dialect) -> Option<u8> {
        self.bytes.get(usize::from(dialect.global_speed?)).copied()
    }
}
