//! One fact about this machine, as a line of text and as JSON.
//! It judges nothing: who finds a fact gives it its state.

use std::fmt;

use serde::Serialize;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum State {
    /// As it should be.
    Ok,
    /// It works without, or slower.
    Note,
    /// What is asked for cannot be had; the text says what to do.
    Missing,
}

/// How something is, and what is so, with what to do if that should change.
pub(super) type Found = (State, String);

/// What was found out about one thing that a run needs.
#[derive(Debug, Serialize)]
pub(super) struct Fact {
    pub(super) state: State,
    /// What it is about, such as `cores`.
    pub(super) what: String,
    text: String,
}

impl Fact {
    pub(super) fn new(what: impl Into<String>, (state, text): Found) -> Self {
        Self {
            state,
            what: what.into(),
            text,
        }
    }
}

impl fmt::Display for Fact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = format!("{:?}", self.state).to_lowercase();
        // One line a fact, whatever an error's text has.
        let text = self.text.split_whitespace().collect::<Vec<_>>().join(" ");
        write!(f, "{state:<8} {:<17} {text}", self.what)
    }
}
