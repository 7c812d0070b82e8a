//! Acceptance filtering of FDCAN1. RM0433, "Acceptance filtering" and the sections on filter elements.

use crate::models::can_bus::Frame;

/// The values of the filter registers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Filters {
    /// GFC.
    pub(super) others: u32,
    /// SIDFC.
    pub(super) standard: u32,
    /// XIDFC.
    pub(super) extended: u32,
    /// XIDAM.
    pub(super) mask: u32,
}

impl Filters {
    /// The FIFO for a frame, and the index of the matching filter, if one matches; `None` for a rejected frame.
    pub(super) fn accept(&self, frame: &Frame, ram: &[u32]) -> Option<(usize, Option<u32>)> {
        let filters = self.others;
        let fifo = |code: u32| match code {
            1 | 5 => Some(0),
            2 | 6 => Some(1),
            _ => None,
        };
        let others = |code: u32| (code < 2).then_some((code as usize, None));
        let id = frame.id;
        if frame.is_remote && filters >> u32::from(!frame.is_extended) & 1 != 0 {
            return None;
        }
        if frame.is_extended {
            let list = self.extended;
            for index in 0..(list >> 16 & 0x7F) as usize {
                let place = (list & 0xFFFC) as usize / 4 + 2 * index;
                let (first, second) = (ram[place], ram[place + 1]);
                let (a, b) = (first & 0x1FFF_FFFF, second & 0x1FFF_FFFF);
                let masked = id & self.mask;
                let matches = match second >> 30 {
                    0 => (a..=b).contains(&masked),
                    1 => id == a || id == b,
                    2 => id & b == a & b,
                    _ => (a..=b).contains(&id),
                };
                if first >> 29 != 0 && matches {
                    return Some((fifo(first >> 29)?, Some(index as u32)));
                }
            }
            return others(filters >> 2 & 3);
        }
        let list = self.standard;
        for index in 0..(list >> 16 & 0xFF) as usize {
            let word = ram[(list & 0xFFFC) as usize / 4 + index];
            let (a, b) = (word >> 16 & 0x7FF, word & 0x7FF);
            let matches = match word >> 30 {
                0 => (a..=b).contains(&id),
                1 => id == a || id == b,
                2 => id & b == a & b,
                _ => false,
            };
            if word >> 27 & 7 != 0 && matches {
                return Some((fifo(word >> 27 & 7)?, Some(index as u32)));
            }
        }
        others(filters >> 4 & 3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_ids_a_range_and_a_mask() {
        let element = |kind: u32, fifo: u32, a: u32, b: u32| kind << 30 | fifo << 27 | a << 16 | b;
        let ram = [element(1, 1, 0x10, 0x12), element(0, 2, 0x20, 0x2F), element(2, 1, 0x100, 0x700)];
        let filters = Filters { others: 0x28, standard: 3 << 16, extended: 0, mask: 0x1FFF_FFFF };
        let accept = |id: u32| filters.accept(&Frame::standard(id, &[]), &ram);
        assert_eq!(
            [0x10, 0x20, 0x100].map(|id| accept(id).and_then(|(_, index)| index)),
            [Some(0), Some(1), Some(2)]
        );
        let fifo = |id: u32| accept(id).map(|(fifo, _)| fifo);
        assert_eq!([0x10, 0x11, 0x12].map(fifo), [Some(0), None, Some(0)]);
        assert_eq!([0x1F, 0x20, 0x2F, 0x30].map(fifo), [None, Some(1), Some(1), None]);
        assert_eq!([0x100, 0x1FF, 0x200].map(fifo), [Some(0), Some(0), None]);
        let extended = Frame { is_extended: true, ..Frame::standard(0x10, &[]) };
        assert_eq!(filters.accept(&extended, &ram), None);
    }
}
