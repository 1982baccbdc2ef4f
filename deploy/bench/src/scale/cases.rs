//! What the cases share: their table, and how much of each is measured.

use driml_launch::console;

use crate::{flags::BenchScaleArgs, measurements::Measurement, table};

/// One case's table, and its figures as JSON has them.
pub(super) struct Table {
    pub(super) heads: Vec<String>,
    pub(super) rows: Vec<Vec<String>>,
    /// What is to be said below it.
    pub(super) notes: String,
    pub(super) figures: Vec<Measurement>,
}

impl Table {
    pub(super) fn new(heads: &[&str]) -> Self {
        Self {
            heads: heads.iter().map(|&head| head.to_owned()).collect(),
            rows: Vec::new(),
            notes: String::new(),
            figures: Vec::new(),
        }
    }

    /// Adds a row that is known by its first columns; numbers that are not known have no figure.
    pub(super) fn add(&mut self, case: &str, known_by: &[String], values: &[Option<f64>]) {
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
            self.figures.push(Measurement {
                what: format!("{case}, {}: {head}", known_by.join(", ")),
                value,
                unit: head.clone(),
            });
        }
        self.rows.push(row);
    }

    pub(super) fn text(&self) -> String {
        let mut rows = vec![self.heads.clone()];
        rows.extend(self.rows.iter().cloned());
        let columns: Vec<_> = (0..self.heads.len()).collect();
        format!("{}{}", table::aligned(&rows, &columns), self.notes)
    }
}

/// The numbers of actors to measure: those that were asked for, or `usual`, of which a quick bench takes the first two.
pub(super) fn actors(args: &BenchScaleArgs, usual: &[u32]) -> Vec<u32> {
    match (args.actors.as_slice(), args.flags.quick) {
        ([], true) => usual[..2].to_vec(),
        ([], false) => usual.to_vec(),
        (asked, _) => asked.to_vec(),
    }
}

/// Seconds for which each number of actors is watched.
pub(super) fn seconds(args: &BenchScaleArgs) -> f64 {
    if args.flags.quick { 2.0 } else { args.seconds }
}
