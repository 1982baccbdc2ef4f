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

/// What was found out about one thing that a run needs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Fact {
    pub(super) state: State,
    /// What it is about, such as `cores`.
    pub(super) what: String,
    /// What is so, and what to do if that should change.
    pub(super) text: String,
}

impl Fact {
    pub(super) fn ok(what: &str, text: impl Into<String>) -> Self {
        Self::new(State::Ok, what, text)
    }

    pub(super) fn note(what: &str, text: impl Into<String>) -> Self {
        Self::new(State::Note, what, text)
    }

    pub(super) fn missing(what: &str, text: impl Into<String>) -> Self {
        Self::new(State::Missing, what, text)
    }

    pub(super) fn new(state: State, what: &str, text: impl Into<String>) -> Self {
        Self {
            state,
            what: what.into(),
            text: text.into(),
        }
    }
}

impl fmt::Display for Fact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = match self.state {
            State::Ok => "ok",
            State::Note => "note",
            State::Missing => "missing",
        };
        // One line a fact, whatever an error's text has.
        let text = self.text.split_whitespace().collect::<Vec<_>>().join(" ");
        write!(f, "{state:<8} {:<17} {text}", self.what)
    }
}
