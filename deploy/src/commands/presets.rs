//! `driml presets`: lists worlds, agents and presets, or prints all settings of one game and agent with their sources.

use clap::Args;
use driml_launch::console::print;
use driml_machine::error::usage;
use driml_settings::{flags, menu, presets};

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
}

/// Prints the menu, or the settings of a game and an agent as TOML that `driml train --config` accepts.
pub(crate) fn run(args: &PresetsArgs) -> anyhow::Result<()> {
    if args.env.is_none() && args.agent.is_none() && args.preset.is_none() {
        return print(&menu::menu()?);
    }
    let env = args.env.as_deref().unwrap_or(flags::DEFAULT_ENV);
    let world = presets::world(env).map_err(|e| usage!("--env: {e}"))?;
    let preset = presets::preset_or_default(args.preset.as_deref(), world)?;
    let agent = presets::agent(args.agent.as_deref().unwrap_or(flags::DEFAULT_AGENT))?;
    print(&menu::settings_with_sources(preset, world, agent)?)
}
