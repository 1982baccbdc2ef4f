//! Settings of runs, for tests.

use driml_machine::resources::Machine;
use driml_settings::{
    config::RunConfig,
    presets::preset,
    resolve::{Flags, Source, resolve},
};

pub(crate) const MACHINE: Machine = Machine {
    cores: 2,
    memory_bytes: 64 << 30,
    fast_bf16: false,
};

/// A default of which some fields are `set`.
pub(crate) fn with<T: Default>(set: impl FnOnce(&mut T)) -> T {
    let mut it = T::default();
    set(&mut it);
    it
}

/// The settings of a preset, world and agent, with these `--set`s.
pub(crate) fn config(
    preset_name: &str,
    world: &str,
    agent: &'static str,
    sets: &[&str],
) -> RunConfig {
    let world = world.parse().unwrap();
    let source = Source::Layers(preset(preset_name).unwrap(), world, agent);
    let flags = Flags {
        sets: sets.iter().map(|&set| set.into()).collect(),
        ..Flags::default()
    };
    resolve(&source, &flags, &MACHINE).unwrap()
}
