//! The dials: what can be turned, its levels as settings, what each is expected to buy and to cost.
//! It measures nothing; the menu itself, and what all levels share in a world, is `tradeoff.toml`.

use std::collections::BTreeMap;

use driml_envs::WorldName;
use driml_machine::error::{Usage, nearest, usage};
use serde::{Deserialize, Serialize};

/// The file with all of it.
pub(super) const MENU: &str = include_str!("../tradeoff.toml");

/// A dial in one world: a base and the levels that are compared with it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Dial {
    pub(super) name: String,
    /// The name of the level that the settings of the world have.
    pub(super) base: String,
    buys: String,
    costs: String,
    /// The agent of its base; C51 if it names none.
    #[serde(default = "c51")]
    pub(super) agent: String,
    /// Kinds of worlds that have it; all if it names none.
    #[serde(default)]
    worlds: Vec<String>,
    /// Levels that set what the dial is named for.
    #[serde(default, skip_serializing)]
    values: Vec<String>,
    #[serde(default, skip_serializing)]
    levels: Vec<Level>,
}

fn c51() -> String {
    "c51".into()
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Level {
    name: String,
    /// In the form of `--set`, over the settings of the world.
    #[serde(default)]
    sets: Vec<String>,
    /// Another agent than the dial's.
    agent: Option<String>,
}

/// One choice of all settings: what a run, of any seed, is made with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Point {
    /// Names its runs and pieces.
    pub(super) key: String,
    pub(super) agent: String,
    /// Over the settings of the world.
    pub(super) sets: Vec<String>,
}

#[derive(Clone, Debug)]
pub(super) struct LevelOf {
    pub(super) dial: Dial,
    pub(super) level: String,
    pub(super) base: Point,
    pub(super) point: Point,
    /// Whether the call asks for its dial. What others have made of a dial is on the page too.
    pub(super) is_asked: bool,
}

impl LevelOf {
    pub(super) fn name(&self) -> String {
        format!("{} = {}", self.dial.name, self.level)
    }
}

impl Dial {
    fn levels(&self, is_asked: bool) -> impl Iterator<Item = LevelOf> {
        let base = Point {
            key: self.agent.clone(),
            agent: self.agent.clone(),
            sets: Vec::new(),
        };
        let values = self.values.iter().map(move |value| Level {
            name: value.clone(),
            sets: vec![format!("{}={value}", self.name)],
            agent: None,
        });
        let levels = values.chain(self.levels.iter().cloned());
        levels.map(move |level| {
            let agent = level.agent.unwrap_or_else(|| self.agent.clone());
            let key = match level.sets.is_empty() {
                true => agent.clone(),
                false => format!("{agent}-{}-{}", slug(&self.name), slug(&level.name)),
            };
            LevelOf {
                dial: self.clone(),
                level: level.name,
                base: base.clone(),
                point: Point {
                    key,
                    agent,
                    sets: level.sets,
                },
                is_asked,
            }
        })
    }
}

/// A name as files have it: letters, digits, dots and single dashes.
fn slug(name: &str) -> String {
    let parts = name.split(|c: char| !c.is_ascii_alphanumeric() && c != '.');
    let parts = parts.filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join("-")
}

/// What all runs in the worlds of one kind have, or in one game of it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct WorldBase {
    pub(super) frames: u64,
    /// In the form of `--set`.
    pub(super) sets: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(rename = "full")]
    _full: toml::Table,
    #[serde(rename = "smoke")]
    _smoke: toml::Table,
    /// By a world's name or its kind.
    world: BTreeMap<String, WorldBase>,
    dial: Vec<Dial>,
}

fn file() -> File {
    toml::from_str(MENU)
        .unwrap_or_else(|e| panic!("tradeoff.toml is built in, and a test reads it: {e}"))
}

/// The levels of all dials that a world has, in the order in which they are tried. `names` are the dials that are asked for; all if it is
/// empty.
pub(super) fn levels(world: WorldName, names: &[String]) -> Result<Vec<LevelOf>, Usage> {
    let has =
        |dial: &Dial| dial.worlds.is_empty() || dial.worlds.iter().any(|kind| kind == world.kind());
    let dials: Vec<Dial> = file().dial.into_iter().filter(has).collect();
    let known: Vec<_> = dials.iter().map(|dial| dial.name.as_str()).collect();
    if let Some(unknown) = names.iter().find(|name| !known.contains(&name.as_str())) {
        return Err(usage!(
            "there is no dial {unknown:?} in this world{}; --dials takes {}",
            nearest(unknown, known.iter().copied()),
            known.join(", ")
        ));
    }
    let asks_for = |dial: &Dial| names.is_empty() || names.contains(&dial.name);
    let levels = dials.iter().flat_map(|dial| dial.levels(asks_for(dial)));
    Ok(levels.collect())
}

/// What all runs in a world have: the game's own entry comes before that of its kind.
pub(super) fn world_base(world: WorldName) -> Result<WorldBase, Usage> {
    let mut worlds = file().world;
    let own = worlds.remove(&world.to_string());
    own.or_else(|| worlds.remove(world.kind())).ok_or_else(|| {
        let kinds = worlds.into_keys().filter(|name| !name.contains(':'));
        usage!(
            "driml tradeoff has no settings for {world}, with which something is learned in minutes; it has some for {}",
            kinds.collect::<Vec<_>>().join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_entry_of_a_game_comes_before_that_of_its_kind() {
        for (name, sets) in [("fruitbot", 5), ("coinrun", 1)] {
            let world = driml_settings::presets::world(name).unwrap();
            let base = world_base(world).unwrap();
            assert_eq!((base.frames, base.sets.len()), (30_000, sets), "{name}");
        }
    }
}
