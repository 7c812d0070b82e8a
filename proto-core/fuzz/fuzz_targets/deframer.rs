//! `proto-core/fuzz/run deframer`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("deframer").run)(input));
