//! A cell in which every value is scaled: floats and doubles on which two processors might disagree, to and
//! from variables of every kind.

use proto_core::time::Duration;
use proto_core::wire::can::CanFrame;
use recipe_cell::{Cell, PeriodicSender, Rng};
use recipe_test_kit::toml;

use crate::cells::{can, recorded};

/// What a device sends: for each CAN id the type of its only field, and the variable that it is bound to.
const INPUTS: [(&str, &str); 16] = [
    ("double", r#"to = "FloatInputReg[1]""#),
    ("double", r#"to = "FloatInputReg[2]", scale = 0.1, offset = -3.3"#),
    ("double", r#"to = "FloatInputReg[3]", scale = 1e-30, offset = 1e-40"#),
    ("double", r#"to = "FloatInputReg[4]", scale = -57.29578"#),
    ("float", r#"to = "FloatInputReg[5]""#),
    ("float", r#"to = "FloatInputReg[6]", scale = 0.33333334, offset = 1e9"#),
    ("float", r#"to = "FloatInputReg[7]", scale = 1e30"#),
    ("int", r#"to = "FloatInputReg[8]", scale = 0.001"#),
    ("dword", r#"to = "FloatInputReg[9]", scale = 16777217, offset = 0.5"#),
    ("double", r#"to = "WordInputReg[1]""#),
    ("double", r#"to = "WordInputReg[2]", scale = 0.5, offset = 0.5"#),
    ("float", r#"to = "WordInputReg[3]", scale = 10, offset = -0.05"#),
    ("short", r#"to = "WordInputReg[4]", scale = 0.7, offset = 40000"#),
    ("char", r#"to = "WordInputReg[5]", scale = 100.5, offset = 20000"#),
    ("word", r#"to = "BitInputReg[3]", scale = 0.00390625"#),
    ("byte", r#"to = "WordInputReg[6]", scale = 257"#),
];

/// The types of the display's fields; there is one of each type for every source.
const TYPES: [&str; 8] = ["byte", "char", "word", "short", "dword", "int", "float", "double"];
const SOURCES: [&str; 5] = [
    r#"from = "FloatOutputReg[1]""#,
    r#"from = "FloatOutputReg[2]", scale = 57.29578, offset = -0.1"#,
    r#"from = "FloatOutputReg[3]", scale = 3e38, offset = -1e-38"#,
    r#"from = "WordOutputReg[1]", scale = 0.1, offset = -1638.35"#,
    r#"from = "RobotState[8]", scale = -0.33333334"#,
];

fn gateway() -> String {
    let frames = INPUTS.iter().enumerate().map(|(nth, (ty, to))| {
        let id = FIRST_ID + nth as u16;
        format!(
            "[[recipe.input.frame]]\nid = {id}\nfields = [{{ name = \"in{nth}\", type = \"{ty}\", {to} }}]\n"
        )
    });
    let pairs = TYPES.iter().flat_map(|ty| SOURCES.iter().map(move |from| (ty, from)));
    let fields = pairs
        .enumerate()
        .map(|(nth, (ty, from))| format!("    {{ name = \"out{nth}\", type = \"{ty}\", {from} }},\n"));
    let (frames, fields) = (frames.collect::<String>(), fields.collect::<String>());
    format!(
        r#"
[controller]
address = "127.0.0.1"
recipe_link = {{ udp = 2011, recipe = "up" }}

[[recipe]]
name = "numbers"
kind = "can"
mode = "user"
{frames}
[[recipe]]
name = "display"
kind = "stream"
mode = "user"
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = [
{fields}]
{UP}
[[port]]
name = "numbers"
bus = "can"
bitrate = 1000000
recipe = "numbers"

[[port]]
name = "display"
bus = "rs485"
baud = 4000000
recipe = "display"
"#
    )
}

/// The stream recipe that the controller's UDP server is set to.
const UP: &str = r#"
[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["FloatInputReg[1..9]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = ["FloatOutputReg[1..3]", "RobotState[8]"]
"#;

const CONTROLLER: &str = r#"
[robot]
power = "enabled"
mode = "remote"

[[port]]
name = "udp2011"
bus = "udp-server"
recipe = "up"
"#;

const FIRST_ID: u16 = 0x100;

/// The recording, after checking that enough happened in it.
pub(crate) fn record() -> Vec<u8> {
    let controller = toml::controller(&format!("{CONTROLLER}{UP}"));
    let mut cell = recorded(&toml::gateway(&gateway()), &controller);
    let mut rng = Rng::new(3);
    let mut numbers = rng.fork();
    let bus = cell.bus_of("numbers");
    let start = cell.now() + Duration::from_millis(100);
    cell.attach_can(bus, PeriodicSender::new(start, 2_000, u64::MAX, move |nth| frame(nth, &mut numbers)));
    for _ in 0..500 {
        show(&mut cell, &mut rng);
        cell.run_ms(4);
    }
    let (numbers, display) = (*cell.port("numbers"), *cell.port("display"));
    assert!(numbers.frames_in > 1_000 && display.frames_out > 300, "{numbers:?} {display:?}");
    assert!(numbers.rejected_not_finite > 20 && numbers.rejected_out_of_range > 100, "{numbers:?}");
    cell.into_recording()
}

/// Gives the controller other numbers to show.
fn show(cell: &mut Cell, rng: &mut Rng) {
    for nth in 1..=3 {
        let value = std::iter::repeat_with(|| float(rng)).find(|value| value.is_finite()).unwrap_or(0.0);
        cell.set_value(&format!("FloatOutputReg[{nth}]"), f64::from(value));
    }
    cell.set_value("WordOutputReg[1]", rng.below(65_536) as f64);
}

fn frame(nth: u64, rng: &mut Rng) -> CanFrame {
    let input = (nth % INPUTS.len() as u64) as usize;
    let data = match INPUTS[input].0 {
        "double" => double(rng).to_le_bytes().to_vec(),
        "float" => float(rng).to_le_bytes().to_vec(),
        "int" | "dword" => rng.bytes(4),
        "short" | "word" => rng.bytes(2),
        _ => rng.bytes(1),
    };
    can(FIRST_ID + input as u16, &data)
}

/// A double on which implementations might disagree.
fn double(rng: &mut Rng) -> f64 {
    let sign = if rng.below(2) == 0 { 1.0 } else { -1.0 };
    sign * match rng.below(10) {
        // Any bits: every kind of NaN, infinities, subnormals.
        0 => f64::from_bits(rng.next_u64()),
        1 => f64::from_bits(0x7FF << 52 | rng.next_u64() >> (12 + rng.below(52))),
        2 => f64::from_bits(rng.next_u64() >> 12),
        // Halves, and their neighbours.
        3 => rng.below(70_000) as f64 + 0.5,
        4 => (rng.below(70_000) as f64 + 0.5).next_down(),
        // Limits of the float range, subnormal floats, and ties that are rounded to even.
        5 => f64::from(f32::MAX) * (1.0 + (rng.below(5) as f64 - 2.0) * 3e-8),
        6 => f64::from(f32::from_bits(rng.below(0x0100_0000) as u32)) * (1.0 + rng.below(3) as f64 * 3e-8),
        7 => f64::from_bits(
            f64::from(f32::from_bits(0x3F80_0000 | rng.below(0x80_0000) as u32)).to_bits() | 1 << 28,
        ),
        // The offset cancels all but the rounding error, which a fused multiply-add would not have.
        8 => (f64::from(3.3_f32) / f64::from(0.1_f32)) * (1.0 + rng.below(8) as f64 * f64::EPSILON),
        _ => rng.below(60_000) as f64 / 7.0,
    }
}

fn float(rng: &mut Rng) -> f32 {
    match rng.below(4) {
        0 => f32::from_bits(rng.next_u64() as u32),
        1 => f32::from_bits(rng.next_u64() as u32 & 0x807F_FFFF),
        2 => (rng.below(20_000) as f32 - 10_000.0) / 7.0,
        _ => rng.below(130_000) as f32 / 2.0 + 0.5,
    }
}
