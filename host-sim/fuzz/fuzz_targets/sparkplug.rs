//! `proto-core/fuzz/run sparkplug`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz_host::target("sparkplug").run)(input));
