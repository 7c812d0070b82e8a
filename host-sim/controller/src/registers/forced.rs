//! Items of the state packet that a test sets in place of the model's values.

use proto_core::wire::scalar::{Scalar, ScalarError, ScalarType};
use proto_core::wire::state::{FIELDS, LEN};

/// The items, by their offset in the packet.
#[derive(Debug, Clone, Default)]
pub(super) struct Forced(Vec<(PacketItem, Scalar)>);

/// One item of the state packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PacketItem {
    offset: usize,
    ty: ScalarType,
}

impl PacketItem {
    /// The item `FIELD[N]` with N from 1, or `FIELD` if it has only one value, by the names of
    /// proto-core/docs/wire/state.md section 2, including reserved items.
    pub(crate) fn named(name: &str) -> Option<Self> {
        let (field, index) = match name.strip_suffix(']').and_then(|name| name.split_once('[')) {
            Some((field, index)) => (field, Some(index.parse::<usize>().ok()?)),
            None => (name, None),
        };
        let place = FIELDS.iter().find(|place| place.name == field)?;
        let count = usize::from(place.count);
        let nth = match index {
            Some(index) => index.checked_sub(1).filter(|&nth| nth < count)?,
            None => Some(0).filter(|_| count == 1)?,
        };
        Some(Self { offset: usize::from(place.offset) + nth * place.ty.size(), ty: place.ty })
    }

    /// The item's value in a packet.
    pub(crate) fn read(self, packet: &[u8; LEN]) -> f64 {
        let bytes = packet.get(self.offset..).unwrap_or(&[]);
        Scalar::decode(self.ty, bytes).map_or(0.0, |value| value.as_f64())
    }
}

impl Forced {
    pub(super) fn set(&mut self, item: PacketItem, value: f64) -> Result<(), ScalarError> {
        let value = Scalar::from_f64(item.ty, value)?;
        self.release(item);
        self.0.push((item, value));
        Ok(())
    }

    pub(super) fn release(&mut self, item: PacketItem) {
        self.0.retain(|forced| forced.0 != item);
    }

    pub(super) fn put(&self, packet: &mut [u8; LEN]) {
        // A drive with an error is not enabled, unless the test sets its status as well.
        let (error, status) = (offset_of("drive_error"), offset_of("drive_status"));
        for (item, value) in &self.0 {
            let is_error = (error..status).contains(&item.offset) && value.as_f64() != 0.0;
            let place = packet.get_mut(item.offset + status - error..).filter(|_| is_error);
            place.and_then(|place| Scalar::Dword(DRIVE_FAULT).encode(place));
        }
        for (item, value) in &self.0 {
            value.encode(packet.get_mut(item.offset..).unwrap_or(&mut []));
        }
    }
}

fn offset_of(field: &str) -> usize {
    FIELDS.iter().find(|place| place.name == field).map_or(0, |place| place.offset.into())
}

/// Status word of a servo drive as in CiA 402: fault.
const DRIVE_FAULT: u32 = 0x0618;
