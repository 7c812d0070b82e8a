//! `proto-core/fuzz/run can`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("can").run)(input));
