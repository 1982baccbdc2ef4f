//! The dials: what can be turned, its levels as settings, what each is expected to buy and to cost.
//! It measures nothing; the menu itself, and what all levels share in a world, is `tradeoff.toml`.

use driml_envs::WorldName;
use driml_machine::error::{Usage, nearest, usage};
use serde::Deserialize;

const FILE: &str = include_str!("../tradeoff.toml");
/// The agent of a dial that names none.
const AGENT: &str = "c51";

/// A dial in one world: a base and the levels that are compared with it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Dial {
    pub(super) name: String,
    /// The name of the level that the settings of the world have.
    pub(super) base: String,
    /// What the other levels are expected to buy.
    pub(super) buys: String,
    /// Why they are expected to cost accuracy.
    pub(super) costs: String,
    /// The agent of its base.
    #[serde(default = "agent")]
    pub(super) agent: String,
    /// Kinds of worlds that have it; all if it names none.
    #[serde(default)]
    worlds: Vec<String>,
    pub(super) levels: Vec<Level>,
}

fn agent() -> String {
    AGENT.into()
}

/// A level of a dial.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Level {
    pub(super) name: String,
    /// In the form of `--set`, over the settings of the world.
    #[serde(default)]
    sets: Vec<String>,
    /// Another agent than the dial's.
    agent: Option<String>,
}

/// One choice of all settings: what a run, of any seed, is made with.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Point {
    /// Names its runs and pieces.
    pub(super) key: String,
    pub(super) agent: String,
    /// Over the settings of the world.
    pub(super) sets: Vec<String>,
}

impl Dial {
    /// What its levels are compared with.
    pub(super) fn base_point(&self) -> Point {
        Point {
            key: self.agent.clone(),
            agent: self.agent.clone(),
            sets: Vec::new(),
        }
    }

    /// What a level of it is made with.
    pub(super) fn point(&self, level: &Level) -> Point {
        let agent = level.agent.as_ref().unwrap_or(&self.agent);
        let key = match level.sets.is_empty() {
            true => agent.clone(),
            false => format!("{agent}-{}-{}", slug(&self.name), slug(&level.name)),
        };
        Point {
            key,
            agent: agent.clone(),
            sets: level.sets.clone(),
        }
    }
}

/// A name as files have it: letters, digits, dots and single dashes.
fn slug(name: &str) -> String {
    let kept = |c: char| {
        if c.is_ascii_alphanumeric() || c == '.' {
            c
        } else {
            '-'
        }
    };
    let parts: String = name.chars().map(kept).collect();
    let parts = parts.split('-').filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join("-")
}

/// The file of settings.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    full: Length,
    smoke: Length,
    world: Vec<WorldBase>,
    dial: Vec<Dial>,
}

/// What every world's runs have at a length.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Length {
    pub(super) preset: String,
    /// Of each level.
    pub(super) seeds: u32,
    /// Played with each run's weights.
    pub(super) episodes: u32,
    /// Of a run; as its world says if this says nothing.
    pub(super) frames: Option<u64>,
    /// After those of the world, in the form of `--set`.
    pub(super) sets: Vec<String>,
}

fn file() -> File {
    toml::from_str(FILE)
        .unwrap_or_else(|e| panic!("tradeoff.toml is built in, and a test reads it: {e}"))
}

/// The full or the smoke length.
pub(super) fn length(smoke: bool) -> Length {
    let file = file();
    if smoke { file.smoke } else { file.full }
}

/// What all runs in the worlds of one kind have, or in one game of it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct WorldBase {
    kind: String,
    /// The one game that it is for; all that no other entry names if there is none.
    game: Option<String>,
    /// Frames of a run.
    pub(super) frames: u64,
    /// In the form of `--set`.
    pub(super) sets: Vec<String>,
}

/// The dials that a world has, in the order in which they are tried.
pub(super) fn dials(world: WorldName) -> Vec<Dial> {
    let has =
        |dial: &Dial| dial.worlds.is_empty() || dial.worlds.iter().any(|kind| kind == world.kind());
    file().dial.into_iter().filter(has).collect()
}

/// What all runs in a world have.
pub(super) fn world_base(world: WorldName) -> Result<WorldBase, Usage> {
    let worlds = file().world;
    let mut of_kind: Vec<_> = worlds.iter().filter(|it| it.kind == world.kind()).collect();
    // A game's own before that of all.
    of_kind.sort_by_key(|it| it.game.is_none());
    let is_for = |it: &WorldBase| {
        let game = it.game.as_ref();
        game.is_none_or(|game| format!("{}:{game}", it.kind) == world.to_string())
    };
    of_kind.into_iter().find(|it| is_for(it)).cloned().ok_or_else(|| {
        let mut kinds: Vec<_> = worlds.iter().map(|it| it.kind.as_str()).collect();
        kinds.dedup();
        usage!(
            "driml tradeoff has no settings for {world}, with which something is learned in minutes; it has some for {}",
            kinds.join(", ")
        )
    })
}

/// Those of `all` that are asked for by name, in the order of the menu; all if none are.
pub(super) fn chosen(all: Vec<Dial>, names: &[String]) -> Result<Vec<Dial>, Usage> {
    if let Some(unknown) = names
        .iter()
        .find(|name| all.iter().all(|dial| dial.name != **name))
    {
        let known: Vec<_> = all.iter().map(|dial| dial.name.as_str()).collect();
        return Err(usage!(
            "there is no dial {unknown:?} in this world{}; --dials takes {}",
            nearest(unknown, known.iter().copied()),
            known.join(", ")
        ));
    }
    let asked = |dial: &Dial| names.is_empty() || names.contains(&dial.name);
    Ok(all.into_iter().filter(asked).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_game_of_its_own_comes_before_its_kind() {
        let frames = |name: &str| {
            let world = driml_settings::presets::world(name).unwrap();
            world_base(world).map(|base| (base.frames, base.sets.len()))
        };
        assert_eq!(frames("procgen:fruitbot").unwrap(), (30_000, 5));
        assert_eq!(frames("procgen:coinrun").unwrap(), (30_000, 1));
        let said = frames("ising").unwrap_err().to_string();
        assert!(
            said.ends_with("it has some for mspacman, procgen, chain"),
            "{said}"
        );
    }
}
