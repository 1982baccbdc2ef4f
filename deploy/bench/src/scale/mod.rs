//! More and more actors on one machine: what is stored and served, how long each waits, how old the weights are that act.
//! `open` and `closed` have synthetic clients that speak through the real delivery, weights and batch source; `processes` has
//! whole runs.

mod cases;
mod closed;
mod open;
mod processes;
mod servers;
mod synthetic;

use crate::{
    flags::{BenchScaleArgs, ScaleCase},
    measurements::{self, MachineNote},
};

/// Measures the cases that are asked for, all if none is, and reports.
///
/// # Errors
/// An engine that cannot be had, a server that does not answer, a run that failed, a file that cannot be written.
pub(super) fn run(args: &BenchScaleArgs, machine: MachineNote) -> anyhow::Result<()> {
    let cases = match args.case.as_slice() {
        [] => &[ScaleCase::Open, ScaleCase::Closed, ScaleCase::Processes][..],
        cases => cases,
    };
    let (mut figures, mut text) = (Vec::new(), String::new());
    for case in cases {
        let (title, table) = match case {
            ScaleCase::Open => (open::TITLE, open::measure(args)?),
            ScaleCase::Closed => (closed::TITLE, closed::measure(args)?),
            ScaleCase::Processes => (processes::TITLE, processes::measure(args)?),
        };
        text.push_str(&format!("{title}\n{}\n", table.text()));
        figures.extend(table.figures);
    }
    measurements::report_as("scale", &figures, &text, machine, &args.flags)
}
