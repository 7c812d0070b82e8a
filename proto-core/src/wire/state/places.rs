//! Offsets and limits derived from the packet's tables at compile time.
#![allow(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "all of it runs in constants: an index out of range or an overflow fails the build"
)]

use super::packet::{Content, FIELDS, FieldPlace};
use super::view::LEN;

/// Consecutive bool bytes that are not reserved.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bools {
    pub(super) from: usize,
    pub(super) len: usize,
}

/// Every bool that is not reserved, consecutive ones merged.
pub(super) const BOOLS: &[Bools] = BOOL_RUNS.0.split_at(BOOL_RUNS.1).0;

/// The parts of [`BOOLS`] that consist of whole blocks.
pub(super) const BOOL_BLOCKS: &[Bools] = {
    const BLOCKS: ([Bools; BOOLS.len()], usize) = {
        let mut blocks = [Bools { from: 0, len: 0 }; BOOLS.len()];
        let (mut run, mut count) = (0, 0);
        while run < BOOLS.len() {
            if BOOLS[run].len >= BLOCK {
                blocks[count] = Bools { from: BOOLS[run].from, len: BOOLS[run].len / BLOCK * BLOCK };
                count += 1;
            }
            run += 1;
        }
        (blocks, count)
    };
    BLOCKS.0.split_at(BLOCKS.1).0
};

/// Bytes of a block.
pub(super) const BLOCK: usize = 16;

/// Offsets of the bools outside the blocks.
pub(super) const BOOL_BYTES: [usize; single_bools()] = {
    let mut places = [0; single_bools()];
    let (mut run, mut count) = (0, 0);
    while run < BOOLS.len() {
        let mut at = BOOLS[run].len / BLOCK * BLOCK;
        while at < BOOLS[run].len {
            places[count] = BOOLS[run].from + at;
            count += 1;
            at += 1;
        }
        run += 1;
    }
    places
};

const fn single_bools() -> usize {
    let (mut run, mut count) = (0, 0);
    while run < BOOLS.len() {
        count += BOOLS[run].len % BLOCK;
        run += 1;
    }
    count
}

/// Fields that are checked more closely if the codes are not a started controller's: number of checked items, and their
/// maximum absolute value in their unit. Reserved fields are not listed, nor registers and forces, which users write.
#[rustfmt::skip]
pub(super) const QUANTITIES: &[(&str, usize, f32)] = &[
    ("joint_position", 6, FARTHEST_RAD),
    ("joint_velocity", 6, 20.0),
    ("joint_acceleration", 6, 2_000.0),
    ("joint_torque", 6, 2_000.0),
    ("target_joint_position", 6, FARTHEST_RAD),
    ("target_joint_velocity", 6, 20.0),
    ("target_joint_acceleration", 6, 2_000.0),
    ("target_joint_torque", 6, 2_000.0),
    ("joint_current", 6, 20_000.0),
    ("tcp_pose", 6, 20.0),
    ("tcp_velocity", 6, 20.0),
    ("tcp_acceleration", 6, 2_000.0),
    ("target_tcp_pose", 6, 20.0),
    ("target_tcp_velocity", 6, 20.0),
    ("target_tcp_acceleration", 6, 2_000.0),
    ("tool_frame", 6, 20.0),
    ("work_object_frame", 6, 20.0),
    ("analog_inputs", 8, 100.0),
];

/// The limits for each four bytes from the packet's front to the last quantity: the bits of the largest allowed float,
/// or 0 if not checked.
pub(super) static LIMITS: [i32; 200] = {
    let mut limits = [0; 200];
    let mut nth = 0;
    while nth < QUANTITIES.len() {
        let (name, items, most) = QUANTITIES[nth];
        let field = row(name);
        assert!(items <= field.count as usize && field.ty.size() == 4 && field.offset.is_multiple_of(4));
        let mut item = 0;
        while item < items {
            limits[field.offset as usize / 4 + item] = most.to_bits().cast_signed();
            item += 1;
        }
        nth += 1;
    }
    limits
};

/// No joint turns farther.
pub(super) const FARTHEST_RAD: f32 = 1000.0;

/// Offset of the TCP's actual pose.
pub(super) const TCP_POSE: usize = row("tcp_pose").offset as usize;
/// Offset of the four state codes.
pub(super) const STATES: usize = row("operation_mode").offset as usize;

/// The build fails if the table does not have this field.
const fn row(name: &str) -> &'static FieldPlace {
    let mut row = 0;
    while !is_same(FIELDS[row].name.as_bytes(), name.as_bytes()) {
        row += 1;
    }
    &FIELDS[row]
}

const fn is_same(a: &[u8], b: &[u8]) -> bool {
    let mut at = 0;
    while at < a.len() && at < b.len() && a[at] == b[at] {
        at += 1;
    }
    at == a.len() && at == b.len()
}

const BOOL_RUNS: ([Bools; FIELDS.len()], usize) = {
    let mut runs = [Bools { from: 0, len: 0 }; FIELDS.len()];
    let (mut row, mut count) = (0, 0);
    while row < FIELDS.len() {
        if let Content::Bools { real } = FIELDS[row].content {
            let (from, len) = (FIELDS[row].offset as usize, real as usize);
            if count > 0 && runs[count - 1].from + runs[count - 1].len == from {
                runs[count - 1].len += len;
            } else {
                runs[count] = Bools { from, len };
                count += 1;
            }
        }
        row += 1;
    }
    (runs, count)
};

/// The build fails if the table has a gap or an overlap, or not the length of a packet.
const _: () = {
    let (mut row, mut end) = (0, 0);
    while row < FIELDS.len() {
        assert!(FIELDS[row].offset as usize == end, "the packet's table has a gap or an overlap");
        end += FIELDS[row].ty.size() * FIELDS[row].count as usize;
        row += 1;
    }
    assert!(end == LEN, "the packet's table is not as long as a packet");
};
