#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| rhytid_server::trackers::fuzz::openseeface_csv_target(bytes));
