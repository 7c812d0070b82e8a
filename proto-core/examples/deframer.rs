//! Frames out of a byte stream: a recipe's layout, noise before a frame, a frame that lost its end, and
//! chunks that end anywhere. `cargo run -p proto-core --example deframer` prints deframer.out.

use std::error::Error;

use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{Deframer, StreamLayout};
use proto_core::sysvar::{Direction, VarRange};

/// What came over the line (docs/wire/recipes.md section 8 has frames like these).
const LINE: [&str; 4] = [
    "00 FF 37",                            // noise, one byte of it like half of a head
    "FF FF 01 00 00 80 3F EE EE FF FF 02", // a whole frame, and the beginning of the next
    "00 00 00 40 EE EE FF FF 03",          // the rest of it; and one that loses its end
    "FF FF 04 00 00 80 40 EE EE FF FF 05", // a whole frame, and one whose rest never comes
];

fn main() -> Result<(), Box<dyn Error>> {
    // The input part of a realtime recipe: eight outputs in a byte, and a register that holds a float.
    let rules = Rules { mode: Mode::Realtime, direction: Direction::Input };
    let fields = variables("DigitalOutputCommand[1]")?.chain(variables("FloatInputReg[1]")?);
    let layout = StreamLayout::new(rules, &[0xFF, 0xFF], &[0xEE, 0xEE], fields, Framing::Bytes)?;
    println!("a frame has {} bytes", layout.frame_len());

    let mut deframer = Deframer::new();
    for dump in LINE {
        println!("{dump}");
        let received = bytes(dump)?;
        let mut chunk = received.as_slice();
        while let Some(payload) = deframer.next_frame(&layout, &mut chunk) {
            // A float that is not finite rejects the whole frame.
            if let Err(reason) = layout.check(payload) {
                println!("  rejected: {reason}");
                continue;
            }
            for (placed, value) in layout.fields().zip(layout.values(payload)) {
                if let Field::System(var) = placed.field {
                    println!("  {var} = {value}");
                }
            }
        }
    }

    // The line has been silent for longer than the idle gap.
    println!("silence: {} bytes of a partial frame are dropped", deframer.discard());
    let stats = deframer.stats();
    println!(
        "{} frames, {} bytes skipped, {} wrong tails",
        stats.frames, stats.skipped_bytes, stats.tail_mismatches
    );
    Ok(())
}

fn variables(names: &str) -> Result<impl Iterator<Item = Field>, Box<dyn Error>> {
    Ok(VarRange::parse(names)?.iter().map(Field::System))
}

fn bytes(dump: &str) -> Result<Vec<u8>, std::num::ParseIntError> {
    dump.split_whitespace().map(|byte| u8::from_str_radix(byte, 16)).collect()
}
