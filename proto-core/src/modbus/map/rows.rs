//! The rows, and what is computed from them once, at compile time.
#![allow(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::panic,
    reason = "all of it runs in constants: an index out of range or an overflow fails the build"
)]

use super::{Access, MapRun, Space};
use crate::sysvar::{INPUT_COUNT, ModbusPlace, SPANS};

pub(super) const ROWS: [MapRun; 27] = [
    variables("BitInputReg", 1, "functional bool registers, input"),
    variables("BitOutputReg", 1, "functional bool registers, output"),
    variables("BitInputReg", 3, "bool registers, input"),
    variables("BitOutputReg", 3, "bool registers, output"),
    variables("DigitalSignalStatus", 7, "functional digital inputs"),
    variables("DigitalSignalStatus", 8, "functional digital outputs"),
    variables("DigitalSignalStatus", 1, "digital inputs"),
    variables("DigitalOutputCommand", 1, "digital outputs"),
    variables("DigitalSignalStatus", 3, "tool inputs; 3 to 8 reserved").widened(8),
    variables("DigitalOutputCommand", 3, "tool outputs; 3 to 8 reserved").widened(8),
    other(Space::Coils, 224, 8, "tool end buttons; 3 to 8 reserved"),
    other(Space::Holding, 0, 1, "operation mode"),
    other(Space::Holding, 1, 1, "robot state"),
    other(Space::Holding, 2, 1, "program state"),
    other(Space::Holding, 3, 1, "safety state"),
    other(Space::Holding, 4, 4, "reserved"),
    variables("WordInputReg", 1, "word registers, input"),
    variables("WordOutputReg", 1, "word registers, output"),
    other(Space::Holding, 72, 4, "cabinet analog inputs, current").scaled(100),
    other(Space::Holding, 76, 4, "cabinet analog inputs, voltage").scaled(1_000),
    other(Space::Holding, 80, 8, "cabinet analog outputs, reserved").writable(),
    other(Space::Holding, 88, 2, "tool analog inputs, voltage").scaled(1_000),
    other(Space::Holding, 90, 2, "tool analog outputs, reserved").writable(),
    variables("RobotState", 1, "joint position, rad; the 7th reserved"),
    other(Space::Holding, 99, 7, "joint velocity, rad/s; the 7th reserved").scaled(1_000),
    variables("RobotState", 8, "TCP pose: X, Y, Z in m, Rx, Ry, Rz in rad"),
    other(Space::Holding, 112, 6, "TCP velocity, m/s and rad/s").scaled(10_000),
];

impl MapRun {
    /// For a row with more addresses than the variables have bits; the rest is reserved.
    const fn widened(self, count: u16) -> Self {
        Self { count, ..self }
    }

    const fn writable(self) -> Self {
        Self { access: Access::ReadWrite, ..self }
    }

    const fn scaled(self, per_unit: u16) -> Self {
        Self { per_unit, ..self }
    }
}

const fn other(space: Space, first: u16, count: u16, content: &'static str) -> MapRun {
    MapRun { space, first, count, access: Access::ReadOnly, content, per_unit: 0 }
}

/// The row of the variables from `group[index]` on.
const fn variables(group: &str, index: u8, content: &'static str) -> MapRun {
    let mut nth = 0;
    while !(SPANS[nth].first == index && same(SPANS[nth].group, group)) {
        nth += 1;
    }
    let (vars, access) = (SPANS[nth].len() as u16, access(nth));
    match SPANS[nth].modbus {
        Some(ModbusPlace::Coils { first, count }) => {
            MapRun { space: Space::Coils, first, count: count * vars, access, content, per_unit: 0 }
        }
        Some(ModbusPlace::Register { address }) => {
            MapRun { space: Space::Holding, first: address, count: vars, access, content, per_unit: 0 }
        }
        Some(ModbusPlace::Scaled { address, per_unit }) => {
            MapRun { space: Space::Holding, first: address, count: vars, access, content, per_unit }
        }
        None => panic!("the variable is not in the map"),
    }
}

/// Clients may write the robot's inputs, which are the first rows.
const fn access(row: usize) -> Access {
    let (mut nth, mut before) = (0, 0);
    while nth < row {
        before += SPANS[nth].len();
        nth += 1;
    }
    if before < INPUT_COUNT { Access::ReadWrite } else { Access::ReadOnly }
}

const fn same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    let mut nth = 0;
    while nth < a.len() && nth < b.len() && a[nth] == b[nth] {
        nth += 1;
    }
    nth == a.len() && nth == b.len()
}

/// One past the last address of a space; fails the build when its rows leave a gap or overlap.
pub(super) const fn end(space: Space) -> u16 {
    let (mut nth, mut end) = (0, 0);
    while nth < ROWS.len() {
        if ROWS[nth].space as u8 == space as u8 {
            assert!(ROWS[nth].first == end, "the map has a gap or an overlap");
            end += ROWS[nth].count;
        }
        nth += 1;
    }
    end
}

pub(super) const fn runs<const N: usize>(space: Space) -> [u16; N] {
    let mut runs = [0; N];
    let (mut row, mut run_end) = (ROWS.len(), 0);
    // Backwards, to know whether a run continues in the next row.
    while row > 0 {
        row -= 1;
        let item = ROWS[row];
        if item.space as u8 != space as u8 {
            continue;
        }
        run_end = match item.access {
            Access::ReadOnly => 0,
            Access::ReadWrite if run_end == 0 => item.end(),
            Access::ReadWrite => run_end,
        };
        let mut address = item.first;
        while address < item.end() {
            runs[address as usize] = run_end;
            address += 1;
        }
    }
    runs
}
