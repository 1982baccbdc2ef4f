//! `driml` with a custom world and a custom auxiliary loss: `cargo run --release -p driml-examples -- local --env island --agent slow`.
//! What it adds stands in two files beside this one; nothing of the project is changed. A package of yours looks the same, with
//! dependencies on the crates by their git address. The launcher starts every part from this same program, so all know of both.

mod island;
mod slowness;

use std::process::ExitCode;

fn main() -> ExitCode {
    driml_envs::register::<island::IslandConfig>("island", include_str!("island.toml"));
    driml_learner::auxiliary::register(&slowness::SLOWNESS);
    driml_settings::presets::register_agent(
        "slow",
        "features that change slowly from one state to the next",
        include_str!("slow.toml"),
    );
    driml::main()
}
