//! The derived settings, which follow from others: filled in, checked when read back, and known by name.
//! The user cannot set those in `DERIVED` by hand.

use driml_envs::{ActionSet, WorldConfig, WorldName};
use driml_learner::UpdateSettings;
use driml_machine::error::{Usage, usage};
use driml_model::{ConvLayer, FrameSize, InputSize, ModelConfig, Precision, ReadArea, TorsoName};
use serde::de::DeserializeOwned;
use toml::{Table, Value};

use crate::overrides::{explain, find, inline_text, insert, insert_missing, remove};

/// The derived settings: their paths, and from what they follow.
const DERIVED: &str = "\
run.world world.kind world.game world.command world.library: is chosen by --env
run.agent: is chosen by --agent
run.frame_height run.frame_width: follows from the world and what the torso reads
run.num_actions model.num_actions: follows from the world and actor.actions
run.frame_channels input.frame: follows from the world
model.height: follows from input.height and what the torso reads
model.width: follows from input.width and what the torso reads
model.input_channels: follows from the world and run.frame_stack
model.dim model.loss_layers: follows from learner.update";

/// Each path in [`DERIVED`], and from what it follows.
fn derived_settings() -> impl Iterator<Item = (&'static str, &'static str)> {
    let lines = DERIVED.lines().filter_map(|line| line.split_once(": "));
    lines.flat_map(|(paths, how)| paths.split(' ').map(move |path| (path, how)))
}

/// The settings that follow from others unless they are set by hand: the number of actors on the epsilon ladder, the visible action to
/// which each action amounts, and the updates over which beta rises.
const FOLLOWING: &str =
    "actor.epsilon_ladder.actors learner.affinity.visible replay.sampling.beta_updates";

/// Removes the settings that only follow from others, so that they follow from changed ones too.
pub(crate) fn remove_following(table: &mut Table) -> Result<(), Usage> {
    for path in FOLLOWING.split(' ') {
        let mut filled = table.clone();
        let is = remove(&mut filled, path);
        fill_in_derived(&mut filled)?;
        if is.is_some() && find(&filled, path) == is.as_ref() {
            remove(table, path);
        }
    }
    Ok(())
}

/// The path of a whole frame's size, which is set if frames are cut to what the network reads. Settings of earlier versions lack it, and
/// their runs keep whole frames.
pub(crate) const FRAME_PATH: &str = "input.frame";

/// Asks a world that runs in its own process for its declaration, and fills in its shapes, actions and input size.
pub(crate) fn fill_in_declaration(table: &mut Table, command: &str) -> Result<(), Usage> {
    let limits = ["world.start_timeout_ms", "world.step_timeout_ms"];
    let [start_ms, step_ms] = limits.map(|limit| read(table, limit));
    let declared = driml_envs::probe_exec_command(command, start_ms?, step_ms?);
    let declared = declared.map_err(|e| usage!("--env: {e}"))?;
    insert_missing(table, "input.height", (declared.height as i64).into());
    insert_missing(table, "input.width", (declared.width as i64).into());
    insert(table, "world", as_toml(declared));
    Ok(())
}

/// Replaces each precision `auto`: by bf16 if the processor is faster in it and does the computing, else by f32.
pub(crate) fn resolve_precision(table: &mut Table, fast_bf16: bool) -> Result<(), Usage> {
    let device = find(table, "local.learner_device").and_then(Value::as_str);
    let on_cpu = device.is_none_or(|device| device == "cpu");
    for (path, fast) in [
        ("actor.precision", fast_bf16),
        ("learner.precision", fast_bf16 && on_cpu),
    ] {
        match find(table, path).and_then(Value::as_str) {
            Some("auto") => {
                let name = if fast { "bf16" } else { "f32" };
                insert(table, path, Value::String(name.into()));
            }
            Some(name) => {
                let known = name.parse::<Precision>();
                known.map_err(|e| usage!("{path}: {e}, or auto"))?;
            }
            None => {}
        }
    }
    Ok(())
}

/// Removes the presets' settings of torsos other than this network's. Settings that `is_set` by hand stay, so that their check rejects them.
pub(crate) fn drop_other_torsos(
    table: &mut Table,
    is_set: impl Fn(&str) -> bool,
) -> Result<(), Usage> {
    let others = read_torso(table)?.settings_of_others();
    if let Some(model) = table.get_mut("model").and_then(Value::as_table_mut) {
        for key in others {
            if !is_set(&format!("model.{key}")) {
                model.remove(key);
            }
        }
    }
    Ok(())
}

fn read_torso(table: &Table) -> Result<TorsoName, Usage> {
    Ok(read_optional(table, "model.torso")?.unwrap_or(TorsoName::Nature))
}

/// Returns the derived setting that is `path` or a table around it, and from what it follows; `None` if `path` is not derived.
pub(crate) fn find_derived(path: &str) -> Option<(&'static str, &'static str)> {
    let inside = |known: &str| {
        let rest = path.strip_prefix(known);
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    derived_settings().find(|(known, _)| inside(known))
}

pub(crate) fn fill_in_derived(table: &mut Table) -> Result<(), Usage> {
    let world = find(table, "run.world").and_then(Value::as_str);
    let world = world.ok_or_else(|| missing("run.world, a word"))?.parse();
    let world: WorldName = world.map_err(|e| usage!("run.world: {e}"))?;
    insert(table, "world.kind", Value::String(world.kind().into()));
    for (key, value) in world.settings() {
        insert(table, &format!("world.{key}"), Value::String(value.into()));
    }
    let config: WorldConfig = read(table, "world")?;
    let update: UpdateSettings = read(table, "learner.update")?;
    let shape = config.frame_shape();
    let frame = (shape.height, shape.width);
    let input = (read(table, "input.height")?, read(table, "input.width")?);
    let mut area = ReadArea { input, frame };
    if find(table, FRAME_PATH).is_some() {
        let (height, width) = (shape.height as u32, shape.width as u32);
        insert(table, FRAME_PATH, as_toml(FrameSize { height, width }));
        // Augmentation crops the frame and reads the borders too.
        if find(table, "learner.augment").is_none() {
            let input: InputSize = read(table, "input")?;
            let conv: Option<Vec<ConvLayer>> = read_optional(table, "model.conv")?;
            area = input.read_area(read_torso(table)?, &conv.unwrap_or_default(), frame);
        }
    }
    let set = read_optional(table, "actor.actions")?.unwrap_or(ActionSet::All);
    let num_actions = config.actions(set).len();
    let stack: u32 = read(table, "run.frame_stack")?;
    let size = |value: usize| Value::Integer(value as i64);
    let channels = i64::from(stack).saturating_mul(shape.channels as i64);
    for (path, value) in [
        ("run.frame_height", size(area.frame.0)),
        ("run.frame_width", size(area.frame.1)),
        ("run.frame_channels", size(shape.channels)),
        ("run.num_actions", size(num_actions)),
        ("model.height", size(area.input.0)),
        ("model.width", size(area.input.1)),
        ("model.input_channels", Value::Integer(channels)),
        ("model.num_actions", size(num_actions)),
        ("model.dim", as_toml(update.dim_heads(num_actions))),
    ] {
        insert(table, path, value);
    }
    fill_in_loss_layers(table, &update);
    let (ladder_actors, visible) = (ladder_actors(table), visible_actions(table, &config, set));
    let values = [ladder_actors, visible, beta_updates(table)];
    for (path, value) in FOLLOWING.split(' ').zip(values) {
        if let Some(value) = value {
            insert_missing(table, path, value);
        }
    }
    Ok(())
}

/// Fills in the layers of the auxiliary loss, if it has any. If the model or the loss is invalid, later checks report why.
fn fill_in_loss_layers(table: &mut Table, update: &UpdateSettings) {
    if let Ok(model) = read::<ModelConfig>(table, "model")
        && let Ok(loss) = update.make_auxiliary_loss()
    {
        let layers: Vec<_> = loss.layers(&model).into_iter().map(as_toml).collect();
        match table.get_mut("model").and_then(Value::as_table_mut) {
            Some(model) if layers.is_empty() => _ = model.remove("loss_layers"),
            _ => insert(table, "model.loss_layers", layers.into()),
        }
    }
}

/// The actors of the run, if there is an epsilon ladder.
fn ladder_actors(table: &Table) -> Option<Value> {
    find(table, "actor.epsilon_ladder")?.as_table()?;
    find(table, "local.actors").cloned()
}

/// The updates of the whole run, if rows are drawn by priority.
fn beta_updates(table: &Table) -> Option<Value> {
    if find(table, "replay.sampling.rule")?.as_str()? != "prioritised" {
        return None;
    }
    let number = |path| read_optional::<f64>(table, path).ok().flatten();
    let transitions = number("replay.transitions_max")? - number("replay.warmup_transitions")?;
    let rows = transitions * number("replay.replay_ratio")?;
    let updates = rows / number("learner.batch_size")?;
    // If a number is missing or not above 0, its own check reports it.
    let is_number = updates.is_finite() && updates > 0.0;
    is_number.then(|| Value::Integer((updates as i64).max(1)))
}

/// The visible action to which each action amounts, if the affinity's alphabet is `visible`.
fn visible_actions(table: &Table, world: &WorldConfig, set: ActionSet) -> Option<Value> {
    if find(table, "learner.affinity.alphabet")?.as_str()? != "visible" {
        return None;
    }
    let map = match set {
        ActionSet::All => world.visible_actions(),
        // These actions differ already.
        ActionSet::Visible => (0..world.actions(set).len()).map(|it| it as u8).collect(),
    };
    let map: Vec<_> = map.into_iter().map(i64::from).collect();
    Some(map.into())
}

/// Reads the text of a file that driml wrote. An error if a derived setting differs from what follows from the others.
pub(crate) fn parse_file(name: &str, text: &str) -> Result<Table, Usage> {
    let read = text.parse::<Table>();
    let read = read.map_err(|e| {
        let before = e.span().and_then(|it| text.get(..it.start));
        let line = before.unwrap_or_default().matches('\n').count() + 1;
        usage!("{name} is not TOML: line {line}: {}", e.message())
    })?;
    let mut right = read.clone();
    fill_in_derived(&mut right).map_err(|e| usage!("{name}: {e}"))?;
    for (path, how) in derived_settings() {
        let is = find(&right, path);
        if let Some(was) = find(&read, path)
            && is != Some(was)
        {
            return Err(usage!(
                "{name}: {path} = {}, but it {how} and is {}; correct one of the two",
                inline_text(was),
                is.map_or("not there".into(), inline_text)
            ));
        }
    }
    Ok(read)
}

fn as_toml(value: impl serde::Serialize) -> Value {
    Value::try_from(value).expect("settings are numbers, words, lists and tables")
}

fn missing(what: &str) -> Usage {
    usage!("the settings lack {what}: use a config.toml that driml wrote")
}

/// Reads a setting that every run has.
fn read<T: DeserializeOwned>(table: &Table, path: &str) -> Result<T, Usage> {
    read_optional(table, path)?.ok_or_else(|| missing(path))
}

fn read_optional<T: DeserializeOwned>(table: &Table, path: &str) -> Result<Option<T>, Usage> {
    let read = find(table, path).cloned().map(Value::try_into).transpose();
    read.map_err(|e| match find(table, path) {
        Some(Value::Table(_)) => usage!("in the settings' [{path}] table: {}", explain(&e)),
        _ => usage!("{path}: {}", explain(&e)),
    })
}
