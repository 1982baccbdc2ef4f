//! The worlds there are, and their names on a command line. A new world is a line in `worlds!` and a file in `worlds/`.
//! It holds no numbers: each world's settings are described beside that world.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::action_set::ActionSet;
use crate::environment::{Environment, FrameShape};
use crate::error::EnvError;
use crate::settings::{Levels, Variants, WorldSettings};
use crate::worlds::corridor::CorridorConfig;
use crate::worlds::ising::IsingConfig;
use crate::worlds::pacman::PacmanConfig;
use crate::worlds::procgen::ProcgenConfig;

/// Makes [`WorldConfig`] and the list of kinds from one line a world.
macro_rules! worlds {
    ($($(#[$doc:meta])* $kind:literal $World:ident($Settings:ty);)+) => {
        /// The settings of one world; `kind` in the file says of which.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "kind")]
        pub enum WorldConfig {
            $($(#[$doc])* #[serde(rename = $kind)] $World($Settings),)+
        }

        /// Every world: what a file calls it, and which variants of it are worlds of their own.
        const KINDS: &[(&str, fn() -> Variants)] = &[$(($kind, <$Settings>::variants)),+];

        impl WorldConfig {
            fn settings(&self) -> (&'static str, &dyn WorldSettings) {
                match self {
                    $(Self::$World(settings) => ($kind, settings)),+
                }
            }

            /// The same world with other levels.
            ///
            /// # Errors
            /// A world without levels, or without unseen ones; says what to ask for.
            pub fn with_levels(&self, levels: Levels) -> Result<Self, EnvError> {
                match self {
                    $(Self::$World(settings) => settings.with_levels(levels).map(Self::$World)),+
                }
            }
        }
    };
}

worlds! {
    /// One of Procgen's games.
    "procgen" Procgen(ProcgenConfig);
    /// Ms. PacMan.
    "mspacman" MsPacman(PacmanConfig);
    /// The Ising patch in noise.
    "ising" Ising(IsingConfig);
    /// The corridor.
    "chain" Chain(CorridorConfig);
}

impl WorldConfig {
    /// The world's name on a command line.
    pub fn name(&self) -> WorldName {
        let (kind, settings) = self.settings();
        WorldName {
            kind,
            variant: settings.variant(),
        }
    }

    /// # Errors
    /// Says which setting cannot work.
    pub fn validate(&self) -> Result<(), EnvError> {
        self.settings().1.validate()
    }

    /// The shape of one frame of the world that these settings make.
    pub fn frame_shape(&self) -> FrameShape {
        self.settings().1.frame_shape()
    }

    /// The names of the world's actions; an action is a place in this list.
    pub fn action_names(&self) -> &'static [&'static str] {
        self.settings().1.action_names()
    }

    /// Steps a second at which a person plays the game, or can follow it.
    pub fn steps_per_second(&self) -> f64 {
        self.settings().1.steps_per_second()
    }

    /// Number of the world's actions; valid ones are below it.
    pub fn num_actions(&self) -> usize {
        self.action_names().len()
    }

    /// For each action, the one that it amounts to in this world; an action that stands for itself maps to itself.
    pub fn visible_actions(&self) -> Vec<u8> {
        self.settings().1.visible_actions()
    }

    /// The actions of `set`, in their order: each is a place in [`action_names`](Self::action_names).
    pub fn actions(&self, set: ActionSet) -> Vec<u8> {
        let mut actions = match set {
            ActionSet::All => (0..self.num_actions()).map(|action| action as u8).collect(),
            ActionSet::Visible => self.visible_actions(),
        };
        actions.sort_unstable();
        actions.dedup();
        actions
    }

    /// Whether a run in this world can be resumed: no episode depends on how many were played before.
    pub fn is_resumable(&self) -> bool {
        self.settings().1.is_resumable()
    }

    /// Puts what the world needs onto this machine; `progress` is told what is being done, a line at a time.
    ///
    /// # Errors
    /// What is missing, and how to get it.
    pub fn install(&self, progress: &mut dyn FnMut(&str)) -> Result<(), EnvError> {
        self.settings().1.install(progress)
    }

    /// Builds `num_envs` copies of the world. Copy i depends on (`seed`, i) and its actions only.
    ///
    /// `threads` is how many threads Procgen's engine may start, 0 for none; the other worlds are stepped in microseconds
    /// and use none. The chain has nothing to seed.
    ///
    /// # Errors
    /// Settings that cannot work, or an engine that cannot be had.
    pub fn build(
        &self,
        num_envs: usize,
        seed: u64,
        threads: usize,
    ) -> Result<Box<dyn Environment>, EnvError> {
        self.settings().1.build(num_envs, seed, threads)
    }
}

/// A world's name on a command line: its kind, and its variant after a colon if it has any. It says nothing of settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct WorldName {
    kind: &'static str,
    variant: Option<&'static str>,
}

impl WorldName {
    /// Every name there is: each of Procgen's games, then the others.
    pub fn all() -> impl Iterator<Item = WorldName> {
        KINDS.iter().flat_map(|(kind, variants)| {
            let names = variants().names;
            let one = names.is_empty().then_some(None);
            let variants = one.into_iter().chain(names.iter().copied().map(Some));
            variants.map(|variant| WorldName { kind, variant })
        })
    }

    /// What a file's `kind` calls the world.
    pub const fn kind(self) -> &'static str {
        self.kind
    }

    /// The setting and its value that say which of several worlds of one kind it is.
    pub fn variant(self) -> Option<(&'static str, &'static str)> {
        let (_, variants) = KINDS.iter().find(|(kind, _)| *kind == self.kind)?;
        Some((variants().key, self.variant?))
    }
}

impl fmt::Display for WorldName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.kind)?;
        self.variant.map_or(Ok(()), |name| write!(f, ":{name}"))
    }
}

impl FromStr for WorldName {
    type Err = WorldNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let known = WorldName::all().find(|name| name.to_string() == text);
        known.ok_or_else(|| WorldNameError {
            text: text.into(),
            nearest: nearest(text),
        })
    }
}

/// A text that names no world. Lists those that there are, and suggests the nearest if one is near.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorldNameError {
    text: String,
    nearest: Option<WorldName>,
}

impl fmt::Display for WorldNameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "no world is named \"{}\"", self.text)?;
        if let Some(name) = self.nearest {
            write!(f, "; did you mean \"{name}\"?")?;
        }
        let mut names = Vec::new();
        let mut variants = String::new();
        for (kind, of) in KINDS {
            let Variants { key, names: of } = of();
            if of.is_empty() {
                names.push((*kind).to_owned());
            } else {
                let key = key.to_uppercase();
                names.push(format!("{kind}:{key}"));
                variants += &format!("; {key} is one of {}", of.join(", "));
            }
        }
        write!(f, " (the worlds: {}{variants})", names.join(", "))
    }
}

impl std::error::Error for WorldNameError {}

/// The world whose name is at most 3 edits from `text`; a variant may be named without its kind.
fn nearest(text: &str) -> Option<WorldName> {
    // A name is short: no use in comparing letter by letter with a text that is not.
    if text.chars().count() > 40 {
        return None;
    }
    let letters = |text: &str| -> String { text.chars().filter(|c| c.is_alphanumeric()).collect() };
    let text = letters(&text.to_lowercase());
    let distance = |name: WorldName| {
        let full = strsim::levenshtein(&text, &letters(&name.to_string()));
        name.variant.map_or(full, |variant| {
            full.min(strsim::levenshtein(&text, variant))
        })
    };
    let name = WorldName::all().min_by_key(|&name| distance(name))?;
    (distance(name) <= 3).then_some(name)
}

#[cfg(test)]
mod tests;
