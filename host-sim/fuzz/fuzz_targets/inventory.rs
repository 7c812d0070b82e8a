//! `proto-core/fuzz/run inventory`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz_host::target("inventory").run)(input));
