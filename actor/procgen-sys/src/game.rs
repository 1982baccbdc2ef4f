//! The sixteen games of Procgen and the difficulties each of them has.
//! It holds names and tables only; nothing here calls the engine.

use std::fmt;

use DistributionMode::{Easy, Extreme, Hard, Memory};

/// Makes [`Game`] from one line per game: its name, the most steps of an episode, and its modes besides easy and hard.
macro_rules! games {
    ($($Game:ident $name:literal $limit:literal [$($mode:ident)*];)+) => {
        /// One of Procgen's games.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
        #[serde(rename_all = "lowercase")]
        #[allow(missing_docs, reason = "the names are the documentation")]
        pub enum Game {
            $($Game),+
        }

        impl Game {
            /// Every game, by name.
            pub const ALL: [Game; 16] = [$(Game::$Game),+];

            /// The names of all games, in the same order.
            pub const NAMES: [&str; Game::ALL.len()] = [$($name),+];

            /// Steps after which the engine ends an episode; the step with this number is the last.
            ///
            /// Source: the engine's own `timeout`, read out of its saved states for every game and mode (`tests/engine.rs`).
            pub const fn time_limit_steps(self, mode: DistributionMode) -> u32 {
                match (self, mode) {
                    (Game::Jumper, Memory) => 2000,
                    $((Game::$Game, _) => $limit,)+
                }
            }

            /// Whether the game has this difficulty; the engine ends the process if not.
            pub const fn has_mode(self, mode: DistributionMode) -> bool {
                match self {
                    $(Game::$Game => matches!(mode, Easy | Hard $(| $mode)*),)+
                }
            }
        }
    };
}

games! {
    Bigfish "bigfish" 6000 [];
    Bossfight "bossfight" 4000 [];
    Caveflyer "caveflyer" 1000 [Memory];
    Chaser "chaser" 1000 [Extreme];
    Climber "climber" 1000 [];
    Coinrun "coinrun" 1000 [];
    Dodgeball "dodgeball" 1000 [Extreme Memory];
    Fruitbot "fruitbot" 1000 [];
    Heist "heist" 1000 [Memory];
    Jumper "jumper" 1000 [Memory];
    Leaper "leaper" 500 [Extreme];
    Maze "maze" 500 [Memory];
    Miner "miner" 1000 [Memory];
    Ninja "ninja" 1000 [];
    Plunder "plunder" 4000 [];
    Starpilot "starpilot" 1000 [Extreme];
}

impl Game {
    /// The engine's name of the game.
    pub const fn name(self) -> &'static str {
        Game::NAMES[self as usize]
    }
}

impl fmt::Display for Game {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The difficulty and the kind of the levels, numbered as in the engine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DistributionMode {
    /// Smaller and simpler levels; every game has it.
    Easy = 0,
    /// The engine's standard levels; every game has it.
    Hard = 1,
    /// Harder levels: chaser, dodgeball, leaper and starpilot only.
    Extreme = 2,
    /// Larger levels of which little is seen at once: caveflyer, dodgeball, heist, jumper, maze and miner only.
    Memory = 10,
}

impl fmt::Display for DistributionMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        serde::Serialize::serialize(self, f)
    }
}
