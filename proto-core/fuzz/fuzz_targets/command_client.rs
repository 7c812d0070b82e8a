//! `proto-core/fuzz/run command_client`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("command_client").run)(input));
