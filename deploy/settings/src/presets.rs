//! The presets: TOML layers in `presets/`, built into the program and laid over one another.
//! No value is checked here: `config` checks the result.

use std::sync::OnceLock;

use driml_envs::WorldName;
use driml_machine::error::{Usage, did_you_mean, usage};
use serde::Deserialize;
use toml::{Table, Value};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Layer {
    pub(crate) name: &'static str,
    pub(crate) text: &'static str,
}

macro_rules! layer {
    ($($path:literal)+) => {
        Layer {
            name: concat!($($path),+),
            text: include_str!(concat!("../presets/", $($path,)+ ".toml")),
        }
    };
}

const BASE: Layer = layer!("base");

/// A way to run any agent in a world.
#[derive(Clone, Debug)]
pub struct Preset {
    /// The name, as given to `--preset`.
    pub name: &'static str,
    /// The description in `driml presets`, one line.
    pub about: &'static str,
    /// Settings over base and world, under the agent: a preset does not change what defines an agent, such as Rainbow's epsilon of 0.
    layer: Option<Layer>,
    /// The kinds of world for which the preset is made; empty means all.
    world_kinds: &'static [&'static str],
    /// The accuracy that the preset gives up for speed, with the largest measured errors: lines that a run prints.
    pub(crate) accuracy_notes: &'static [&'static str],
}

const TUNED: &str = "tuned";

/// Returns the preset of this name for a run in `world`. The default is `tuned` on Procgen and `paper` elsewhere.
pub fn preset_or_default(name: Option<&str>, world: WorldName) -> Result<&'static Preset, Usage> {
    let is_game = world.kind() == "procgen";
    preset(name.unwrap_or(if is_game { TUNED } else { PRESETS[0].name }))
}

/// Makes [`PRESETS`]. A line has the preset's name, which is that of its file in `presets/variant/`, the kind of world if the preset is not
/// for all, the description, and what the preset gives up.
macro_rules! presets {
    ($($name:literal $(for $kind:literal)?: $about:literal $(, $note:literal)?;)+) => {
        /// Every preset, `paper` first.
        pub const PRESETS: &[Preset] = &[
            Preset {
                name: "paper",
                about: "as the paper's authors ran it, at the world's own frame size (the default outside Procgen)",
                layer: None,
                world_kinds: &[],
                accuracy_notes: &[],
            },
            $(Preset {
                name: $name,
                about: $about,
                layer: Some(layer!("variant/" $name)),
                world_kinds: &[$($kind)?],
                accuracy_notes: &[$($note)?],
            }),+
        ];
    };
}

presets! {
    "tuned" for "procgen":
        "more exploration, fewer and smaller updates, a soft target network, on three games a residual torso (the default on Procgen)";
    "paper-observation" for "procgen": "`paper` with Procgen's frame enlarged to the paper's 104 x 80: 2.3 times the arithmetic";
    "split" for "procgen": "`paper` with one of 500 Procgen levels per episode, and unseen levels to test on";
    "exact": "`paper` with products, weights and frames as exact as the program can compute them";
    "balanced": "`exact` in the learner; bf16 arithmetic and f16 weights in the actors",
        "balanced: bf16 actors and f16 weights (another greedy action in up to 6% and 0.2% of states), see deploy/docs/src/results/tradeoff.md";
    "fast": "bf16 in learner and actors, f16 weights sent to actors",
        "fast: bf16 learner (gradients off by up to 15% with DIM), bf16 actors and f16 weights (another greedy action in up to 6% and 0.2% of states), see deploy/docs/src/results/tradeoff.md";
    "smoke": "a tiny network, batch and replay: shows within a minute that all processes work together";
}

/// An agent: its name and its layer of settings.
#[derive(Clone, Debug)]
pub struct Agent {
    /// The name, as given to `--agent`.
    pub name: &'static str,
    /// The description in `driml presets`, one line.
    pub(crate) about: &'static str,
    layer: Layer,
}

/// Makes [`AGENTS`]. A line has the agent's name, which is that of its file in `presets/agent/`, and the description.
macro_rules! agents {
    ($($name:literal: $about:literal;)+) => {
        /// Every agent that `--agent` takes.
        pub const AGENTS: &[Agent] = &[$(Agent {
            name: $name,
            about: $about,
            layer: layer!("agent/" $name),
        }),+];
    };
}

agents! {
    "c51": "C51 without an auxiliary loss";
    "rainbow": "c51 with double DQN, rows drawn by priority, a dueling head, and noisy layers in place of epsilon";
    "driml-fix": "DIM at a fixed k, chosen by game; augments its states on seven of them";
    "driml-ada": "DIM at a k that follows how predictable the stored actions are (the default)";
    "driml-randk": "DIM at a k drawn uniformly";
    "driml-noact": "DIM without the action as input";
    "cpc": "one InfoNCE for each of k = 1..5, without the action as input";
    "curl": "two augmentations of the same state, the second one seen by a moving average of the network";
}

static CUSTOM: OnceLock<Vec<Agent>> = OnceLock::new();

impl Agent {
    /// Creates an agent that a program adds, for `--agent NAME`. `layer` has its settings, TOML as in `presets/agent/`.
    pub const fn new(name: &'static str, about: &'static str, layer: &'static str) -> Self {
        Self {
            name,
            about,
            layer: Layer { name, text: layer },
        }
    }
}

/// Adds agents, before anything else is done. An existing agent with the same name takes precedence.
///
/// # Panics
/// If agents were registered before.
pub fn register(agents: Vec<Agent>) {
    let first = CUSTOM.set(agents);
    first.expect("a program registers its agents once");
}

pub(crate) fn agents() -> Vec<&'static Agent> {
    let custom = CUSTOM.get().into_iter().flatten();
    AGENTS.iter().chain(custom).collect()
}

/// The layer of each kind of world in the registry of worlds.
const WORLDS: &[Layer] = &[
    layer!("world/procgen"),
    layer!("world/mspacman"),
    layer!("world/chain"),
    layer!("world/ising"),
    layer!("world/exec"),
];

fn world_layer(world: WorldName) -> Layer {
    let name = format!("world/{}", world.kind());
    let found = WORLDS.iter().find(|layer| layer.name == name).copied();
    let own = driml_envs::custom_preset(world.kind()).map(|text| Layer {
        name: world.kind(),
        text,
    });
    let layer = found.or(own);
    layer.expect("a test checks that each kind has its layers")
}

/// Finds a world by its name or its game's name.
pub fn world(name: &str) -> Result<WorldName, Usage> {
    let game = format!("procgen:{name}");
    let known = name.parse::<WorldName>();
    let known = known.or_else(|e| game.parse().map_err(|_| e));
    known.map_err(|e| Usage(e.to_string()))
}

/// Finds an agent by name.
pub fn agent(name: &str) -> Result<&'static Agent, Usage> {
    let agents = agents();
    let found = agents.iter().copied().find(|agent| agent.name == name);
    found.ok_or_else(|| Usage(unknown_name("agent", name, agents.iter().map(|it| it.name))))
}

/// Finds a preset by name.
pub fn preset(name: &str) -> Result<&'static Preset, Usage> {
    let found = PRESETS.iter().find(|preset| preset.name == name);
    found.ok_or_else(|| {
        let unknown = unknown_name("preset", name, PRESETS.iter().map(|it| it.name));
        usage!("{unknown} (`driml presets` describes them)")
    })
}

/// The error for an unknown name after the flag `kind`: the nearest name, as a question, and all names.
fn unknown_name(kind: &str, name: &str, all: impl Iterator<Item = &'static str>) -> String {
    let all: Vec<_> = all.collect();
    let (near, names) = (did_you_mean(name, all.iter().copied()), all.join(", "));
    format!("there is no {kind} {name:?}{near}; --{kind} takes {names}")
}

/// Merges base, world, preset and agent in this order: a later layer wins. In each file, the settings for all worlds come first, then each
/// `[[only]]` block that names the world.
pub(crate) fn merged(preset: &Preset, world: WorldName, agent: &Agent) -> Result<Table, Usage> {
    if !preset.world_kinds.is_empty() && !preset.world_kinds.contains(&world.kind()) {
        return Err(usage!(
            "preset {:?} is for {} only, not for {world}; take --preset paper",
            preset.name,
            preset.world_kinds.join(", ")
        ));
    }
    let name = world.without_library().to_string();
    let mut table = Table::new();
    for layer in layers(preset, world, agent) {
        for part in layer.parts().into_iter().filter(|it| it.applies_to(&name)) {
            merge(&mut table, part.set);
        }
    }
    Ok(table)
}

/// The layers to be merged, the lowest first.
pub(crate) fn layers(preset: &Preset, world: WorldName, agent: &Agent) -> Vec<Layer> {
    let below = [BASE, world_layer(world)].into_iter();
    below.chain(preset.layer).chain([agent.layer]).collect()
}

/// The settings of a layer for all worlds, or one of its `[[only]]` blocks.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct LayerPart {
    #[serde(skip)]
    pub(crate) is_general: bool,
    worlds: Vec<String>,
    #[serde(default)]
    set: Table,
    /// The text in the file, with its comments.
    #[serde(skip)]
    pub(crate) text: String,
}

impl LayerPart {
    pub(crate) fn applies_to(&self, world: &str) -> bool {
        self.is_general || self.worlds.iter().any(|name| name == world)
    }
}

impl Layer {
    /// The settings for all worlds, then the blocks for some.
    pub(crate) fn parts(&self) -> Vec<LayerPart> {
        let bad = |e| -> ! {
            panic!(
                "presets/{}.toml, or what a program has registered by that name, is not a layer of settings: {e}",
                self.name
            )
        };
        let mut set: Table = self.text.parse().unwrap_or_else(|e| bad(e));
        let blocks = set.remove("only");
        let blocks: Option<Vec<LayerPart>> =
            blocks.map(|blocks| blocks.try_into().unwrap_or_else(|e| bad(e)));
        let mut parts = vec![LayerPart {
            is_general: true,
            worlds: Vec::new(),
            set,
            text: String::new(),
        }];
        parts.extend(blocks.unwrap_or_default());
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
