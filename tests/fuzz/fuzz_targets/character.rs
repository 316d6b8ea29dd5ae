#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| rhytid_server::fuzz::character_target(bytes));
