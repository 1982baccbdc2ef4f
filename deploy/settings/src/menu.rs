//! The output of `driml presets`: presets, agents and differences by game, and all settings of one game and agent, each with the source in
//! its preset file. `flags` resolves the settings.

use std::collections::BTreeMap;

use driml_envs::WorldName;
use driml_machine::{error::Usage, resources::Machine};
use toml::{Table, Value};

use crate::{
    derived,
    flags::{Flags, Source},
    overrides::find,
    presets::{Choice, Layer, PRESETS, agents},
};

/// The column at which a setting's source begins, if the setting leaves room.
const SOURCE_COLUMN: usize = 44;
const SET_BY_MACHINE: &str =
    "local.actors local.learner_threads local.learner_device actor.envs actor.world_threads";

/// Settings that a world in its own process declares.
const SET_BY_WORLD: &str =
    "world.height world.width world.channels world.actions input.height input.width";

const FURTHER_SETTINGS: &str = "
off in every preset
--actors 4 --set 'actor.epsilon_ladder={base=0.4,alpha=7}'  a fixed epsilon per actor, each smaller than the one before, as in Ape-X

tuned uses it on most games of Procgen; works on any game
--set model.torso=impala                         a residual torso: fewer frames, ten times the arithmetic; impoola: with a mean before f4

rainbow uses it; works with any agent
--set 'model.head={dueling=true,noisy_sigma=0.5}'  two streams of the C51 head; noisy layers (then --set actor.epsilon_start=0 too)

Every setting of one of them with its source: driml presets --env bigfish --agent driml-fix
";

/// Returns the list of presets, agents and differences by game.
pub fn menu() -> Result<String, Usage> {
    let agents = agents();
    let names = PRESETS.iter().chain(agents.iter().copied());
    let width = names.map(|it| it.name.len()).max().unwrap_or(0);
    let line = |it: &Layer| format!("{:width$}  {}\n", it.name, it.about);
    let presets: String = PRESETS.iter().map(line).collect();
    let agents: String = agents.into_iter().map(line).collect();
    let mut text = format!("--preset\n{presets}\n--agent\n{agents}\n");
    text += "what differs by world, with its default preset\n";
    text += &format!(
        "{:18}  {:9}  {:9}  {:11}  lambdas of DIM\n",
        "--env", "driml-fix", "augments", "driml-noact"
    );
    for world in WorldName::all() {
        let world = world.to_string();
        let settings = |agent| Choice::new(None, Some(&world), Some(agent))?.merged();
        let (fix, noact) = (settings("driml-fix")?, settings("driml-noact")?);
        let augments = find(&fix, "learner.augment").map_or("-", |_| "yes");
        let (fix_k, noact_k, lambdas) = (k(&fix), k(&noact), lambdas(&fix));
        text += &format!("{world:18}  k = {fix_k:<5}  {augments:9}  k = {noact_k:<7}  {lambdas}\n");
    }
    Ok(text + FURTHER_SETTINGS)
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
pub fn settings_with_sources(choice: Choice, sets: &[String]) -> Result<String, Usage> {
    // Shows what the preset asks for on any machine, whatever memory is free at this moment.
    let machine = Machine {
        memory_bytes: u64::MAX,
        ..Machine::detect()
    };
    let flags = Flags {
        sets: sets.to_vec(),
        ..Flags::default()
    };
    let config = Source::Presets(choice).resolve(&flags, &machine)?;
    let world = choice.world;
    let mut sources = BTreeMap::new();
    for layer in choice.layers() {
        record_sources(&layer, &world.without_library().to_string(), &mut sources);
    }
    for (path, _) in sets.iter().filter_map(|it| it.split_once('=')) {
        sources.insert(path.trim().to_owned(), "--set".to_owned());
    }
    let mut text = format!(
        "# {} in {world}, preset {}: every setting and its source. `driml train --config` takes this file.\n",
        choice.agent.name, choice.preset.name
    );
    write_table(&config.to_table(), "", &sources, &mut text);
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
        let setting = format!("{key} = {value}");
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
        let how = match part.worlds.is_empty() {
            true => "",
            false => ", by world",
        };
        for (path, comment) in comments(&part.text) {
            let source = format!("{comment} [{}{how}]", layer.path);
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

    #[test]
    fn a_game_s_own_choice_is_named_as_such() {
        let choice = Choice::new(Some("paper"), Some("bigfish"), Some("driml-fix")).unwrap();
        let text = settings_with_sources(choice, &[]).unwrap();
        let mut lines = text.lines();
        let horizon = lines.find(|line| line.starts_with("horizon")).unwrap();
        assert!(
            horizon.contains("k = 5") && horizon.ends_with("# paper [agent/driml-fix, by world]"),
            "{horizon}"
        );
        assert!(text.contains("augment = "), "{text}");
        let set = "run.horizon={ rule = \"fixed\", k = 3 }".to_owned();
        let text = settings_with_sources(choice, &[set]).unwrap();
        let mut lines = text.lines();
        assert!(lines.any(|line| line.contains("k = 3") && line.ends_with("# --set")));
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
