//! The sixteen games of Procgen and the difficulties each of them has.
//! It holds names and tables only; nothing here calls the engine.

use std::fmt;

use DistributionMode::{Extreme, Memory};

/// One of Procgen's games.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs, reason = "the names are the documentation")]
pub enum Game {
    Bigfish,
    Bossfight,
    Caveflyer,
    Chaser,
    Climber,
    Coinrun,
    Dodgeball,
    Fruitbot,
    Heist,
    Jumper,
    Leaper,
    Maze,
    Miner,
    Ninja,
    Plunder,
    Starpilot,
}

struct Row {
    game: Game,
    name: &'static str,
    limit: u32,
    /// Its modes beside easy and hard.
    modes: &'static [DistributionMode],
}

const fn row(
    game: Game,
    name: &'static str,
    limit: u32,
    modes: &'static [DistributionMode],
) -> Row {
    Row {
        game,
        name,
        limit,
        modes,
    }
}

const TABLE: [Row; 16] = [
    row(Game::Bigfish, "bigfish", 6000, &[]),
    row(Game::Bossfight, "bossfight", 4000, &[]),
    row(Game::Caveflyer, "caveflyer", 1000, &[Memory]),
    row(Game::Chaser, "chaser", 1000, &[Extreme]),
    row(Game::Climber, "climber", 1000, &[]),
    row(Game::Coinrun, "coinrun", 1000, &[]),
    row(Game::Dodgeball, "dodgeball", 1000, &[Extreme, Memory]),
    row(Game::Fruitbot, "fruitbot", 1000, &[]),
    row(Game::Heist, "heist", 1000, &[Memory]),
    row(Game::Jumper, "jumper", 1000, &[Memory]),
    row(Game::Leaper, "leaper", 500, &[Extreme]),
    row(Game::Maze, "maze", 500, &[Memory]),
    row(Game::Miner, "miner", 1000, &[Memory]),
    row(Game::Ninja, "ninja", 1000, &[]),
    row(Game::Plunder, "plunder", 4000, &[]),
    row(Game::Starpilot, "starpilot", 1000, &[Extreme]),
];

impl Game {
    /// Every game, by name.
    pub const ALL: [Game; TABLE.len()] = {
        let mut all = [Game::Bigfish; TABLE.len()];
        let mut i = 0;
        while i < all.len() {
            all[i] = TABLE[i].game;
            i += 1;
        }
        all
    };

    /// Their names, in the same order.
    pub const NAMES: [&str; TABLE.len()] = {
        let mut names = [""; TABLE.len()];
        let mut i = 0;
        while i < names.len() {
            names[i] = TABLE[i].name;
            i += 1;
        }
        names
    };

    const fn row(self) -> &'static Row {
        &TABLE[self as usize]
    }

    /// The engine's name of the game.
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// Steps after which the engine ends an episode; the step with this number is the last.
    ///
    /// Source: the engine's own `timeout`, read out of its saved states for every game and mode (`tests/engine.rs`).
    pub const fn time_limit_steps(self, mode: DistributionMode) -> u32 {
        match (self, mode) {
            (Game::Jumper, Memory) => 2000,
            _ => self.row().limit,
        }
    }

    /// Whether the game has this difficulty; the engine ends the process where it has not.
    pub fn has(self, mode: DistributionMode) -> bool {
        !matches!(mode, Extreme | Memory) || self.row().modes.contains(&mode)
    }
}

impl fmt::Display for Game {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How hard the levels are, and of which kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DistributionMode {
    /// Smaller and simpler levels; every game has it.
    Easy,
    /// The engine's standard levels; every game has it.
    Hard,
    /// Harder ones: chaser, dodgeball, leaper and starpilot only.
    Extreme,
    /// Larger ones of which little is seen at once: caveflyer, dodgeball, heist, jumper, maze and miner only.
    Memory,
}

impl DistributionMode {
    /// The mode's name, as in a configuration, and the engine's number of it.
    const fn row(self) -> (&'static str, i32) {
        match self {
            DistributionMode::Easy => ("easy", 0),
            DistributionMode::Hard => ("hard", 1),
            Extreme => ("extreme", 2),
            Memory => ("memory", 10),
        }
    }

    pub(crate) const fn number(self) -> i32 {
        self.row().1
    }
}

impl fmt::Display for DistributionMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.row().0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_in_the_order_of_the_games() {
        for (i, row) in TABLE.iter().enumerate() {
            assert_eq!(row.game as usize, i, "{}", row.name);
        }
    }
}
