//! Files that a person or another process may have changed: a checkpoint's `state.json`, and a run's settings.

use driml_actor::ActorSettings;
use driml_learner::{LearnerConfig, checkpoint};
use driml_protocol::config::Settings;
use driml_settings::config::RunConfig;

/// A checkpoint's `state.json`.
pub(crate) fn state(bytes: &[u8]) {
    // What it says is for a person.
    let _ = checkpoint::check_state(bytes);
}

/// A run's settings, as the components and the program read them. Accepted settings are written back unchanged.
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
