//! Procgen's engine: whether it is there and loads, or how it would be had.
//! It fetches nothing and plays nothing.

use procgen_sys::{Engine, ProcgenError};

use super::fact::Fact;

const WHAT: &str = "Procgen";

/// Whether Procgen's engine is in the cache folder and loads.
pub(super) fn fact() -> Fact {
    match Engine::locate() {
        Ok(engine) => {
            let library = engine.library().display();
            match engine.check_loads() {
                Ok(()) => Fact::ok(WHAT, format!("the engine is {library} and loads")),
                Err(why) => Fact::missing(WHAT, why.to_string()),
            }
        }
        Err(ProcgenError::Missing { reason, .. }) => not_there(&reason, Engine::source()),
        Err(why) => Fact::missing(WHAT, why.to_string()),
    }
}

/// The fact where the engine is not there; `source` is where it would come from.
fn not_there(reason: &str, source: Result<String, ProcgenError>) -> Fact {
    match source {
        Ok(source) => Fact::note(
            WHAT,
            format!(
                "the engine: {reason}; `driml procgen install` gets it from {source}, and so does the first run that needs it"
            ),
        ),
        Err(why) => Fact::missing(WHAT, why.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::fact::State;

    #[test]
    fn an_engine_that_can_be_fetched_is_a_note_and_one_that_cannot_is_missing() {
        let no_pip = ProcgenError::Fetch("install python3-pip".into());
        for (source, state, text) in [
            (Ok("`pip`".into()), State::Note, "`driml procgen install`"),
            (Err(no_pip), State::Missing, "python3-pip"),
        ] {
            let fact = not_there("it is not installed", source);
            assert!(fact.state == state && fact.text.contains(text), "{fact}");
        }
    }
}
