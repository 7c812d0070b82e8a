//! CAN frames by a recipe: which ids it takes, and what their bytes mean; the worked examples of
//! docs/wire/recipes.md section 8. `cargo run -p proto-core --example can_frames` prints can_frames.out.

use std::error::Error;

use proto_core::recipe::CanLayout;
use proto_core::recipe::model::{Field, Mode, Rules};
use proto_core::sysvar::{Direction, VarRange};
use proto_core::wire::can::{CanFrame, CanId};

fn main() -> Result<(), Box<dyn Error>> {
    // The output part of a realtime recipe: the pose of the tool in three frames.
    let rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
    let pose = CanLayout::new(
        rules,
        [
            (CanId::Standard(2), variables("RobotState[8..9]")?),
            (CanId::Standard(3), variables("RobotState[10..11]")?),
            (CanId::Standard(4), variables("RobotState[12..13]")?),
        ],
    )?;
    show(&pose, CanId::Standard(2), &[0xEF, 0x54, 0xEF, 0x3E, 0xA7, 0xE7, 0xD1, 0x3E])?;
    show(&pose, CanId::Standard(3), &[0x00, 0x00, 0x80, 0x3F])?;
    show(&pose, CanId::Standard(5), &[0x00])?;
    show(&pose, CanId::Extended(2), &[0x00; 8])?;
    Ok(())
}

fn show(layout: &CanLayout, id: CanId, data: &[u8]) -> Result<(), Box<dyn Error>> {
    println!("id {id}: {data:02X?}");
    let received = CanFrame::new(id, data).ok_or("no CAN frame has so many bytes, or such an id")?;
    let index = match layout.accept(&received) {
        Ok(index) => index,
        Err(reason) => {
            println!("  ignored: {reason}");
            return Ok(());
        }
    };
    let frame = layout.frame(index).ok_or("`accept` gives indices of frames")?;
    frame.check(received.data())?;
    for (placed, value) in frame.fields().zip(frame.values(received.data())) {
        if let Field::System(var) = placed.field {
            println!("  {var} = {value}");
        }
    }
    Ok(())
}

fn variables(names: &str) -> Result<Vec<Field>, Box<dyn Error>> {
    Ok(VarRange::parse(names)?.iter().map(Field::System).collect())
}
