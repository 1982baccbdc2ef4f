//! `driml` with a custom world and auxiliary loss: `cargo run --release -p driml-examples -- train --env island --agent predictive`.
//! The additions are in two files beside this one; the project itself is unchanged. Your own package looks the same, with git dependencies
//! on the crates. The launcher starts every process from this same program, so all have both additions.

mod island;
mod prediction;

use std::process::ExitCode;

use driml::Registry;

fn main() -> ExitCode {
    let registry = Registry::default()
        .world::<island::IslandConfig>("island", include_str!("island.toml"))
        .loss(&prediction::PREDICTION)
        .agent(
            "predictive",
            "features that predict those of the next state",
            include_str!("predictive.toml"),
        );
    driml::main_with(registry)
}
