//! The presets: TOML layers in `presets/`, built into the program and laid over one another.
//! No value is checked here: `config` checks the result.

use std::sync::OnceLock;

use driml_envs::WorldName;
use driml_machine::error::{Usage, did_you_mean, usage};
use serde::Deserialize;
use toml::{Table, Value};

/// A file in `presets/`: settings of all runs, of a kind of world, of a preset or of an agent.
#[derive(Clone, Copy, Debug)]
pub struct Layer {
    /// The name, as given to `--preset` or `--agent`.
    pub name: &'static str,
    /// The description in `driml presets`, one line.
    pub about: &'static str,
    /// The path in `presets/` without its extension; of a layer that a program adds, its name.
    pub(crate) path: &'static str,
    pub(crate) text: &'static str,
}

/// Makes a list of the layers in a folder.
macro_rules! layers {
    ($folder:literal: $($name:literal)+) => {
        &[$(Layer::built_in(
            $name,
            concat!($folder, $name),
            include_str!(concat!("../presets/", $folder, $name, ".toml")),
        )),+]
    };
}

const BASE: Layer = Layer::built_in("base", "base", include_str!("../presets/base.toml"));

/// The layer of each kind of world in the menu of worlds.
const WORLDS: &[Layer] = layers!("world/": "procgen" "mspacman" "chain" "ising" "exec");

/// Every preset, `paper` first. It is laid over base and world, under the agent: a preset does not change what defines an agent, such as
/// Rainbow's epsilon of 0.
pub const PRESETS: &[Layer] = layers!("variant/":
    "paper" "tuned" "paper-observation" "split" "exact" "balanced" "fast" "smoke");

/// Every agent that `--agent` takes.
pub const AGENTS: &[Layer] = layers!("agent/":
    "c51" "rainbow" "driml-fix" "driml-ada" "driml-randk" "driml-noact" "cpc" "curl");

static CUSTOM: OnceLock<Vec<Layer>> = OnceLock::new();

/// Adds agents, once, before anything else is done. An existing agent with the same name takes precedence.
pub fn register(agents: Vec<Layer>) {
    let first = CUSTOM.set(agents);
    first.expect("a program registers its agents once");
}

pub(crate) fn agents() -> Vec<&'static Layer> {
    let custom = CUSTOM.get().into_iter().flatten();
    AGENTS.iter().chain(custom).collect()
}

fn world_layer(world: WorldName) -> Layer {
    let kind = world.kind();
    let found = WORLDS.iter().find(|layer| layer.name == kind).copied();
    let custom = || Some(Layer::custom(kind, "", driml_envs::custom_preset(kind)?));
    let layer = found.or_else(custom);
    layer.expect("a test checks that each kind has its layers")
}

/// Finds a world by its name or its game's name.
pub fn world(name: &str) -> Result<WorldName, Usage> {
    let game = format!("procgen:{name}");
    let known = name.parse::<WorldName>();
    let known = known.or_else(|e| game.parse().map_err(|_| e));
    known.map_err(Usage)
}

/// Finds an agent by name.
pub fn agent(name: &str) -> Result<&'static Layer, Usage> {
    find_named("agent", name, &agents())
}

/// Finds a preset by name.
pub fn preset(name: &str) -> Result<&'static Layer, Usage> {
    let all: Vec<_> = PRESETS.iter().collect();
    find_named("preset", name, &all)
        .map_err(|unknown| usage!("{unknown} (`driml presets` describes them)"))
}

/// Finds a layer by the value of the flag `--kind`. The error for an unknown name has the nearest name, as a question, and all names.
fn find_named(kind: &str, name: &str, all: &[&'static Layer]) -> Result<&'static Layer, Usage> {
    let found = all.iter().copied().find(|layer| layer.name == name);
    found.ok_or_else(|| {
        let names: Vec<_> = all.iter().map(|layer| layer.name).collect();
        let near = did_you_mean(name, names.iter().copied());
        usage!(
            "there is no {kind} {name:?}{near}; --{kind} takes {}",
            names.join(", ")
        )
    })
}

/// What a run is made of: a preset, a world and an agent.
#[derive(Clone, Copy, Debug)]
pub struct Choice {
    pub(crate) preset: &'static Layer,
    pub(crate) world: WorldName,
    pub(crate) agent: &'static Layer,
}

impl Choice {
    /// Makes a choice by the values of the flags. The default is driml-ada on coinrun, with the preset `tuned` on Procgen and `paper`
    /// elsewhere.
    pub fn new(
        preset: Option<&str>,
        world: Option<&str>,
        agent: Option<&str>,
    ) -> Result<Self, Usage> {
        let world = self::world(world.unwrap_or("procgen:coinrun"));
        let world = world.map_err(|e| usage!("--env: {e}"))?;
        let agent = self::agent(agent.unwrap_or("driml-ada"))?;
        let is_game = world.kind() == "procgen";
        let preset = preset.unwrap_or(if is_game { "tuned" } else { "paper" });
        Ok(Self {
            preset: self::preset(preset)?,
            world,
            agent,
        })
    }

    /// Whether the preset is for this kind of world.
    pub fn fits_world(&self) -> bool {
        let kind = self.preset.read().preset.world_kind;
        kind.is_none_or(|kind| kind == self.world.kind())
    }

    /// Merges base, world, preset and agent in this order: a later layer wins. In each file, the settings for all worlds come first, then
    /// each `[[only]]` block that names the world.
    pub(crate) fn merged(&self) -> Result<Table, Usage> {
        let (preset, world) = (self.preset, self.world);
        if !self.fits_world() {
            let kind = preset.read().preset.world_kind.unwrap_or_default();
            return Err(usage!(
                "preset {:?} is for {kind} only, not for {world}; take --preset paper",
                preset.name
            ));
        }
        let name = world.without_library().to_string();
        let mut table = Table::new();
        for part in self.layers().iter().flat_map(Layer::parts) {
            if part.applies_to(&name) {
                merge(&mut table, part.set);
            }
        }
        Ok(table)
    }

    /// The layers to be merged, the lowest first.
    pub(crate) fn layers(&self) -> [Layer; 4] {
        [BASE, world_layer(self.world), *self.preset, *self.agent]
    }
}

#[derive(Deserialize)]
struct LayerFile {
    #[serde(default)]
    preset: PresetTable,
    #[serde(default)]
    only: Vec<LayerPart>,
    /// The settings for all worlds.
    #[serde(flatten)]
    set: Table,
}

/// The table `[preset]` of a preset: when it can be used, and what to know of it.
#[derive(Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
struct PresetTable {
    /// The kind of world for which the preset is made; none if it is for all.
    world_kind: Option<String>,
    /// The accuracy that the preset gives up for speed, with the largest measured errors: a line that a run prints.
    accuracy_note: Option<String>,
}

/// The settings of a layer for all worlds, or one of its `[[only]]` blocks.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct LayerPart {
    /// The worlds of a block; empty for the settings for all worlds.
    pub(crate) worlds: Vec<String>,
    #[serde(default)]
    set: Table,
    /// The text in the file, with its comments.
    #[serde(skip)]
    pub(crate) text: String,
}

impl LayerPart {
    pub(crate) fn applies_to(&self, world: &str) -> bool {
        self.worlds.is_empty() || self.worlds.iter().any(|name| name == world)
    }
}

impl Layer {
    /// Creates a layer that a program adds: its name, a line that describes it, and its settings, TOML as in `presets/agent/`.
    pub const fn custom(name: &'static str, about: &'static str, text: &'static str) -> Self {
        Self {
            name,
            about,
            path: name,
            text,
        }
    }

    /// Creates the layer in the file `presets/PATH.toml`, whose first line, a comment, describes it.
    const fn built_in(name: &'static str, path: &'static str, text: &'static str) -> Self {
        let mut end = 0;
        while text.as_bytes()[end] != b'\n' {
            end += 1;
        }
        let about = text.split_at(end).0.split_at("# ".len()).1;
        Self {
            path,
            ..Self::custom(name, about, text)
        }
    }

    fn read(&self) -> LayerFile {
        let what = "or what a program has registered by that name";
        let file: LayerFile = toml::from_str(self.text).unwrap_or_else(|e| {
            panic!(
                "presets/{}.toml, {what}, is not a layer of settings: {e}",
                self.path
            )
        });
        let is_preset = self.path.starts_with("variant/");
        assert!(
            is_preset || file.preset == PresetTable::default(),
            "presets/{}.toml, {what}, has a table [preset], but is not a preset",
            self.path
        );
        file
    }

    /// The accuracy that a preset gives up, as a line that a run prints.
    pub(crate) fn accuracy_note(&self) -> Option<String> {
        self.read().preset.accuracy_note
    }

    /// The settings for all worlds, then the blocks for some.
    pub(crate) fn parts(&self) -> Vec<LayerPart> {
        let LayerFile { set, only, .. } = self.read();
        let general = LayerPart {
            worlds: Vec::new(),
            set,
            text: String::new(),
        };
        let mut parts = vec![general];
        parts.extend(only);
        for (part, text) in parts.iter_mut().zip(self.text.split("[[only]]")) {
            part.text = text.to_owned();
        }
        parts
    }
}

/// Merges `upper` over `lower`, table by table; other values are replaced.
pub fn merge(lower: &mut Table, upper: Table) {
    for (key, value) in upper {
        match (lower.get_mut(&key), value) {
            (Some(Value::Table(lower)), Value::Table(upper)) => merge(lower, upper),
            (_, value) => {
                lower.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests;
