//! Which world, with which settings; and the names of worlds on a command line.
//! It holds no numbers of its own: each world's settings are described beside that world.

use std::fmt;
use std::str::FromStr;

use procgen_sys::Game;
use serde::{Deserialize, Serialize};
use strsim::levenshtein;

use crate::{ChainConfig, EnvError, IsingConfig, PacmanConfig, ProcgenConfig};

/// The settings of one world; `kind` in the file says of which (`procgen`, `mspacman`, `ising`, `chain`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum WorldConfig {
    /// One of Procgen's games.
    Procgen(ProcgenConfig),
    /// Ms. PacMan.
    MsPacman(PacmanConfig),
    /// The Ising patch in noise.
    Ising(IsingConfig),
    /// The corridor.
    Chain(ChainConfig),
}

impl WorldConfig {
    /// # Errors
    /// Says which setting cannot work.
    pub fn validate(&self) -> Result<(), EnvError> {
        match self {
            WorldConfig::Procgen(config) => config.validate(),
            WorldConfig::MsPacman(config) => config.validate(),
            WorldConfig::Ising(config) => config.validate(),
            WorldConfig::Chain(config) => config.validate(),
        }
    }

    /// The world's name on a command line.
    pub fn name(&self) -> WorldName {
        match self {
            WorldConfig::Procgen(config) => WorldName::Procgen(config.game),
            WorldConfig::MsPacman(_) => WorldName::MsPacman,
            WorldConfig::Ising(_) => WorldName::Ising,
            WorldConfig::Chain(_) => WorldName::Chain,
        }
    }
}

/// A world's name on a command line: `procgen:GAME`, `mspacman`, `ising` or `chain`. It says nothing of settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum WorldName {
    /// `procgen:GAME`.
    Procgen(Game),
    /// `mspacman`.
    MsPacman,
    /// `ising`.
    Ising,
    /// `chain`.
    Chain,
}

impl WorldName {
    /// Every name there is: each of Procgen's games, then the others.
    pub fn all() -> impl Iterator<Item = WorldName> {
        Game::ALL.into_iter().map(WorldName::Procgen).chain([
            WorldName::MsPacman,
            WorldName::Ising,
            WorldName::Chain,
        ])
    }
}

impl fmt::Display for WorldName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            WorldName::Procgen(game) => write!(f, "procgen:{game}"),
            WorldName::MsPacman => f.write_str("mspacman"),
            WorldName::Ising => f.write_str("ising"),
            WorldName::Chain => f.write_str("chain"),
        }
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
        let games = Game::ALL.map(|game| game.name()).join(", ");
        write!(
            f,
            " (the worlds: procgen:GAME, mspacman, ising, chain; GAME is one of {games})"
        )
    }
}

impl std::error::Error for WorldNameError {}

/// The world whose name is at most 3 edits from `text`; a game may be named without `procgen:`.
fn nearest(text: &str) -> Option<WorldName> {
    // A name is short: no use in comparing letter by letter with a text that is not.
    if text.chars().count() > 40 {
        return None;
    }
    let letters = |text: &str| -> String { text.chars().filter(|c| c.is_alphanumeric()).collect() };
    let text = letters(&text.to_lowercase());
    let distance = |name: WorldName| {
        let full = levenshtein(&text, &letters(&name.to_string()));
        match name {
            WorldName::Procgen(game) => full.min(levenshtein(&text, game.name())),
            _ => full,
        }
    };
    let name = WorldName::all().min_by_key(|&name| distance(name))?;
    (distance(name) <= 3).then_some(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_go_there_and_back() {
        assert_eq!(WorldName::all().count(), 19);
        for name in WorldName::all() {
            assert_eq!(name.to_string().parse(), Ok(name));
        }
    }

    #[test]
    fn a_wrong_name_is_answered_with_the_nearest_and_the_list() {
        let error = |text: &str| text.parse::<WorldName>().unwrap_err().to_string();
        for (text, meant) in [
            ("MsPacman", "mspacman"),
            ("ms-pacman", "mspacman"),
            ("pacman", "mspacman"),
            ("coinrun", "procgen:coinrun"),
            ("procgen:starpillot", "procgen:starpilot"),
            ("izing", "ising"),
            ("chian", "chain"),
        ] {
            assert!(
                error(text).contains(&format!("did you mean \"{meant}\"?")),
                "{}",
                error(text)
            );
        }
        let text = error("montezuma_revenge");
        assert!(!text.contains("did you mean"), "{text}");
        assert!(
            text.contains("procgen:GAME, mspacman, ising, chain"),
            "{text}"
        );
        assert!(!error(&"x".repeat(10_000)).contains("did you mean"));
    }

    #[test]
    fn settings_are_read_by_kind_and_unknown_keys_are_rejected() {
        let chain = "kind = 'chain'\ncells = 8\nheight = 12\nwidth = 12\nstep_limit = 30\nreward_left = 0.1\nreward_right = 1\n";
        let config: WorldConfig = toml::from_str(chain).unwrap();
        assert_eq!(config.name(), WorldName::Chain);
        assert_eq!(
            toml::from_str::<WorldConfig>(&toml::to_string(&config).unwrap()).unwrap(),
            config
        );

        let pacman = "kind = 'mspacman'\nepsilon = 0\nswitch_probability = 0.5\nlethal = [true, false, false, false]\n\
            boost_steps = 10\nstep_limit = 500\nreward_pellet = 1\nreward_boost = 0\nreward_ghost = 5\n\
            reward_death = -10\nreward_cleared = 50\nlethal_schedule = { episodes_per_task = 10, order = [0, 1] }\n\
            ising = { temperature = 0.4, sweeps_per_step = 1 }\n";
        let config: WorldConfig = toml::from_str(pacman).unwrap();
        assert_eq!(config.name(), WorldName::MsPacman);
        assert_eq!(
            toml::from_str::<WorldConfig>(&toml::to_string(&config).unwrap()).unwrap(),
            config
        );

        for (wrong, word) in [
            (format!("{chain}colour = 1"), "colour"),
            (chain.replace("cells = 8\n", ""), "cells"),
            (chain.replace("'chain'", "'chian'"), "chian"),
            (pacman.replace("order", "ordre"), "ordre"),
        ] {
            let error = toml::from_str::<WorldConfig>(&wrong)
                .unwrap_err()
                .to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
