//! `proto-core/fuzz/run modbus_server`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("modbus_server").run)(input));
