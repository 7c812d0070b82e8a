//! Exception codes (docs/wire/modbus.md section 4).

use core::fmt;

/// Why a server refused a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Exception {
    /// 0x01: the server does not implement the function code.
    IllegalFunction,
    /// 0x02: an address outside the map, or a write to a read-only item.
    IllegalDataAddress,
    /// 0x03: a count, value or byte count the function does not allow.
    IllegalDataValue,
    /// 0x04: the server failed while it executed the request.
    DeviceFailure,
    /// 0x05: accepted, and still being executed.
    Acknowledge,
    /// 0x06: busy with a long command; try again later.
    DeviceBusy,
    /// 0x08: the server found its memory corrupted.
    MemoryParity,
    /// 0x0A: a Modbus gateway has no path to the unit.
    GatewayPathUnavailable,
    /// 0x0B: the unit behind a Modbus gateway did not answer.
    GatewayTargetSilent,
    /// Any other code, as received.
    Unknown(u8),
}

/// Codes with their exceptions, for both directions.
const CODES: [(u8, Exception, &str); 9] = [
    (0x01, Exception::IllegalFunction, "illegal function"),
    (0x02, Exception::IllegalDataAddress, "illegal data address"),
    (0x03, Exception::IllegalDataValue, "illegal data value"),
    (0x04, Exception::DeviceFailure, "server device failure"),
    (0x05, Exception::Acknowledge, "acknowledge"),
    (0x06, Exception::DeviceBusy, "server device busy"),
    (0x08, Exception::MemoryParity, "memory parity error"),
    (0x0A, Exception::GatewayPathUnavailable, "gateway path unavailable"),
    (0x0B, Exception::GatewayTargetSilent, "gateway target device failed to respond"),
];

impl Exception {
    /// The exception with this code; a code that is not in the standard becomes `Unknown`.
    pub fn from_code(code: u8) -> Self {
        CODES.iter().find(|row| row.0 == code).map_or(Self::Unknown(code), |row| row.1)
    }

    /// The code on the wire.
    pub fn code(self) -> u8 {
        match self {
            Self::Unknown(code) => code,
            known => CODES.iter().find(|row| row.1 == known).map_or(0, |row| row.0),
        }
    }
}

impl fmt::Display for Exception {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = CODES.iter().find(|row| row.1 == *self).map_or("unknown exception", |row| row.2);
        write!(f, "exception 0x{:02x}, {name}", self.code())
    }
}

impl core::error::Error for Exception {}
