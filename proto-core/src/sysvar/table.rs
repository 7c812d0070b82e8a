//! The rows of the table, and values derived from them at compile time.
#![allow(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "all of it runs in constants: an index out of range or an overflow fails the build"
)]

use super::ModbusPlace;
use crate::wire::scalar::ScalarType::{self, Byte, Float, Word};

/// One row: consecutive variables of one group with consecutive places everywhere.
#[derive(Debug, Clone, Copy)]
pub struct Span {
    /// Group name as in the specification.
    pub group: &'static str,
    /// First index of the row, 1-based.
    pub first: u8,
    /// Last index of the row.
    pub last: u8,
    /// Type of each variable.
    pub ty: ScalarType,
    /// The robot's interface that it is connected to.
    pub interface: &'static str,
    /// Unit of a quantity, or empty.
    pub unit: &'static str,
    /// Bits of a byte variable that are not reserved.
    pub valid_bits: u8,
    /// Offset of the first variable in the 2001 stream.
    pub stream: Option<u16>,
    /// Modbus place of the first variable.
    pub modbus: Option<ModbusPlace>,
}

const fn row(group: &'static str, first: u8, last: u8, ty: ScalarType, interface: &'static str) -> Span {
    Span { group, first, last, ty, interface, unit: "", valid_bits: 0xFF, stream: None, modbus: None }
}

impl Span {
    const fn unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    const fn stream(self, offset: u16) -> Self {
        Self { stream: Some(offset), ..self }
    }

    const fn coils(self, first: u16) -> Self {
        Self { modbus: Some(ModbusPlace::Coils { first, count: 8 }), ..self }
    }

    /// The tool has two inputs and two outputs; the other six bits are reserved.
    const fn tool_coils(self, first: u16) -> Self {
        Self { valid_bits: 0b11, modbus: Some(ModbusPlace::Coils { first, count: 2 }), ..self }
    }

    const fn registers(self, address: u16) -> Self {
        Self { modbus: Some(ModbusPlace::Register { address }), ..self }
    }

    const fn scaled(self, address: u16, per_unit: u16) -> Self {
        Self { modbus: Some(ModbusPlace::Scaled { address, per_unit }), ..self }
    }

    /// Number of variables in the row.
    pub const fn len(&self) -> usize {
        (self.last as usize).wrapping_sub(self.first as usize).wrapping_add(1)
    }

    /// Always false.
    pub const fn is_empty(&self) -> bool {
        false
    }
}

/// Number of input rows in [`SPANS`]; they come first.
const INPUT_ROWS: usize = 8;

/// All system variables.
pub static SPANS: [Span; 25] = ROWS;

#[rustfmt::skip]
const ROWS: [Span; 25] = [
    // Inputs, user to robot. `stream` is where the present value can be read.
    row("DigitalOutputCommand", 1, 2, Byte, "cabinet digital outputs DO1..16").stream(752).coils(192),
    row("DigitalOutputCommand", 3, 3, Byte, "tool digital outputs 1..2").stream(1416).tool_coils(216),
    row("BitInputReg", 1, 2, Byte, "functional bool register inputs 1..16").stream(1088).coils(0),
    row("BitInputReg", 3, 10, Byte, "bool register inputs 1..64").stream(1120).coils(32),
    row("WordInputReg", 1, 32, Word, "word register inputs 1..32").stream(1248).registers(8),
    row("FloatInputReg", 1, 32, Float, "float register inputs 1..32").stream(832),
    row("ForceEnd", 1, 6, Float, "end force sensor, TCP frame: X,Y,Z,Rx,Ry,Rz").unit("N, Nm"),
    row("ForceBase", 1, 6, Float, "base force sensor, base frame: X,Y,Z,Rx,Ry,Rz").unit("N, Nm"),
    // Outputs, robot to user.
    row("DigitalSignalStatus", 1, 2, Byte, "cabinet digital inputs DI1..16").stream(736).coils(176),
    row("DigitalSignalStatus", 3, 3, Byte, "tool digital inputs 1..2").stream(1408).tool_coils(208),
    row("DigitalSignalStatus", 4, 5, Byte, "cabinet digital outputs DO1..16").stream(752).coils(192),
    row("DigitalSignalStatus", 6, 6, Byte, "tool digital outputs 1..2").stream(1416).tool_coils(216),
    row("DigitalSignalStatus", 7, 7, Byte, "functional digital inputs 1..8").stream(720).coils(160),
    row("DigitalSignalStatus", 8, 8, Byte, "functional digital outputs 1..8").stream(728).coils(168),
    row("RobotState", 1, 7, Float, "joint position; the 7th is reserved").unit("rad").stream(0).scaled(92, 1_000),
    row("RobotState", 8, 13, Float, "TCP pose in the base frame: X,Y,Z,Rx,Ry,Rz").unit("m, rad").stream(368).scaled(106, 10_000),
    row("RobotState", 14, 19, Float, "end force sensor in the flange frame").unit("N, Nm").stream(440),
    row("RobotState", 20, 25, Float, "tool frame offset").unit("m, rad").stream(608),
    row("RobotState", 26, 26, Float, "payload mass").unit("kg"),
    row("RobotState", 27, 29, Float, "payload centre of mass").unit("m"),
    row("RobotState", 30, 32, Float, "reserved"),
    row("BitOutputReg", 1, 2, Byte, "functional bool register outputs 1..16").stream(1104).coils(16),
    row("BitOutputReg", 3, 10, Byte, "bool register outputs 1..64").stream(1184).coils(96),
    row("WordOutputReg", 1, 32, Word, "word register outputs 1..32").stream(1312).registers(40),
    row("FloatOutputReg", 1, 32, Float, "float register outputs 1..32").stream(960),
];

pub(super) const COUNT: usize = count(ROWS.len());
pub(super) const INPUT_COUNT: usize = count(INPUT_ROWS);
pub(super) const BIT_INPUT_COUNT: usize = count(bit_rows());
pub(super) const IMAGE_BYTES: usize = bytes(ROWS.len());
pub(super) const INPUT_BYTES: usize = bytes(INPUT_ROWS);

/// Number of rows of byte inputs, which are at the beginning of the table.
const fn bit_rows() -> usize {
    let mut rows = 0;
    while matches!(ROWS[rows].ty, Byte) {
        rows += 1;
    }
    let mut row = rows;
    while row < INPUT_ROWS {
        assert!(!matches!(ROWS[row].ty, Byte), "byte inputs come first");
        row += 1;
    }
    rows
}

const fn count(rows: usize) -> usize {
    let (mut row, mut sum) = (0, 0);
    while row < rows {
        sum += ROWS[row].len();
        row += 1;
    }
    sum
}

const fn bytes(rows: usize) -> usize {
    let (mut row, mut sum) = (0, 0);
    while row < rows {
        sum += ROWS[row].len() * ROWS[row].ty.size();
        row += 1;
    }
    sum
}

/// For each variable: its row, its index in the row, its offset in the image.
static PLACES: [(u8, u8, u16); COUNT] = {
    let mut places = [(0, 0, 0); COUNT];
    let (mut row, mut var, mut offset) = (0, 0, 0);
    while row < ROWS.len() {
        let mut nth = 0;
        while nth < ROWS[row].len() {
            places[var] = (row as u8, nth as u8, offset as u16);
            offset += ROWS[row].ty.size();
            nth += 1;
            var += 1;
        }
        row += 1;
    }
    places
};

/// The row of a variable. `ordinal` is always below [`COUNT`]; other numbers give the first row.
pub(super) fn span_of(ordinal: usize) -> &'static Span {
    let row = PLACES.get(ordinal).map_or(0, |place| usize::from(place.0));
    SPANS.get(row).unwrap_or(&SPANS[0])
}

/// The row, the index in it, and the offset in the image.
pub(super) fn place_of(ordinal: usize) -> (&'static Span, u16, usize) {
    let (row, nth, offset) = PLACES.get(ordinal).copied().unwrap_or_default();
    (SPANS.get(usize::from(row)).unwrap_or(&SPANS[0]), nth.into(), offset.into())
}

pub(super) fn place_in_span(ordinal: usize) -> u16 {
    PLACES.get(ordinal).map_or(0, |place| u16::from(place.1))
}

pub(super) fn image_offset(ordinal: usize) -> usize {
    PLACES.get(ordinal).map_or(0, |place| usize::from(place.2))
}
