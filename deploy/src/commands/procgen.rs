//! `driml procgen`: Procgen's engine.

use clap::Subcommand;
use driml_launch::console::{self, print};

#[derive(Debug, Subcommand)]
pub(crate) enum ProcgenCommand {
    /// Download the engine into the cache folder (DRIML_CACHE, else the user's)
    Install,
}

pub(crate) fn run(command: &ProcgenCommand) -> anyhow::Result<()> {
    match command {
        ProcgenCommand::Install => {
            let engine = procgen_sys::Engine::install(&mut console::eprintln)?;
            let library = engine.library().display();
            print(&format!("procgen's engine is {library}\n"))
        }
    }
}
