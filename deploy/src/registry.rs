//! What a program of your own adds to driml's worlds, losses and agents.

use driml_envs::{CustomKind, WorldSettings};
use driml_learner::auxiliary::{self, loss::MenuItem};
use driml_settings::presets::{self, Agent};
use serde::de::DeserializeOwned;

/// Worlds, losses and agents beside driml's own, for [`main_with`](crate::main_with). The name of a world or an agent that
/// driml has stays driml's.
#[derive(Debug, Default)]
pub struct Registry {
    worlds: Vec<CustomKind>,
    losses: Vec<&'static MenuItem>,
    agents: Vec<Agent>,
}

impl Registry {
    /// Adds the world of settings `S`, for `--env NAME`; `preset` is its layer of settings, TOML ([`CustomKind::of`] says which).
    #[must_use]
    pub fn world<S>(mut self, name: &'static str, preset: &'static str) -> Self
    where
        S: WorldSettings + DeserializeOwned + Send + Sync + 'static,
    {
        self.worlds.push(CustomKind::of::<S>(name, preset));
        self
    }

    /// Adds an auxiliary loss, for `learner.update.auxiliary_loss`, under a name that driml's have not.
    #[must_use]
    pub fn loss(mut self, item: &'static MenuItem) -> Self {
        self.losses.push(item);
        self
    }

    /// Adds an agent, for `--agent NAME`, with a sentence on it and its layer of settings, TOML.
    #[must_use]
    pub fn agent(mut self, name: &'static str, about: &'static str, layer: &'static str) -> Self {
        self.agents.push(Agent::new(name, about, layer));
        self
    }

    /// Makes all of it known to the crates that look for it.
    pub(crate) fn register(self) {
        driml_envs::register(self.worlds);
        auxiliary::register(self.losses);
        presets::register(self.agents);
    }
}
