//! `proto-core/fuzz/run operations`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz_host::target("operations").run)(input));
