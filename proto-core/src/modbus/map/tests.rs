use std::vec::Vec;

use super::*;
use crate::sysvar::{Direction, ModbusPlace, SysVar};

fn writable(space: Space, len: u16) -> Vec<u16> {
    (0..len).filter(|address| check_write(space, *address, 1).is_ok()).collect()
}

#[test]
fn the_map_is_the_specifications() {
    assert_eq!((COILS, HOLDING), (232, 118));
    let coils: Vec<u16> = (0..16).chain(32..96).chain(192..208).chain(216..224).collect();
    assert_eq!(writable(Space::Coils, 300), coils);
    let holding: Vec<u16> = (8..40).chain(80..88).chain(90..92).collect();
    assert_eq!(writable(Space::Holding, 300), holding);
}

#[test]
fn every_variable_with_a_place_lies_in_a_row_that_agrees_with_it() {
    for var in SysVar::all() {
        let (space, first, count, per_unit) = match var.modbus() {
            Some(ModbusPlace::Coils { first, count }) => (Space::Coils, first, count, 0),
            Some(ModbusPlace::Register { address }) => (Space::Holding, address, 1, 0),
            Some(ModbusPlace::Scaled { address, per_unit }) => (Space::Holding, address, 1, per_unit),
            None => continue,
        };
        let mut rows = MAP.iter().filter(|row| row.space == space && row.first <= first && first < row.end());
        let row = rows.next().unwrap();
        assert!(first + count <= row.end() && rows.next().is_none(), "{var:?}");
        assert_eq!(row.per_unit, per_unit, "{var:?}");
        if var.direction() == Direction::Input {
            assert_eq!(check_write(space, first, count), Ok(()), "{var:?}");
        }
    }
}

#[test]
fn runs_are_refused_where_one_item_is() {
    let refused = Err(Exception::IllegalDataAddress);
    assert_eq!(check_write(Space::Coils, 32, 64), Ok(()));
    assert_eq!(check_write(Space::Coils, 32, 65), refused);
    assert_eq!(check_write(Space::Coils, 31, 2), refused);
    assert_eq!(check_write(Space::Holding, 80, 8), Ok(()));
    assert_eq!(check_write(Space::Holding, 80, 11), refused, "tool analog inputs lie between");
    assert_eq!(check_write(Space::Holding, 0xFFFF, 2), refused);
    assert_eq!(check_read(Space::Coils, 0, 232), Ok(()));
    assert_eq!(check_read(Space::Coils, 231, 2), refused);
    assert_eq!(check_read(Space::Holding, 117, 1), Ok(()));
    assert_eq!(check_read(Space::Holding, 118, 1), refused);
    assert_eq!(check_read(Space::Holding, 0xFFFF, 2), refused);
}

#[test]
fn scaled_values_round_saturate_and_never_become_garbage() {
    assert_eq!(scaled(1.5, 1_000), 1_500);
    assert_eq!(scaled(-0.0004, 1_000), 0);
    assert_eq!(scaled(-0.0006, 1_000), 0xFFFF);
    assert_eq!(scaled(1.232_353, 10_000), 12_324);
    assert_eq!(scaled(-1.570_197, 10_000) as i16, -15_702);
    assert_eq!((scaled(40.0, 1_000), scaled(-40.0, 1_000) as i16), (32_767, -32_767));
    assert_eq!((scaled(f32::INFINITY, 1_000), scaled(f32::NEG_INFINITY, 1) as i16), (32_767, -32_767));
    assert_eq!((scaled(f32::NAN, 1_000), scaled(f32::MAX, 10_000)), (0, 32_767));
    for counts in -32_767..=32_767_i16 {
        assert_eq!(scaled(unscaled(counts as u16, 10_000), 10_000) as i16, counts);
    }
    assert_eq!(unscaled(7, 0), 7.0);
}
