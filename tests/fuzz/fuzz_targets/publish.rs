#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| rhytid_server::fuzz::publish_target(bytes));
