#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| lanemap_fuzz_targets::order(bytes));
