//! `driml` with a custom world and a custom auxiliary loss: `cargo run --release -p driml-examples -- local --env island --agent predictive`.
//! What it adds stands in two files beside this one; nothing of the project is changed. A package of yours looks the same, with
//! dependencies on the crates by their git address. The launcher starts every process from this same program, so all know of both.

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
