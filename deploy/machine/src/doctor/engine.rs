//! Procgen's engine: whether it is there and loads, or how it would be had.
//! It fetches nothing and plays nothing.

use procgen_sys::{Engine, InstallError};

use super::fact::Fact;

const WHAT: &str = "Procgen";

/// Whether Procgen's engine is in the cache folder and loads.
pub(super) fn fact() -> Fact {
    match Engine::locate() {
        Ok(engine) => match engine.check_loads() {
            Ok(()) => Fact::ok(
                WHAT,
                format!("the engine is in {} and loads", engine.root().display()),
            ),
            Err(why) => Fact::missing(WHAT, why.to_string()),
        },
        Err(why @ (InstallError::Missing { .. } | InstallError::Damaged { .. })) => {
            not_there(&why, Engine::source())
        }
        Err(why) => Fact::missing(WHAT, why.to_string()),
    }
}

/// The fact where the engine is not there whole; `source` is where it would come from.
fn not_there(why: &InstallError, source: Result<String, InstallError>) -> Fact {
    let damaged = matches!(why, InstallError::Damaged { .. });
    match source {
        Ok(source) => {
            let state = if damaged { "damaged" } else { "not installed" };
            Fact::note(
                WHAT,
                format!(
                    "the engine is {state}: `driml procgen install` gets it from {source}, and so does the first run that needs it"
                ),
            )
        }
        Err(why) => Fact::missing(WHAT, why.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::fact::State;

    #[test]
    fn an_engine_that_can_be_fetched_is_a_note_and_one_that_cannot_is_missing() {
        let missing = InstallError::Missing {
            root: "/cache/procgen".into(),
        };
        let fact = not_there(&missing, Ok("`pip`".into()));
        assert_eq!(fact.state, State::Note);
        assert!(fact.text.contains("`driml procgen install`"), "{fact}");
        let fact = not_there(&missing, Err(InstallError::NoPip));
        assert_eq!(fact.state, State::Missing);
        assert!(fact.text.contains("python3-pip"), "{fact}");
    }
}
