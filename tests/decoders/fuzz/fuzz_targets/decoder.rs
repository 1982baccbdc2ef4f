//! Fuzzes the decoder of `driml-decoders` that has the name of this binary.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let mut all = driml_decoders::DECODERS.iter();
    let decoder = all.find(|(name, _)| *name == env!("CARGO_BIN_NAME"));
    decoder.expect("it is in the list").1(bytes);
});
