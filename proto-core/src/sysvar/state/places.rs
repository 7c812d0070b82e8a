//! The copies from the packet into the image, computed at compile time.
#![allow(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "all of it runs in constants: an index out of range or an overflow fails the build"
)]

use crate::sysvar::{INPUT_COUNT, SPANS};

/// Bytes of the packet that are copied unchanged.
#[derive(Debug, Clone, Copy)]
pub(super) struct Copy {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) len: usize,
}

/// Eight bool bytes of the packet that are packed into one byte of the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pack {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) mask: u8,
}

/// All output words and floats; consecutive ones are merged.
pub(super) const COPIES: &[Copy] = OUTPUTS.copies.split_at(OUTPUTS.copy_count).0;
/// All output bytes.
pub(super) const PACKS: &[Pack] = OUTPUTS.packs.split_at(OUTPUTS.pack_count).0;
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
