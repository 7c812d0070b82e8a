//! `proto-core/fuzz/run toml`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz_host::target("toml").run)(input));
