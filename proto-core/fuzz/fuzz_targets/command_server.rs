//! `proto-core/fuzz/run command_server`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("command_server").run)(input));
