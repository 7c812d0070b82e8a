//! `proto-core/fuzz/run modbus_client`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("modbus_client").run)(input));
