use std::prelude::rust_2024::*;

use proptest::prelude::*;

use super::pack;
use crate::sysvar::{Direction, IMAGE_BYTES, SysVar};
use crate::wire::scalar::Scalar;
use crate::wire::state::{Content, FIELDS, LEN, StateView};

#[test]
fn every_variable_stands_at_the_beginning_of_an_item_of_its_type() {
    for var in SysVar::all() {
        let Some(place) = var.stream() else { continue };
        let field = FIELDS.iter().rfind(|field| field.offset <= place.offset).unwrap();
        assert_eq!(field.ty, var.ty(), "{var}");
        assert!(usize::from(place.offset + place.len) <= usize::from(field.offset) + field.size(), "{var}");
        assert_eq!(usize::from(place.offset - field.offset) % field.ty.size(), 0, "{var}");
        assert_ne!(field.content, Content::Reserved, "{var}");
    }
}

#[test]
fn bools_are_packed_lowest_first() {
    for bits in 0..=u8::MAX {
        for one in [1, 2, 0x80, 0xFF] {
            let bools = core::array::from_fn(|nth| if bits >> nth & 1 == 1 { one } else { 0 });
            assert_eq!(pack(&bools), bits, "{bools:?}");
        }
    }
}

proptest! {
    #[test]
    fn the_image_gets_every_output_and_nothing_else(bytes in prop::collection::vec(any::<u8>(), LEN), old: u8) {
        let view = StateView::new(&bytes).unwrap();
        let mut image = [old; IMAGE_BYTES];
        view.copy_to_image(&mut image);
        let mut expected = [old; IMAGE_BYTES];
        for var in SysVar::all().filter(|var| var.direction() == Direction::Output) {
            if let Some(value) = view.read_var(var) {
                value.encode(&mut expected[var.image_offset()..]).unwrap();
            }
        }
        prop_assert_eq!(&image[..], &expected[..]);
    }

    #[test]
    fn a_variable_reads_its_own_items(bytes in prop::collection::vec(any::<u8>(), LEN)) {
        let view = StateView::new(&bytes).unwrap();
        for var in SysVar::all() {
            let Some(place) = var.stream() else {
                prop_assert!(view.read_var(var).is_none());
                continue;
            };
            let items = &bytes[usize::from(place.offset)..usize::from(place.offset + place.len)];
            let expected = if var.is_bits() {
                let bits = items.iter().rev().fold(0, |bits, &item| bits << 1 | u8::from(item != 0));
                Scalar::Byte(bits & var.valid_bits())
            } else {
                Scalar::decode(var.ty(), items).unwrap()
            };
            let mut ours = [0; 4];
            let mut theirs = [0; 4];
            view.read_var(var).unwrap().encode(&mut ours);
            expected.encode(&mut theirs);
            prop_assert_eq!(ours, theirs, "{}", var);
        }
    }
}
