//! The input and the figures of a bench, as a table and as JSON, with the machine on which it ran.
//! This file measures nothing and compares nothing.

use std::path::Path;

use anyhow::Context;
use driml_launch::console::{self, align_columns, print};
use driml_learner::Precision;
use driml_machine::{
    resources::MachineInfo,
    speed_meter::{SpeedMeter, median},
    units::format_number,
};
use serde::{Deserialize, Serialize};

use crate::flags::BenchFlags;

pub(super) struct Bench<'a> {
    pub(super) flags: &'a BenchFlags,
    pub(super) meter: SpeedMeter,
    pub(super) figures: Figures,
    /// A table that is printed instead of one row per figure.
    pub(super) table: Option<String>,
}

impl Bench<'_> {
    /// Records a figure in a precision, which its name ends with if it is not f32.
    pub(super) fn record(&mut self, what: &str, precision: Precision, value: f64, unit: &str) {
        let what = match precision {
            Precision::F32 => what.to_owned(),
            other => format!("{what}, {other}"),
        };
        self.figures.record(what, value, unit);
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measurement {
    /// What was measured; unique in its bench.
    pub(super) what: String,
    pub(super) value: f64,
    /// The unit, such as `updates/s`.
    pub(super) unit: String,
}

/// The figures of a bench, each with its values in the order of the rounds.
#[derive(Debug, Default)]
pub(super) struct Figures(Vec<(Measurement, Vec<f64>)>);

impl Figures {
    /// Adds a figure, or its value in another round, and prints it to stderr at once.
    pub(super) fn record(&mut self, what: impl Into<String>, value: f64, unit: &str) {
        let (what, unit) = (what.into(), unit.to_owned());
        console::eprintln(&format!("  {what}: {} {unit}", format_number(value)));
        self.add(Measurement { what, value, unit });
    }

    pub(super) fn add(&mut self, figure: Measurement) {
        match self.0.iter_mut().find(|(it, _)| it.what == figure.what) {
            Some((_, values)) => values.push(figure.value),
            None => self.0.push((figure.clone(), vec![figure.value])),
        }
    }

    /// Returns a figure's values and its unit; `None` if it was not measured.
    pub(super) fn values_of(&self, what: &str) -> Option<(&[f64], &str)> {
        let (figure, values) = self.0.iter().find(|(it, _)| it.what == what)?;
        Some((&values[..], figure.unit.as_str()))
    }

    pub(super) fn medians(self) -> Vec<Measurement> {
        let median_of = |(figure, values): (Measurement, Vec<f64>)| Measurement {
            value: median(&values),
            ..figure
        };
        self.0.into_iter().map(median_of).collect()
    }
}

/// The JSON output of a bench.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Report {
    pub(super) bench: String,
    pub(super) quick: bool,
    pub(super) threads: u32,
    /// The machine, as it was before the first measurement.
    pub(super) machine: MachineInfo,
    pub(super) figures: Vec<Measurement>,
}

impl Report {
    /// Returns the figures as rows of three fields, separated by blanks: value, unit, and as the rest of the line what was measured.
    pub(super) fn rows(&self) -> String {
        let row =
            |it: &Measurement| vec![format_number(it.value), it.unit.clone(), it.what.clone()];
        align_columns(&self.figures.iter().map(row).collect::<Vec<_>>(), &[0])
    }
}

/// Prints `table` and writes `report` to the file `json`. If `json` is `-`, prints only the report.
pub(super) fn publish(
    report: &impl Serialize,
    table: &str,
    json: Option<&Path>,
) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(report).context("writing the figures as JSON")?;
    text.push('\n');
    match json {
        Some(path) if path == Path::new("-") => print(&text),
        Some(path) => {
            print(table)?;
            let written = driml_launch::output::write_file("--json", path, text.as_bytes());
            Ok(written?)
        }
        None => print(table),
    }
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    #[test]
    fn a_report_is_a_table_and_reads_back_as_it_was_written() {
        let mut figures = Figures::default();
        for value in [5.25, 1.0, 9.0] {
            figures.record("C51 + DIM", value, "updates/s");
        }
        figures.record("32 rows: 1.20 GFLOP", 61_234.5, "GFLOP/s");
        let report = Report {
            bench: "learner".into(),
            quick: true,
            threads: 2,
            machine: MachineInfo::detect(None),
            figures: figures.medians(),
        };
        expect![[r#"
             5.25  updates/s  C51 + DIM
            61234  GFLOP/s    32 rows: 1.20 GFLOP
        "#]]
        .assert_eq(&report.rows());
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("figures.json");
        publish(&report, "", Some(&file)).unwrap();
        let read: Report = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        assert_eq!(read, report);
    }
}
