//! Helpers for the tests of whole cells.

use proto_core::config::GatewayConfig;
use proto_core::wire::can::{CanFrame, CanId};
use recipe_cell::{Cell, LineId};
use recipe_config::{SimConfig, file};
use recipe_test_kit::example;

/// The gateway's example file of this name, and the controller's.
#[track_caller]
pub(crate) fn files(name: &str) -> (Box<GatewayConfig>, SimConfig) {
    let gateway = file::load_gateway(&example(&format!("{name}.toml")), &[]);
    let controller = file::load_controller(&example(&format!("{name}-controller.toml")), &[]);
    match (gateway, controller) {
        (Ok(gateway), Ok(controller)) => (gateway, controller),
        (gateway, controller) => panic!("{:?} {:?}", gateway.err(), controller.err()),
    }
}

/// The cell of these files, half a second after it was switched on.
#[track_caller]
pub(crate) fn cell(name: &str) -> Cell {
    let (gateway, controller) = files(name);
    let mut cell = Cell::new(&gateway, &controller, 1).unwrap_or_else(|error| panic!("{error}"));
    cell.run_ms(500);
    cell
}

/// The frame of the worked examples that writes DigitalOutputCommand[1].
pub(crate) const fn outputs(byte: u8) -> [u8; 5] {
    [0xFF, 0xFF, byte, 0xEE, 0xEE]
}

/// What the port has sent on its line since the last call.
pub(crate) fn heard(cell: &mut Cell, line: LineId) -> Vec<Vec<u8>> {
    cell.line(line).take_heard().into_iter().map(|(_, bytes)| bytes).collect()
}

pub(crate) fn can(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), data).unwrap()
}

/// The force sensor's frame: 28 bytes.
pub(crate) fn force_frame(values: [f32; 6]) -> Vec<u8> {
    let mut frame = vec![0x48, 0xAA];
    frame.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    frame.extend([0x0D, 0x0A]);
    frame
}

/// The force sensor's values in the controller.
pub(crate) fn force(cell: &Cell) -> [f32; 6] {
    std::array::from_fn(|nth| cell.value(&format!("ForceEnd[{}]", nth + 1)) as f32)
}

/// Checks that frames get through from the device to DO1..8 of the controller; leaves them all off.
#[track_caller]
pub(crate) fn outputs_get_through(cell: &mut Cell, line: LineId) {
    for byte in [0xA5, 0x5A, 0x00] {
        cell.send(line, &outputs(byte));
        cell.run_ms(10);
        assert_eq!(cell.value("DigitalOutputCommand[1]"), f64::from(byte));
        assert_eq!(cell.value("DO[1]"), f64::from(byte & 1));
    }
}
