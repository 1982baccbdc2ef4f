//! The sixteen games of Procgen and the difficulties each of them has.
//! It holds names and tables only; nothing here calls the engine.

use std::fmt;
use std::str::FromStr;

use strsim::levenshtein;

/// One of Procgen's games.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize,
)]
#[serde(try_from = "String", into = "String")]
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

impl Game {
    /// Every game, by name.
    pub const ALL: [Game; 16] = [
        Game::Bigfish,
        Game::Bossfight,
        Game::Caveflyer,
        Game::Chaser,
        Game::Climber,
        Game::Coinrun,
        Game::Dodgeball,
        Game::Fruitbot,
        Game::Heist,
        Game::Jumper,
        Game::Leaper,
        Game::Maze,
        Game::Miner,
        Game::Ninja,
        Game::Plunder,
        Game::Starpilot,
    ];

    /// Their names, in the same order.
    pub const NAMES: [&str; Self::ALL.len()] = {
        let mut names = [""; Self::ALL.len()];
        let mut i = 0;
        while i < names.len() {
            names[i] = Self::ALL[i].name();
            i += 1;
        }
        names
    };

    /// The engine's name of the game.
    pub const fn name(self) -> &'static str {
        match self {
            Game::Bigfish => "bigfish",
            Game::Bossfight => "bossfight",
            Game::Caveflyer => "caveflyer",
            Game::Chaser => "chaser",
            Game::Climber => "climber",
            Game::Coinrun => "coinrun",
            Game::Dodgeball => "dodgeball",
            Game::Fruitbot => "fruitbot",
            Game::Heist => "heist",
            Game::Jumper => "jumper",
            Game::Leaper => "leaper",
            Game::Maze => "maze",
            Game::Miner => "miner",
            Game::Ninja => "ninja",
            Game::Plunder => "plunder",
            Game::Starpilot => "starpilot",
        }
    }

    /// Steps after which the engine ends an episode; the step with this number is the last.
    ///
    /// Source: the engine's own `timeout`, read out of its saved states for every game and mode (`tests/engine.rs`).
    pub const fn time_limit_steps(self, mode: DistributionMode) -> u32 {
        match (self, mode) {
            (Game::Bigfish, _) => 6000,
            (Game::Bossfight | Game::Plunder, _) => 4000,
            (Game::Leaper | Game::Maze, _) => 500,
            (Game::Jumper, DistributionMode::Memory) => 2000,
            _ => 1000,
        }
    }

    /// Whether the game has this difficulty; the engine ends the process where it has not.
    pub const fn has(self, mode: DistributionMode) -> bool {
        match mode {
            DistributionMode::Easy | DistributionMode::Hard => true,
            DistributionMode::Extreme => {
                matches!(
                    self,
                    Game::Chaser | Game::Dodgeball | Game::Leaper | Game::Starpilot
                )
            }
            DistributionMode::Memory => matches!(
                self,
                Game::Caveflyer
                    | Game::Dodgeball
                    | Game::Heist
                    | Game::Jumper
                    | Game::Maze
                    | Game::Miner
            ),
        }
    }
}

impl fmt::Display for Game {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl From<Game> for String {
    fn from(game: Game) -> String {
        game.name().to_owned()
    }
}

impl TryFrom<String> for Game {
    type Error = ParseGameError;

    fn try_from(name: String) -> Result<Game, ParseGameError> {
        name.parse()
    }
}

impl FromStr for Game {
    type Err = ParseGameError;

    fn from_str(name: &str) -> Result<Game, ParseGameError> {
        let known = Game::ALL.into_iter().find(|game| game.name() == name);
        known.ok_or_else(|| ParseGameError {
            name: name.to_owned(),
        })
    }
}

/// A name that is none of the games'.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParseGameError {
    name: String,
}

impl fmt::Display for ParseGameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "no procgen game is named \"{}\"", self.name)?;
        let name = self.name.to_lowercase();
        let nearest = Game::ALL
            .into_iter()
            .min_by_key(|game| levenshtein(&name, game.name()));
        if let Some(game) = nearest.filter(|game| levenshtein(&name, game.name()) <= 3) {
            write!(f, "; did you mean \"{game}\"?")?;
        }
        write!(f, " (the games: {})", Game::NAMES.join(", "))
    }
}

impl std::error::Error for ParseGameError {}

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
    /// The engine's number of the mode.
    pub(crate) const fn number(self) -> i32 {
        match self {
            DistributionMode::Easy => 0,
            DistributionMode::Hard => 1,
            DistributionMode::Extreme => 2,
            DistributionMode::Memory => 10,
        }
    }

    /// The mode's name, as in a configuration.
    pub const fn name(self) -> &'static str {
        match self {
            DistributionMode::Easy => "easy",
            DistributionMode::Hard => "hard",
            DistributionMode::Extreme => "extreme",
            DistributionMode::Memory => "memory",
        }
    }
}

impl fmt::Display for DistributionMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for DistributionMode {
    type Err = ParseModeError;

    fn from_str(name: &str) -> Result<DistributionMode, ParseModeError> {
        match name {
            "easy" => Ok(DistributionMode::Easy),
            "hard" => Ok(DistributionMode::Hard),
            "extreme" => Ok(DistributionMode::Extreme),
            "memory" => Ok(DistributionMode::Memory),
            _ => Err(ParseModeError(name.to_owned())),
        }
    }
}

/// A name that is none of the modes'.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no procgen distribution mode is named \"{0}\" (the modes: easy, hard, extreme, memory)")]
pub struct ParseModeError(String);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_go_there_and_back() {
        for game in Game::ALL {
            assert_eq!(game.name().parse(), Ok(game));
        }
        for name in ["easy", "hard", "extreme", "memory"] {
            assert_eq!(name.parse::<DistributionMode>().unwrap().name(), name);
        }
        assert!(
            "medium"
                .parse::<DistributionMode>()
                .unwrap_err()
                .to_string()
                .contains("easy, hard")
        );
    }

    #[test]
    fn a_wrong_name_is_answered_with_the_nearest_and_the_list() {
        let text = "starpillot".parse::<Game>().unwrap_err().to_string();
        assert!(text.contains("did you mean \"starpilot\"?"), "{text}");
        assert!(text.contains("bigfish, bossfight"), "{text}");
        let text = "BigFish".parse::<Game>().unwrap_err().to_string();
        assert!(text.contains("did you mean \"bigfish\"?"), "{text}");
        let text = "montezuma_revenge".parse::<Game>().unwrap_err().to_string();
        assert!(!text.contains("did you mean"), "{text}");
    }
}
