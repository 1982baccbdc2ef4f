//! One fact of an inspection.
//! What is counted is in the files beside it.

use serde::Serialize;

/// One fact: what there is of something, and what there would be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Line {
    /// What is counted.
    pub what: String,
    /// How much of it there is.
    pub is: u64,
    /// How much there would be if everything were on.
    pub everything: u64,
    /// Why it is there or is not, and which setting decides.
    pub why: String,
}

impl Line {
    pub(super) fn new(
        what: impl Into<String>,
        is: u64,
        everything: u64,
        why: impl Into<String>,
    ) -> Self {
        Self {
            what: what.into(),
            is,
            everything,
            why: why.into(),
        }
    }
}
