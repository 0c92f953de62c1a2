#![no_main]
libfuzzer_sys::fuzz_target!(|data: &[u8]| delmpc_fuzz::cycle(data));
