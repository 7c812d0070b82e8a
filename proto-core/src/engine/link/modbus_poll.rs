//! Answers to polls of the Modbus link.
//!
//! In: a block of addresses, the variables that are polled, and the answer. Out: their values in the
//! image. Does not know when polls are made.

use super::modbus::{Block, Kind};
use crate::engine::values::store::Store;
use crate::modbus::Coils;
use crate::modbus::pdu::Response;
use crate::sysvar::{ModbusPlace, SysVar};
use crate::wire::scalar::Scalar;

/// Writes the answer to a poll into the image.
pub(crate) fn take_poll(block: &Block, polled: &[SysVar], response: Response<'_>, store: &mut Store) {
    if store.bits.is_used {
        take_values_beside_bits(block, polled, response, store);
    } else {
        take_values(block, polled, response, |var, value| {
            // The table gives the variable's type, and bits beyond it were not read.
            let _ = store.image.set(var, value);
        });
    }
    store.image.stamp(block.group, store.now);
    store.unconfirm_by_witnesses();
}

/// The same where bits have owners.
fn take_values_beside_bits(block: &Block, polled: &[SysVar], response: Response<'_>, store: &mut Store) {
    take_values(block, polled, response, |var, value| match value {
        Scalar::Byte(shown) if store.bits.bytes.contains(var) => store.show_bits(var, shown),
        value => _ = store.image.set(var, value),
    });
}

fn take_values(
    block: &Block,
    polled: &[SysVar],
    response: Response<'_>,
    mut take: impl FnMut(SysVar, Scalar),
) {
    for &var in polled {
        let value = match (var.modbus(), response) {
            (Some(ModbusPlace::Coils { first, count }), Response::Coils(coils)) => {
                (block.kind == Kind::Coils).then(|| bits_at(coils, first, count, block)).flatten()
            }
            (Some(ModbusPlace::Register { address }), Response::Registers(registers)) => {
                let nth = address.checked_sub(block.first).filter(|_| block.kind == Kind::Registers);
                nth.and_then(|nth| registers.register(nth)).map(Scalar::Word)
            }
            _ => None,
        };
        if let Some(value) = value {
            take(var, value);
        }
    }
}

fn bits_at(coils: Coils<'_>, first: u16, count: u16, block: &Block) -> Option<Scalar> {
    let start = first.checked_sub(block.first)?;
    let mut bits = 0_u8;
    for nth in 0..count.min(8) {
        bits |= u8::from(coils.coil(start.saturating_add(nth))?).checked_shl(u32::from(nth))?;
    }
    Some(Scalar::Byte(bits))
}
