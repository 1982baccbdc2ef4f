//! More and more actors on one machine: what is stored and served, how long each waits, how old the weights are that act.
//! `open` and `closed` have synthetic clients that speak through the real delivery, weights and batch source; `processes` has
//! whole runs.

mod closed;
mod open;
mod processes;
mod servers;
mod synthetic;

use driml_launch::console;

use crate::{
    figures::{self, Figure, MachineNote},
    flags::{BenchScaleArgs, ScaleCase},
    table,
};

/// One case's table, and its figures as JSON has them.
struct Table {
    heads: Vec<String>,
    rows: Vec<Vec<String>>,
    /// What is to be said below it.
    notes: String,
    figures: Vec<Figure>,
}

impl Table {
    fn new(heads: &[&str]) -> Self {
        Self {
            heads: heads.iter().map(|&head| head.to_owned()).collect(),
            rows: Vec::new(),
            notes: String::new(),
            figures: Vec::new(),
        }
    }

    /// Adds a row that is known by its first columns; numbers that are not known have no figure.
    fn add(&mut self, case: &str, known_by: &[String], values: &[Option<f64>]) {
        let mut row = known_by.to_vec();
        row.extend(
            values
                .iter()
                .map(|value| value.map_or("-".into(), table::number)),
        );
        console::line(&format!("  {}", row.join("  ")));
        let names = self.heads.iter().zip(known_by);
        let known_by: Vec<_> = names.map(|(head, it)| format!("{it} {head}")).collect();
        let heads = &self.heads[known_by.len()..];
        for (head, value) in heads.iter().zip(values) {
            let Some(value) = *value else { continue };
            self.figures.push(Figure {
                what: format!("{case}, {}: {head}", known_by.join(", ")),
                value,
                unit: head.clone(),
            });
        }
        self.rows.push(row);
    }

    fn text(&self) -> String {
        let mut rows = vec![self.heads.clone()];
        rows.extend(self.rows.iter().cloned());
        let columns: Vec<_> = (0..self.heads.len()).collect();
        format!("{}{}", table::aligned(&rows, &columns), self.notes)
    }
}

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
    figures::report_as("scale", &figures, &text, machine, &args.flags)
}

/// The numbers of actors to measure: those that were asked for, or `usual`, of which a quick bench takes the first two.
fn actors(args: &BenchScaleArgs, usual: &[u32]) -> Vec<u32> {
    match (args.actors.as_slice(), args.flags.quick) {
        ([], true) => usual[..2].to_vec(),
        ([], false) => usual.to_vec(),
        (asked, _) => asked.to_vec(),
    }
}

/// Seconds for which each number of actors is watched.
fn seconds(args: &BenchScaleArgs) -> f64 {
    if args.flags.quick { 2.0 } else { args.seconds }
}
