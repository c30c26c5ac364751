#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| visod_fuzz::ros_message::run(data));
