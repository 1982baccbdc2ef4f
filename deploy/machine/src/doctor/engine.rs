//! Procgen's engine: whether it is installed and loads, or how to get it.
//! This module fetches nothing and plays nothing.

use procgen_sys::{Engine, ProcgenError};

use super::fact::{Finding, State};

/// Whether Procgen's engine is in the cache folder and loads.
pub(super) fn check_engine() -> Finding {
    match Engine::locate() {
        Ok(engine) => {
            let library = engine.library().display();
            match engine.check_loads() {
                Ok(()) => (State::Ok, format!("the engine is {library} and loads")),
                Err(why) => (State::Missing, why.to_string()),
            }
        }
        Err(ProcgenError::Missing { reason, .. }) => {
            not_installed(&reason, Engine::describe_source())
        }
        Err(why) => (State::Missing, why.to_string()),
    }
}

/// The fact for an engine that is not installed; `source` is where it would be downloaded from.
fn not_installed(reason: &str, source: Result<String, ProcgenError>) -> Finding {
    match source {
        Ok(source) => {
            let text = format!(
                "the engine: {reason}; `driml procgen install` gets it from {source}, and so does the first run that needs it"
            );
            (State::Note, text)
        }
        Err(why) => (State::Missing, why.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_engine_that_can_be_fetched_is_a_note_and_one_that_cannot_is_missing() {
        let no_pip = ProcgenError::Fetch("install python3-pip".into());
        for (source, state, text) in [
            (Ok("`pip`".into()), State::Note, "`driml procgen install`"),
            (Err(no_pip), State::Missing, "python3-pip"),
        ] {
            let found = not_installed("it is not installed", source);
            assert!(found.0 == state && found.1.contains(text), "{found:?}");
        }
    }
}
