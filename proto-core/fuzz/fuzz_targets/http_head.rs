//! `proto-core/fuzz/run http_head`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("http_head").run)(input));
