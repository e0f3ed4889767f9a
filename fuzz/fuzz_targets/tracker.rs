#![no_main]
libfuzzer_sys::fuzz_target!(|data: &[u8]| gakp_fuzz::target("tracker", data));
