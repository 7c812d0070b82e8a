//! `proto-core/fuzz/run recording`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz_host::target("recording").run)(input));
