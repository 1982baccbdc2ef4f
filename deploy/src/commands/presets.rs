//! `driml presets`: lists worlds, agents and presets, or prints all settings of one game and agent with their sources.

use clap::Args;
use driml_launch::console::{print, print_wrapped};
use driml_settings::{menu, presets::Choice};

#[derive(Debug, Args)]
pub(crate) struct PresetsArgs {
    /// Print the settings for this game of Procgen, or another world [default: coinrun]
    #[arg(long, value_name = "ENV")]
    pub(crate) env: Option<String>,
    /// Print the settings of this agent [default: driml-ada]
    #[arg(long, value_name = "AGENT")]
    pub(crate) agent: Option<String>,
    /// Print the settings of this preset
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
    /// Change one of these settings, as `driml train` does; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) sets: Vec<String>,
}

/// Prints the menu, or the settings of a game and an agent as TOML that `driml train --config` accepts.
pub(crate) fn run(args: &PresetsArgs) -> anyhow::Result<()> {
    let names = [&args.preset, &args.env, &args.agent];
    if names.iter().all(|it| it.is_none()) && args.sets.is_empty() {
        return print_wrapped(&menu::menu()?, 4);
    }
    let [preset, env, agent] = names.map(Option::as_deref);
    let choice = Choice::new(preset, env, agent)?;
    print(&menu::settings_with_sources(choice, &args.sets)?)
}
