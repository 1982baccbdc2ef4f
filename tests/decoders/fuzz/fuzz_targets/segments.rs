//! Fuzzes the decoder `segments` of `driml-decoders`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let decoder = driml_decoders::ALL.iter().find(|(name, _)| *name == "segments");
    decoder.expect("it is in the list").1(bytes);
});
