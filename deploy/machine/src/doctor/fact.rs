//! One fact about this machine, as a line of text and as JSON.
//! This module judges nothing: the code that finds a fact gives it its state.

use std::fmt;

use serde::Serialize;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum State {
    /// The fact is as it should be.
    Ok,
    /// A run works without it, or works slower.
    Note,
    /// Something required is missing; the text says what to do.
    Missing,
}

/// The state of a fact and its text, which says what to do if something should change.
pub(super) type Finding = (State, String);

impl State {
    pub(super) fn with(self, text: impl Into<String>) -> Finding {
        (self, text.into())
    }
}

/// The result of the check of one thing that a run needs.
#[derive(Debug, Serialize)]
pub(super) struct Fact {
    pub(super) state: State,
    /// The subject of the fact, such as `cores`.
    pub(super) what: String,
    text: String,
}

impl Fact {
    pub(super) fn new(what: impl Into<String>, (state, text): Finding) -> Self {
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
        // One line per fact, even if an error's text has several.
        let text = self.text.split_whitespace().collect::<Vec<_>>().join(" ");
        write!(f, "{state:<8} {:<17} {text}", self.what)
    }
}
