//! The decoders of messages, settings, checkpoints and logs, as functions of bytes alone, for fuzzers and for bounded runs in CI.
//! No bytes may make a decoder panic, and it must write back unchanged what it reads.
//! Weights (safetensors) and the line in which a world declares itself are not covered.
//!
//! A new decoder needs a function here, a line in [`DECODERS`], a target in `fuzz/` and seeds in `fuzz/corpus/NAME/`; a test checks that
//! none of these is missing.

#![allow(
    clippy::unwrap_used,
    reason = "a decoder that cannot read what it wrote is what is looked for"
)]

mod files;
mod messages;
mod replay;
mod segments;

pub use segments::{log_with_highest_ordinal, logs, transitions_held};

/// One decoder: its name, and the function that tries it on some bytes.
pub type Decoder = (&'static str, fn(&[u8]));

/// Every decoder.
pub const DECODERS: &[Decoder] = &[
    ("messages", messages::messages),
    ("replay", replay::replay),
    ("state", files::state),
    ("config", files::config),
    ("segments", segments::segments),
];
