//! Single bits in output fields, and safe bits from the start (docs/engine.md section 5).

mod rig;

use proto_core::config::*;
use proto_core::device::Encoding;
use proto_core::engine::{LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::VarBit;
use proto_core::wire::scalar::ScalarType as T;
use rig::*;

const BYTE: &str = "BitInputReg[3]";
/// The byte's first coil in the Modbus map.
const COILS: usize = 32;

fn bit(name: &str) -> VarBit {
    VarBit::parse(name).unwrap().unwrap()
}

fn from_bit(name: &str) -> OutputBinding {
    let VarBit { var, bit } = bit(name);
    OutputBinding::Bit { var, bit }
}

/// A device that is sent one byte for each of these sources.
fn lamps(cell: &mut Cell, sources: &[OutputBinding]) -> PortId {
    let fields = cell.fields(sources.iter().map(|&from| user_out(T::Byte, from)));
    let output = cell.part(&[0xFD], &[], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.rs485(recipe)
}

/// A device that sends one byte for each of these bits.
fn buttons(cell: &mut Cell, bits: &[&str]) -> PortId {
    let to = bits.iter().map(|name| bit(name));
    let fields = to.map(|VarBit { var, bit }| user_in(T::Byte, InputBinding::Bit { var, bit }));
    let fields = cell.fields(fields);
    let input = cell.part(&[0xFF], &[], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe)
}

fn newest(rig: &mut Rig, port: PortId) -> Vec<u8> {
    rig.sent_to(port).pop().unwrap_or_default()
}

#[test]
fn a_field_shows_one_bit_of_a_variable_that_another_device_sends() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let device = cell.rs485(recipe);
    let shown = ["DigitalOutputCommand[1].0", "DigitalOutputCommand[1].7", "DigitalOutputCommand[1].3"];
    let port = lamps(&mut cell, &shown.map(from_bit));
    let mut rig = cell.rig();
    rig.run(MS(20));
    assert!(rig.sent_to(port).is_empty(), "the byte is not known yet");
    rig.bytes(device, &[255, 255, 0b1000_0001, 238, 238]);
    rig.run(MS(10));
    assert_eq!(newest(&mut rig, port), [0xFD, 1, 1, 0]);
    rig.bytes(device, &[255, 255, 0b0000_1000, 238, 238]);
    rig.run(MS(10));
    assert_eq!(newest(&mut rig, port), [0xFD, 0, 0, 1]);
}

/// What our devices drive is shown as they sent it; the other bits as the controller has them.
#[test]
fn a_field_shows_bits_of_a_byte_whose_bits_have_owners() {
    let mut cell = Cell::new();
    let device = buttons(&mut cell, &["BitInputReg[3].4"]);
    let port = lamps(&mut cell, &["BitInputReg[3].4", "BitInputReg[3].7"].map(from_bit));
    let mut rig = cell.rig();
    rig.map.coils[COILS + 7] = true;
    rig.run(MS(50));
    assert_eq!(newest(&mut rig, port), [0xFD, 0, 1]);
    rig.bytes(device, &[0xFF, 1]);
    rig.map.coils[COILS + 7] = false;
    rig.run(MS(50));
    assert_eq!(newest(&mut rig, port), [0xFD, 1, 0]);
}

#[test]
fn a_devices_own_frame_packs_bits_into_one_byte() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&[BYTE], &[]);
    let device = cell.rs485(recipe);
    let packed = |from: &str, encoding| FieldSpec::DeviceOutput {
        encoding,
        overflow: Default::default(),
        from: from_bit(from),
    };
    let fields = cell.fields([
        packed("BitInputReg[3].6", Encoding::bit(T::Byte, 0)),
        packed("BitInputReg[3].1", Encoding::bit(T::Byte, 1).shared()),
    ]);
    let output = cell.part(&[0xFD], &[], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    for (byte, sent) in [(0b0100_0000, 0b01), (0b0000_0010, 0b10), (0b1011_1101, 0), (0b0100_0010, 0b11)] {
        rig.bytes(device, &[255, 255, byte, 238, 238]);
        rig.run(MS(10));
        assert_eq!(newest(&mut rig, port), [0xFD, sent]);
    }
}

#[test]
fn a_source_has_the_bit() {
    for (name, said) in [
        ("WordOutputReg[3].2", "WordOutputReg[3] is a word without bits"),
        ("BitOutputReg[3].8", "BitOutputReg[3] has no bit 8; allowed: 0..=7"),
        ("DigitalOutputCommand[3].2", "DigitalOutputCommand[3] has no bit 2; allowed: 0..=1"),
    ] {
        let mut cell = Cell::new();
        lamps(&mut cell, &[from_bit(name)]);
        let error = cell.0.validate().unwrap_err();
        let message = cell.0.view().describe(error).to_string();
        assert!(message.contains(said), "{message}");
    }
}

#[test]
fn safe_bits_are_written_from_the_start_until_the_device_speaks() {
    let mut cell = Cell::new();
    let device = buttons(&mut cell, &["BitInputReg[3].0", "BitInputReg[3].4"]);
    for name in ["BitInputReg[3].0", "BitInputReg[3].4"] {
        cell.0.safe_values.push(SafeValue::bit(bit(name), name.ends_with('4'))).unwrap();
        cell.last_port().on_timeout.len += 1;
    }
    cell.last_port().safe_at_start = true;
    let port = lamps(&mut cell, &["BitInputReg[3].0", "BitInputReg[3].4"].map(from_bit));
    let mut rig = cell.rig();
    rig.map.coils[COILS] = true;
    rig.map.coils[COILS + 1] = true;
    rig.run(MS(50));
    let coils = |rig: &Rig| [0, 1, 4].map(|bit| rig.map.coils[COILS + bit]);
    assert_eq!(coils(&rig), [false, true, true], "both safe bits, and nothing else");
    // What is polled afterwards does not replace them.
    rig.map.coils[COILS + 4] = false;
    rig.run(MS(50));
    assert_eq!(newest(&mut rig, port), [0xFD, 0, 1]);
    rig.bytes(device, &[0xFF, 1, 0]);
    rig.run(MS(20));
    assert_eq!(coils(&rig), [true, true, false]);
    assert!(rig.link(LinkId::MODBUS).counters.sent > 0);
}
