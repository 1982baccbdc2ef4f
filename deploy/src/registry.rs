//! Lets your own program add worlds, losses and agents to those of driml.

use driml_envs::{CustomKind, WorldSettings};
use driml_learner::auxiliary::{self, loss::MenuItem};
use driml_settings::presets::{self, Layer};
use serde::de::DeserializeOwned;

/// Worlds, losses and agents in addition to driml's own, for [`main_with`](crate::main_with). If a world or an agent has the name of one of
/// driml's, driml's is used.
#[derive(Debug, Default)]
pub struct Registry {
    worlds: Vec<CustomKind>,
    losses: Vec<&'static MenuItem>,
    agents: Vec<Layer>,
}

impl Registry {
    /// Adds the world with settings `S`, for `--env NAME`. `preset` is its layer of settings in TOML (see [`CustomKind::new`]).
    #[must_use]
    pub fn world<S>(mut self, name: &'static str, preset: &'static str) -> Self
    where
        S: WorldSettings + DeserializeOwned + Send + Sync + 'static,
    {
        self.worlds.push(CustomKind::new::<S>(name, preset));
        self
    }

    /// Adds an auxiliary loss, for `learner.update.auxiliary_loss`. Its name must differ from those of driml's losses.
    #[must_use]
    pub fn loss(mut self, item: &'static MenuItem) -> Self {
        self.losses.push(item);
        self
    }

    /// Adds an agent, for `--agent NAME`, with a sentence that describes it and its layer of settings in TOML.
    #[must_use]
    pub fn agent(mut self, name: &'static str, about: &'static str, layer: &'static str) -> Self {
        self.agents.push(Layer::custom(name, about, layer));
        self
    }

    pub(crate) fn register(self) {
        driml_envs::register(self.worlds);
        auxiliary::register(self.losses);
        presets::register(self.agents);
    }
}
