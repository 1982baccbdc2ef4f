//! `driml completions` and `driml man`: the command line, as shells and `man` read it.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use clap_complete::{Shell, generate};
use driml_launch::{console::print, output};

const NAME: &str = "driml";

#[derive(Debug, Args)]
pub(crate) struct CompletionsArgs {
    /// Shell
    shell: Shell,
}

#[derive(Debug, Args)]
pub(crate) struct ManArgs {
    /// Folder for the pages, driml.1 and one per command; it is created
    #[arg(value_name = "DIR")]
    out: PathBuf,
}

pub(crate) fn completions(
    args: &CompletionsArgs,
    mut command: clap::Command,
) -> anyhow::Result<()> {
    let mut script = Vec::new();
    generate(args.shell, &mut command, NAME, &mut script);
    print(&String::from_utf8(script).context("the script is not UTF-8")?)
}

pub(crate) fn man(args: &ManArgs, command: clap::Command) -> anyhow::Result<()> {
    output::make_folder("the folder", &args.out)?;
    let written = clap_mangen::generate_to(command, &args.out);
    written.map_err(|e| output::unwritable("the folder", &args.out, e))?;
    print(&format!("{}\n", args.out.join("driml.1").display()))
}
