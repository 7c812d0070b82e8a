//! Any values and any bytes: what works is not blamed, and nothing panics.

use proptest::prelude::*;

use super::*;

fn quantity() -> impl Strategy<Value = f32> {
    prop_oneof![Just(0.0), -1_000.0..1_000.0_f32, -0.01..0.01_f32]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    /// A device whose frames are right, in any chunks and from the middle of one on, is never blamed.
    #[test]
    fn what_works_is_never_blamed(
        values in prop::collection::vec(prop::array::uniform6(quantity()), 40..60),
        cut in 0_usize..28,
        chunk in 1_usize..90,
        gap in 0_usize..3,
    ) {
        let mut bench = Bench::example("force-sensor.toml");
        let mut stream = Vec::new();
        for values in &values {
            stream.extend(HEAD);
            values.iter().for_each(|value| stream.extend(value.to_le_bytes()));
            stream.extend(TAIL);
            // Some devices send something between their frames.
            stream.extend(std::iter::repeat_n(0, gap));
        }
        for chunk in stream[cut..].chunks(chunk) {
            bench.bytes(chunk);
            bench.pass(2);
        }
        prop_assert_eq!(bench.of_ports(), []);
    }

    /// Nothing that comes makes the doctor panic.
    #[test]
    fn any_bytes_are_looked_at(chunks in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..60), 0..40)) {
        for file in ["force-sensor.toml", "force-sensor-crc.toml", "scale.toml", "gripper.toml"] {
            let mut bench = Bench::example(file);
            for chunk in &chunks {
                bench.bytes(chunk);
                bench.pass(5);
            }
            bench.findings();
        }
    }

    /// The same frames with head and noise are told apart from those of another length.
    #[test]
    fn a_length_is_found_among_any_values(values in prop::array::uniform6(quantity()), more in 1_usize..8) {
        let mut bench = Bench::example("force-sensor.toml");
        let mut frame = HEAD.to_vec();
        values.iter().for_each(|value| frame.extend(value.to_le_bytes()));
        frame.extend(std::iter::repeat_n(1, more));
        frame.extend(TAIL);
        bench.streams(&frame);
        let length = format!("frames of {} bytes", 28 + more);
        bench.says(Cause::LengthDiffers, &[&length]);
    }
}
