//! `driml doctor`: what this machine can do and what it lacks.

use std::path::PathBuf;

use clap::Args;
use driml_launch::console::{print, print_wrapped};
use driml_machine::doctor;

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// Folder of the runs, whose disk is checked
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub(crate) run_dir: PathBuf,
    /// Check the certificates in DIR: roles, validity, addresses and dates
    #[arg(long, value_name = "DIR")]
    pub(crate) tls_dir: Option<PathBuf>,
    /// Also exit with code 1 if --device cuda cannot work
    #[arg(long)]
    pub(crate) cuda: bool,
    /// Print JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    let report = doctor::examine(&args.run_dir, args.tls_dir.as_deref());
    match args.json {
        true => print(&report.json()?)?,
        // To where the columns of state and name end.
        false => print_wrapped(&report.describe(), 27)?,
    }
    report.check(args.cuda)
}
