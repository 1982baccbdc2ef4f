//! The output of `driml presets`: presets, agents and differences by game, and all settings of one game and agent, each with the source in
//! its preset file. `flags` resolves the settings.

use std::collections::BTreeMap;

use driml_envs::WorldName;
use driml_machine::{error::Usage, resources::Machine};
use toml::{Table, Value};

use crate::{
    derived::{self, find},
    flags::{Flags, Source},
    presets::{Agent, Layer, PRESETS, Preset, agent, agents, layers, merged, preset_or_default},
};

/// The column at which a setting's source begins, if the setting leaves room.
const SOURCE_COLUMN: usize = 44;
const SET_BY_MACHINE: &str =
    "local.actors local.learner_threads local.learner_device actor.envs actor.world_threads";

/// Settings that a world in its own process declares.
const SET_BY_WORLD: &str =
    "world.height world.width world.channels world.actions input.height input.width";

/// Returns the list of presets, agents and differences by game.
pub fn menu() -> Result<String, Usage> {
    let presets = PRESETS.iter().map(|preset| (preset.name, preset.about));
    let agents = agents();
    let agents = agents.iter().map(|agent| (agent.name, agent.about));
    let names = presets.clone().chain(agents.clone());
    let width = names.map(|(name, _)| name.len()).max().unwrap_or(0);
    let line = |(name, about)| format!("{name:width$}  {about}\n");
    let presets: String = presets.map(line).collect();
    let agents: String = agents.map(line).collect();
    let mut text = format!("--preset\n{presets}\n--agent\n{agents}\n");
    text += "what differs by world, with its default preset\n";
    text += &format!(
        "{:18}  {:9}  {:9}  {:11}  lambdas of DIM\n",
        "--env", "driml-fix", "augments", "driml-noact"
    );
    for world in WorldName::all() {
        let preset = preset_or_default(None, world)?;
        let settings = |name: &str| merged(preset, world, agent(name)?);
        let (fix, noact) = (settings("driml-fix")?, settings("driml-noact")?);
        let augments = find(&fix, "learner.augment").map_or("-", |_| "yes");
        let (world, fix_k, noact_k, lambdas) =
            (world.to_string(), k(&fix), k(&noact), lambdas(&fix));
        text += &format!("{world:18}  k = {fix_k:<5}  {augments:9}  k = {noact_k:<7}  {lambdas}\n");
    }
    text += "\noff in every preset\n";
    text += "--actors 4 --set 'actor.epsilon_ladder={base=0.4,alpha=7}'  a fixed epsilon per actor, each smaller than the one before, as in Ape-X\n";
    text += "\ntuned uses it on bigfish, fruitbot and starpilot; works on any game\n";
    text += "--set model.torso=impala                         a residual torso: fewer frames, ten times the arithmetic; impoola: with a mean before f4\n";
    text += "\nrainbow uses it; works with any agent\n";
    text += "--set 'model.head={dueling=true,noisy_sigma=0.5}'  two streams of the C51 head; noisy layers (then --set actor.epsilon_start=0 too)\n";
    text += "\nEvery setting of one of them with its source: driml presets --env bigfish --agent driml-fix\n";
    Ok(text)
}

fn k(table: &Table) -> String {
    find(table, "run.horizon.k").map_or("-".into(), Value::to_string)
}

fn lambdas(table: &Table) -> String {
    let all = find(table, "learner.update.lambda").and_then(Value::as_table);
    let weighs = |value: &Value| value.as_float().is_some_and(|value| value > 0.0);
    let some = all.into_iter().flatten().filter(|(_, value)| weighs(value));
    let text = |(pair, value): (&String, &Value)| format!("{pair} {value}");
    some.map(text).collect::<Vec<_>>().join(", ")
}

/// Returns the resolved settings, each with its source.
pub fn settings_with_sources(
    preset: &'static Preset,
    world: WorldName,
    agent: &'static Agent,
) -> Result<String, Usage> {
    let source = Source::Layers(preset, world, agent);
    // Shows what the preset asks for on any machine, whatever memory is free at this moment.
    let machine = Machine {
        memory_bytes: u64::MAX,
        ..Machine::detect()
    };
    let table = source.resolve(&Flags::default(), &machine)?.to_table();
    let mut sources = BTreeMap::new();
    for layer in layers(preset, world, agent) {
        record_sources(&layer, &world.without_library().to_string(), &mut sources);
    }
    let mut text = format!(
        "# {} in {world}, preset {}: every setting and its source. `driml train --config` takes this file.\n",
        agent.name, preset.name
    );
    write_table(&table, "", &sources, &mut text);
    Ok(text)
}

/// Writes `table`, whose path is `path`: first its values, then the tables in it.
fn write_table(table: &Table, path: &str, sources: &BTreeMap<String, String>, out: &mut String) {
    let inner = |key: &str| match path {
        "" => key.to_owned(),
        _ => format!("{path}.{key}"),
    };
    // A table that a preset writes on one line stays on one line.
    let is_line = |key: &str, value: &Value| {
        !value.is_table() || sources.contains_key(&inner(key)) || inner(key) == "model.dim"
    };
    let (lines, tables): (Vec<_>, Vec<_>) =
        table.iter().partition(|(key, value)| is_line(key, value));
    if !lines.is_empty() {
        out.push_str(&format!("\n[{path}]\n"));
    }
    for (key, value) in lines {
        let setting = format!("{} = {value}", quoted(key));
        // Only a world in its own process has this setting.
        let is_process = sources.contains_key("world.start_timeout_ms");
        let source = find_source(&inner(key), sources, is_process);
        out.push_str(&format!("{setting:SOURCE_COLUMN$} # {source}\n"));
    }
    for (key, value) in tables {
        if let Value::Table(table) = value {
            write_table(table, &inner(key), sources, out);
        }
    }
}

fn quoted(key: &str) -> String {
    let bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    match key.chars().all(bare) {
        true => key.to_owned(),
        false => Value::String(key.to_owned()).to_string(),
    }
}

fn find_source<'a>(path: &str, sources: &'a BTreeMap<String, String>, is_process: bool) -> &'a str {
    let is_listed = |paths: &str| paths.split(' ').any(|it| it == path);
    match sources.get(path) {
        Some(source) => source,
        None if is_listed(SET_BY_MACHINE) => "this machine",
        None if is_process && is_listed(SET_BY_WORLD) => "the world declares it",
        None => derived::find_derived(path).map_or("not said", |(_, how)| how),
    }
}

/// Adds the comment on each setting of a layer, in place of the comment of an earlier layer.
fn record_sources(layer: &Layer, world: &str, sources: &mut BTreeMap<String, String>) {
    for part in layer.parts().iter().filter(|it| it.applies_to(world)) {
        let how = if part.is_general { "" } else { ", by world" };
        for (path, comment) in comments(&part.text) {
            let source = format!("{comment} [{}{how}]", layer.name);
            sources.insert(path, source.trim_start().to_owned());
        }
    }
}

/// Returns the path of each setting in a preset file, or in an `[[only]]` block of one, and its comment: above, beside or below it.
pub(crate) fn comments(text: &str) -> Vec<(String, String)> {
    let mut found: Vec<(String, String)> = Vec::new();
    let (mut table, mut above) = (String::new(), String::new());
    for line in text.lines() {
        let bare = line.trim();
        if let Some(remark) = bare.strip_prefix('#') {
            let continues = line.starts_with(' ');
            match found.last_mut() {
                Some((_, comment)) if continues => *comment += &format!(" {}", remark.trim()),
                _ => above = remark.trim().to_owned(),
            }
        } else if let Some(name) = bare.strip_prefix('[').and_then(|it| it.strip_suffix(']')) {
            table = format!("{name}.");
            above.clear();
        } else if let Some((key, rest)) = bare.split_once(" = ") {
            let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
            if key.chars().all(plain) {
                let key = key.strip_prefix("set.").unwrap_or(key);
                let beside = rest.split_once(" # ").map(|(_, comment)| comment.trim());
                let comment = beside.map_or_else(|| above.clone(), str::to_owned);
                found.push((format!("{table}{key}"), comment));
                above.clear();
            }
        } else if bare.is_empty() {
            above.clear();
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use expect_test::expect_file;

    use super::*;
    use crate::{config::RunConfig, presets::AGENTS};

    #[test]
    fn every_setting_of_every_game_and_agent_has_a_source_and_reads_back() {
        for world in WorldName::all() {
            for agent in AGENTS {
                let text = settings_with_sources(&PRESETS[0], world, agent).unwrap();
                assert!(!text.contains("not said"), "{text}");
                RunConfig::parse("printed", &text).unwrap();
            }
        }
    }

    #[test]
    fn a_game_s_own_choice_is_named_as_such() {
        let world = "procgen:bigfish".parse().unwrap();
        let text = settings_with_sources(&PRESETS[0], world, agent("driml-fix").unwrap()).unwrap();
        let mut lines = text.lines();
        let horizon = lines.find(|line| line.starts_with("horizon")).unwrap();
        assert!(
            horizon.contains("k = 5") && horizon.ends_with("# paper [agent/driml-fix, by world]"),
            "{horizon}"
        );
        assert!(text.contains("augment = "), "{text}");
        let again: Table = text.parse().unwrap();
        assert_eq!(k(&again), "5");
    }

    #[test]
    fn comments_are_found_beside_above_and_below() {
        let text = "# of the file\n\n[a]\nx = 1   # one\ny = 2   # two,\n        # and more\n# above\nz = 3\n";
        let found = comments(text).into_iter();
        let found = found.map(|(path, comment)| format!("{path}: {comment}"));
        let expected = ["a.x: one", "a.y: two, and more", "a.z: above"];
        assert_eq!(found.collect::<Vec<_>>(), expected);
    }

    /// The paper chooses which games look five steps ahead and which augment their states.
    #[test]
    fn the_menu_shows_what_differs_by_game() {
        expect_file!["../tests/snapshots/menu.txt"].assert_eq(&menu().unwrap());
    }
}
