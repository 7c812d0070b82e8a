use super::*;
use crate::wire::scalar::ScalarType;

fn var(name: &str) -> SysVar {
    SysVar::parse(name).unwrap()
}

#[test]
fn the_table_is_as_long_as_the_specification_says() {
    let of = |group| SysVar::all().filter(|v| v.group() == group).count();
    assert_eq!(of("DigitalOutputCommand"), 3);
    assert_eq!(of("BitInputReg"), 10);
    assert_eq!(of("WordInputReg"), 32);
    assert_eq!(of("FloatInputReg"), 32);
    assert_eq!(of("ForceEnd"), 6);
    assert_eq!(of("ForceBase"), 6);
    assert_eq!(of("DigitalSignalStatus"), 8);
    assert_eq!(of("RobotState"), 32);
    assert_eq!(of("BitOutputReg"), 10);
    assert_eq!(of("WordOutputReg"), 32);
    assert_eq!(of("FloatOutputReg"), 32);
    assert_eq!((INPUT_COUNT, COUNT), (89, 203));
    assert_eq!((INPUT_BYTES, IMAGE_BYTES), (253, 591));
}

#[test]
fn places_are_those_of_the_specification() {
    let stream = |name| var(name).stream().map(|place| (place.offset, place.len));
    assert_eq!(stream("RobotState[8]"), Some((368, 4)));
    assert_eq!(stream("RobotState[13]"), Some((388, 4)));
    assert_eq!(stream("RobotState[25]"), Some((628, 4)));
    assert_eq!(stream("RobotState[26]"), None);
    assert_eq!(stream("DigitalSignalStatus[2]"), Some((744, 8)));
    assert_eq!(stream("BitOutputReg[10]"), Some((1240, 8)));
    assert_eq!(stream("WordOutputReg[32]"), Some((1374, 2)));
    assert_eq!(stream("FloatInputReg[32]"), Some((956, 4)));
    assert_eq!(stream("ForceEnd[1]"), None);

    let modbus = |name| var(name).modbus();
    assert_eq!(modbus("DigitalOutputCommand[2]"), Some(ModbusPlace::Coils { first: 200, count: 8 }));
    assert_eq!(modbus("DigitalOutputCommand[3]"), Some(ModbusPlace::Coils { first: 216, count: 2 }));
    assert_eq!(modbus("BitInputReg[10]"), Some(ModbusPlace::Coils { first: 88, count: 8 }));
    assert_eq!(modbus("WordInputReg[32]"), Some(ModbusPlace::Register { address: 39 }));
    assert_eq!(modbus("RobotState[7]"), Some(ModbusPlace::Scaled { address: 98, per_unit: 1_000 }));
    assert_eq!(modbus("RobotState[13]"), Some(ModbusPlace::Scaled { address: 111, per_unit: 10_000 }));
    assert_eq!(modbus("FloatOutputReg[1]"), None);
    assert_eq!(var("DigitalSignalStatus[3]").valid_bits(), 0b11);
}

#[test]
fn places_of_a_row_follow_each_other() {
    for span in &SPANS {
        let row: std::vec::Vec<_> = SysVar::all().filter(|v| core::ptr::eq(v.span(), span)).collect();
        assert_eq!(row.len(), span.len());
        for (nth, v) in row.iter().enumerate() {
            let place = v.place();
            assert_eq!((place.left_in_row, place.image_offset), (row.len() - nth, v.image_offset()), "{v}");
            let further =
                |first: u16, each: u16| first.checked_add(each.checked_mul(nth as u16).unwrap()).unwrap();
            let modbus = span.modbus.map(|first| match first {
                ModbusPlace::Coils { first, count } => {
                    ModbusPlace::Coils { first: further(first, count), count }
                }
                ModbusPlace::Register { address } => ModbusPlace::Register { address: further(address, 1) },
                ModbusPlace::Scaled { address, per_unit } => {
                    ModbusPlace::Scaled { address: further(address, 1), per_unit }
                }
            });
            assert_eq!(place.modbus, modbus, "{v}");
        }
    }
}

#[test]
fn every_name_means_the_variable_that_prints_it() {
    use std::string::ToString;
    let mut offset = 0;
    for v in SysVar::all() {
        assert_eq!(var(&v.to_string()), v);
        assert_eq!(var(&std::format!("__{}_{}", v.group(), v.index())), v);
        assert_eq!(v.image_offset(), offset, "{v}: the image has no gaps");
        offset += v.size();
    }
    assert_eq!(offset, IMAGE_BYTES);
    assert_eq!(var("ForceEnd[1]").direction(), Direction::Input);
    assert_eq!(var("DigitalSignalStatus[1]").direction(), Direction::Output);
    assert_eq!(var("WordInputReg[1]").ty(), ScalarType::Word);
}

#[test]
fn ranges_keep_their_order() {
    let names = VarRange::parse("RobotState[8..13]").unwrap();
    assert_eq!(names.iter().len(), 6);
    assert!(names.iter().map(|v| v.index()).eq(8..=13));
    let across_rows = VarRange::parse("DigitalOutputCommand[1..3]").unwrap();
    assert!(across_rows.iter().map(|v| v.index()).eq(1..=3));
}

#[test]
fn wrong_names_say_what_there_is() {
    let refused = |name| VarRange::parse(name).unwrap_err();
    assert_eq!(refused("RobotState"), ParseError::Syntax);
    assert_eq!(refused("RobotState[]"), ParseError::Syntax);
    assert_eq!(refused("RobotState[-1]"), ParseError::Syntax);
    assert_eq!(refused("RobotState[+1]"), ParseError::Syntax);
    assert_eq!(refused("RobotState[8"), ParseError::Syntax);
    assert_eq!(refused("RobotState[99999999999]"), ParseError::Syntax);
    assert_eq!(refused("robotstate[1]"), ParseError::UnknownGroup);
    assert_eq!(refused("__RobotState8"), ParseError::Syntax);
    assert_eq!(refused("RobotState[9..8]"), ParseError::Backwards { first: 9, last: 8 });
    let past = ParseError::OutOfRange { group: "RobotState", index: 33, last: 32 };
    assert_eq!(refused("RobotState[33]"), past);
    assert_eq!(refused("RobotState[30..33]"), past);
    let zero = ParseError::OutOfRange { group: "DigitalOutputCommand", index: 0, last: 3 };
    assert_eq!(refused("DigitalOutputCommand[0]"), zero);
    assert_eq!(SysVar::parse("RobotState[1..2]"), Err(ParseError::NotSingle));
}

#[test]
fn only_digital_outputs_are_shown_by_another_variable() {
    let shown: std::vec::Vec<_> = SysVar::all().filter_map(|var| Some((var, var.shown_by()?))).collect();
    let named: std::vec::Vec<_> =
        shown.iter().map(|(var, by)| (std::format!("{var}"), std::format!("{by}"))).collect();
    let expected = [1, 2, 3]
        .map(|n| (std::format!("DigitalOutputCommand[{n}]"), std::format!("DigitalSignalStatus[{}]", n + 3)));
    assert_eq!(named, expected);
}
