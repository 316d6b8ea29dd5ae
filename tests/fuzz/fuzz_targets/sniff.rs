#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| rhytid_server::trackers::fuzz::sniff_target(bytes));
