//! Decodes captured bytes with the recipes they were sent by: the worked examples of
//! docs/wire/recipes.md section 8. Run it with `cargo run -p proto-core --example decode_capture`.

use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{CanLayout, Deframer, PartError, PlacedField, StreamLayout, datagram};
use proto_core::sysvar::{Direction, VarRange};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};

const REALTIME_IN: Rules = Rules { mode: Mode::Realtime, direction: Direction::Input };
const REALTIME_OUT: Rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
const USER_IN: Rules = Rules { mode: Mode::User, direction: Direction::Input };
const USER_OUT: Rules = Rules { mode: Mode::User, direction: Direction::Output };

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let three_bytes = || vec![Field::User(ScalarType::Byte); 3];

    println!("RS-485, user-defined");
    read_stream(&to_robot(USER_IN, three_bytes())?, "FF FF 01 02 03 EE EE")?;
    read_stream(&to_user(USER_OUT, three_bytes())?, "FF FF 7D 7D 7D FE FE")?;

    println!("\nRS-485, realtime; with noise before the frame and a frame that lost its end");
    let command = to_robot(REALTIME_IN, variables("DigitalOutputCommand[1]")?)?;
    read_stream(&command, "00 FF 37 FF FF 01 EE FF FF 01 EE EE")?;

    println!("\nCAN, user-defined");
    let input = CanLayout::new(USER_IN, [(CanId::Standard(1), three_bytes())])?;
    read_can(&input, CanId::Standard(1), "01 02 03")?;
    let output = CanLayout::new(USER_OUT, [(CanId::Standard(2), three_bytes())])?;
    read_can(&output, CanId::Standard(2), "7D 7D 7D")?;

    println!("\nCAN, realtime");
    let pose = CanLayout::new(
        REALTIME_OUT,
        [
            (CanId::Standard(2), variables("RobotState[8..9]")?),
            (CanId::Standard(3), variables("RobotState[10..11]")?),
            (CanId::Standard(4), variables("RobotState[12..13]")?),
        ],
    )?;
    read_can(&pose, CanId::Standard(2), "EF 54 EF 3E A7 E7 D1 3E")?;
    read_can(&pose, CanId::Standard(5), "00")?;

    println!("\nUDP 2011, one frame a datagram");
    let pose = variables("RobotState[8..13]")?;
    let layout = StreamLayout::new(REALTIME_OUT, &[255, 255], &[254, 254], pose, Framing::Datagram)?;
    let received =
        bytes("FF FF 39 2F 0B BF 86 87 13 3F BF BD 9D 3F 37 FC C8 BF 17 A0 1B BF 59 FC EA BE FE FE")?;
    show(layout.fields(), layout.values(datagram(&layout, &received)?));
    Ok(())
}

/// An input part with the head and tail of the examples.
fn to_robot(rules: Rules, fields: Vec<Field>) -> Result<StreamLayout, PartError> {
    StreamLayout::new(rules, &[255, 255], &[238, 238], fields, Framing::Bytes)
}

/// An output part with the head and tail of the examples.
fn to_user(rules: Rules, fields: Vec<Field>) -> Result<StreamLayout, PartError> {
    StreamLayout::new(rules, &[255, 255], &[254, 254], fields, Framing::Bytes)
}

fn variables(names: &str) -> Result<Vec<Field>, Failure> {
    Ok(VarRange::parse(names)?.iter().map(Field::System).collect())
}

fn bytes(dump: &str) -> Result<Vec<u8>, std::num::ParseIntError> {
    dump.split_whitespace().map(|byte| u8::from_str_radix(byte, 16)).collect()
}

fn read_stream(layout: &StreamLayout, dump: &str) -> Result<(), Failure> {
    println!("  {dump}");
    let line = bytes(dump)?;
    let mut deframer = Deframer::new();
    // A line delivers bytes as it likes; three at a time here.
    for mut chunk in line.chunks(3) {
        while let Some(payload) = deframer.next_frame(layout, &mut chunk) {
            layout.check(payload)?;
            show(layout.fields(), layout.values(payload));
        }
    }
    let stats = deframer.stats();
    if stats.skipped_bytes > 0 {
        println!("    {} bytes skipped, {} wrong tails", stats.skipped_bytes, stats.tail_mismatches);
    }
    Ok(())
}

fn read_can(layout: &CanLayout, id: CanId, dump: &str) -> Result<(), Failure> {
    println!("  id {id}: {dump}");
    let received = CanFrame::new(id, &bytes(dump)?).ok_or("no CAN frame looks like this")?;
    match layout.accept(&received) {
        Ok(index) => {
            let frame = layout.frame(index).ok_or("accept gives indices of frames")?;
            frame.check(received.data())?;
            show(frame.fields(), frame.values(received.data()));
        }
        Err(reason) => println!("    ignored: {reason}"),
    }
    Ok(())
}

fn show(fields: impl Iterator<Item = PlacedField>, values: impl Iterator<Item = Scalar>) {
    for (placed, value) in fields.zip(values) {
        match placed.field {
            Field::System(var) => println!("    {var} = {value}"),
            Field::User(ty) => println!("    {ty} at offset {} = {value}", placed.offset),
        }
    }
}
