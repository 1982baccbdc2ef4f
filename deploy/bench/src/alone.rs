//! A bench in a process of its own, with the environment that the launcher gives the processes of a run.
//! It measures nothing itself.

use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use driml_launch::managed_process;
use driml_learner::DeviceName;

use crate::{
    flags::{BenchFlags, Component},
    measurements::{Measurement, Report},
};

/// Runs this program again for one component's figures, those that it gives with the flags `more`. Its progress goes to stderr.
///
/// # Errors
/// A process that could not be started or failed.
pub(super) fn figures(
    component: Component,
    more: &[String],
    flags: &BenchFlags,
    device: DeviceName,
) -> anyhow::Result<Vec<Measurement>> {
    let program = std::env::current_exe().context("finding this program's own file")?;
    let mut command = Command::new(program);
    command
        .args(["bench", component.name(), "--here", "--json", "-"])
        .args(["--threads", &flags.threads.to_string()])
        .args(more)
        .args(flags.quick.then_some("--quick"))
        .args(
            flags
                .precision
                .iter()
                .flat_map(|precision| ["--precision", precision.name()]),
        )
        .args(match device {
            DeviceName::Cpu => Vec::new(),
            gpu => vec!["--device".to_owned(), gpu.to_string()],
        })
        .stdin(Stdio::null())
        .stderr(Stdio::inherit());
    managed_process::set_thread_env(&mut command, flags.threads);
    let doing = || format!("measuring the {}", component.name());
    let output = command.output().with_context(doing)?;
    ensure!(
        output.status.success(),
        "{} failed: {}",
        doing(),
        output.status
    );
    let report: Report = serde_json::from_slice(&output.stdout).with_context(doing)?;
    Ok(report.figures)
}
