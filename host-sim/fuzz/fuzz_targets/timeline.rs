//! `proto-core/fuzz/run timeline`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz_host::target("timeline").run)(input));
