//! `driml parity`: compares the learner's arithmetic with updates that were computed elsewhere in float64.

use std::path::PathBuf;

use clap::Args;
use driml_launch::console::{describe_error, print};
use driml_learner::{Kernels, Precision, UpdateError};
use driml_machine::{
    device::{DeviceFlag, check_device},
    error::usage,
    units::count,
};

#[derive(Debug, Args)]
pub(crate) struct ParityArgs {
    /// Case files (safetensors)
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
    /// Precision of products
    #[arg(long, value_name = "PRECISION", default_value_t = Precision::F32, conflicts_with = "stock")]
    pub(crate) precision: Precision,
    /// Use candle's operations, as on a GPU, instead of this project's kernels
    #[arg(long)]
    pub(crate) stock: bool,
}

/// Checks each file and prints what differs. A file that is not a case is a wrong call; a failed or wrong update is an error.
pub(crate) fn run(args: &ParityArgs) -> anyhow::Result<()> {
    check_device(args.on.device)?;
    let mut failed = 0;
    let mut compute = args.on.device.open(args.precision)?;
    if args.stock {
        compute.kernels = Kernels::Candle;
    }
    for file in &args.files {
        let checked = driml_learner::parity::check_file(file, &compute);
        let report = checked.map_err(|e| match e.downcast_ref() {
            Some(
                UpdateError::NonFinite(_) | UpdateError::Diverged { .. } | UpdateError::Tensor(_),
            ) => e,
            _ => usage!("{}", describe_error(&e)).into(),
        })?;
        print(&report.to_string())?;
        failed += usize::from(!report.passed());
    }
    let all = args.files.len();
    anyhow::ensure!(failed == 0, "files out of tolerance: {failed} of {all}");
    print(&format!("within tolerance: {}\n", count(all, "file")))
}
