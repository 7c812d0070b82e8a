//! What the packet's tables say about places, computed at compile time.
#![allow(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "all of it runs in constants: an index out of range or an overflow fails the build"
)]

use super::packet::{Content, FIELDS, FieldPlace};
use crate::sysvar::{INPUT_COUNT, SPANS};

/// Bytes of the packet that go into the image as they are.
#[derive(Debug, Clone, Copy)]
pub(super) struct Copy {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) len: usize,
}

/// Eight bool bytes of the packet that are one byte of the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pack {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) mask: u8,
}

/// Consecutive bool bytes that are not reserved.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bools {
    pub(super) from: usize,
    pub(super) len: usize,
}

/// Every output word and float, consecutive ones merged.
pub(super) const COPIES: &[Copy] = OUTPUTS.copies.split_at(OUTPUTS.copy_count).0;
/// Every output byte.
pub(super) const PACKS: &[Pack] = OUTPUTS.packs.split_at(OUTPUTS.pack_count).0;
/// Every bool that is not reserved, consecutive ones merged.
pub(super) const BOOLS: &[Bools] = BOOL_RUNS.0.split_at(BOOL_RUNS.1).0;

/// Fields that are looked at more closely in a packet without a started controller's codes, how
/// many of their items, and how large these can be in their unit. Not here: what is reserved, and
/// registers and forces, which users write.
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

/// The same for each four bytes from the packet's front to the last of them: the bits of the
/// largest float that can stand there, 0 where nothing is looked at.
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

/// No joint turns this far.
pub(super) const FARTHEST_RAD: f32 = 1000.0;

/// Where the TCP's actual pose stands.
pub(super) const TCP_POSE: usize = row("tcp_pose").offset as usize;
/// Where the four state codes stand.
pub(super) const STATES: usize = row("operation_mode").offset as usize;

/// A field that is not in the table does not build.
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

struct Outputs {
    copies: [Copy; SPANS.len()],
    copy_count: usize,
    packs: [Pack; 32],
    pack_count: usize,
}

const OUTPUTS: Outputs = {
    let mut all = Outputs {
        copies: [Copy { from: 0, to: 0, len: 0 }; SPANS.len()],
        copy_count: 0,
        packs: [Pack { from: 0, to: 0, mask: 0 }; 32],
        pack_count: 0,
    };
    let (mut row, mut var, mut image) = (0, 0, 0);
    while row < SPANS.len() {
        let span = &SPANS[row];
        let (size, count) = (span.ty.size(), span.len());
        if let (Some(from), true) = (span.stream, var >= INPUT_COUNT) {
            let from = from as usize;
            if size == 1 {
                let mut nth = 0;
                while nth < count {
                    all.packs[all.pack_count] =
                        Pack { from: from + nth * 8, to: image + nth, mask: span.valid_bits };
                    all.pack_count += 1;
                    nth += 1;
                }
            } else {
                let len = size * count;
                let last = all.copies[all.copy_count.saturating_sub(1)];
                if all.copy_count > 0 && last.from + last.len == from && last.to + last.len == image {
                    all.copies[all.copy_count - 1].len += len;
                } else {
                    all.copies[all.copy_count] = Copy { from, to: image, len };
                    all.copy_count += 1;
                }
            }
        }
        image += size * count;
        var += count;
        row += 1;
    }
    all
};

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

/// Where the last field ends; a table with a gap or an overlap does not build.
pub(super) const LEN: usize = {
    let (mut row, mut end) = (0, 0);
    while row < FIELDS.len() {
        assert!(FIELDS[row].offset as usize == end, "the packet's table has a gap or an overlap");
        end += FIELDS[row].ty.size() * FIELDS[row].count as usize;
        row += 1;
    }
    end
};
