//! Files that a person or another process may have changed: a checkpoint's `state.json`, and a run's settings.

use driml_actor::ActorSettings;
use driml_learner::{LearnerConfig, checkpoint};
use driml_protocol::config::Settings;
use driml_settings::config::RunConfig;

/// Reads a checkpoint's `state.json`.
pub(crate) fn state(bytes: &[u8]) {
    // An error is a valid result; its text is for people.
    let _ = checkpoint::check_state(bytes);
}

/// Reads a run's settings as the components and the program do. Accepted settings are written back unchanged.
pub(crate) fn config(bytes: &[u8]) {
    let Ok(text) = str::from_utf8(bytes) else {
        return;
    };
    let _ = ActorSettings::from_toml(text);
    let _ = LearnerConfig::from_toml(text);
    if let Ok(settings) = Settings::parse(text)
        && let Ok(replay) = settings.table::<driml_replay_server::Config>("replay")
        && let Ok(spec) = settings.table("run")
    {
        let _ = replay.validate(&spec, 16);
    }
    if let Ok(config) = RunConfig::parse("a file", text) {
        let written = config.to_toml();
        let again = RunConfig::parse("what was written", &written).unwrap();
        assert_eq!(again.to_toml(), written);
    }
}
