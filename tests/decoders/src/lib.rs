//! What reads messages, settings, checkpoints and logs, as functions of bytes alone: what fuzzers and the bounded runs in CI call.
//! None may panic, whatever the bytes; what is read must be written back unchanged.
//! Not among them: weights (safetensors) and the line in which a world declares itself.
//!
//! A new decoder is a function here, a line in [`ALL`], a target in `fuzz/` and seeds in `fuzz/corpus/NAME/`; a test holds that none
//! of these is forgotten.

#![allow(
    clippy::unwrap_used,
    reason = "a decoder that cannot read what it wrote is what is looked for"
)]

mod files;
mod messages;
mod replay;
mod segments;

pub use messages::forged;
pub use segments::{held, highest_ordinal, logs};

/// One decoder: its name, and what is to be tried with some bytes.
pub type Decoder = (&'static str, fn(&[u8]));

/// Every decoder.
pub const ALL: &[Decoder] = &[
    ("wire", messages::wire),
    ("messages", messages::messages),
    ("replay", replay::replay),
    ("state", files::state),
    ("config", files::config),
    ("segments", segments::segments),
];
