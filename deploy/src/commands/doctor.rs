//! `driml doctor`: what this machine can do and what it lacks.

use std::path::PathBuf;

use clap::Args;
use driml_launch::console::print;
use driml_machine::doctor;

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// Where runs go: the disk that is looked at
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub(crate) run_dir: PathBuf,
    /// Look also at the certificates in DIR: whose there are, whether they are good, for which addresses and for how long
    #[arg(long, value_name = "DIR")]
    pub(crate) tls_dir: Option<PathBuf>,
    /// Fail also where --device cuda would
    #[arg(long)]
    pub(crate) cuda: bool,
    /// Print the facts as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

/// Prints the facts.
pub(crate) fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    let report = doctor::examine(&args.run_dir, args.tls_dir.as_deref());
    if args.json {
        print(&report.json()?)?;
    } else {
        print(&report.describe())?;
    }
    report.check(args.cuda)
}
