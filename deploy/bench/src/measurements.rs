//! What a bench found, as a table and as JSON.
//! It measures nothing and compares nothing.

use std::{fs, path::Path};

use anyhow::Context;
use driml_launch::console::{self, print};
use driml_learner::{DeviceName, Precision};
use driml_machine::resources::{self, Machine};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::{flags::BenchFlags, table};

/// One thing that was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measurement {
    /// What, unique in its bench.
    pub(super) what: String,
    /// How much of the unit.
    pub(super) value: f64,
    /// The unit, such as `updates/s`.
    pub(super) unit: String,
}

impl Measurement {
    /// A figure, which is printed to stderr at once.
    pub(super) fn found(what: impl Into<String>, value: f64, unit: &str) -> Self {
        let (what, unit) = (what.into(), unit.to_owned());
        console::line(&format!("  {what}: {} {unit}", table::number(value)));
        Self { what, value, unit }
    }
}

/// The machine that measured, as far as figures depend on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct MachineNote {
    /// The processor's name.
    pub(super) processor: String,
    /// Cores that this process may use.
    pub(super) cores: u32,
    /// Mean number of tasks that wanted a core in the minute before.
    pub(super) load: f64,
    /// The GPU that computed, with its memory; none if the processor did.
    #[serde(default)]
    pub(super) gpu: Option<String>,
}

impl MachineNote {
    /// What this machine is, and how busy it is now.
    pub(super) fn this() -> Self {
        Self {
            processor: resources::processor(),
            cores: Machine::this().cores,
            load: load(&fs::read_to_string("/proc/loadavg").unwrap_or_default()).unwrap_or(0.0),
            gpu: None,
        }
    }

    /// The same, of figures that were computed on `device`.
    pub(super) fn computing_on(&self, device: DeviceName) -> Self {
        let gpu = match device {
            DeviceName::Cpu => None,
            #[cfg(not(feature = "cuda"))]
            DeviceName::Cuda(_) => None,
            #[cfg(feature = "cuda")]
            DeviceName::Cuda(ordinal) => Some(driml_machine::doctor::cuda::name(ordinal)),
        };
        Self {
            gpu,
            ..self.clone()
        }
    }
}

/// What is computed, and in which precision if it is not f32.
pub(super) fn named(what: impl Into<String>, precision: Precision) -> String {
    let what = what.into();
    match precision {
        Precision::F32 => what,
        other => format!("{what}, {other}"),
    }
}

/// The mean over the last minute in the kernel's table.
fn load(loadavg: &str) -> Option<f64> {
    loadavg.split_whitespace().next()?.parse().ok()
}

/// A bench's figures as JSON has them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Report {
    /// The name of the bench that measured.
    pub(super) bench: String,
    /// Whether it took a few iterations only.
    pub(super) quick: bool,
    /// Threads for arithmetic.
    pub(super) threads: u32,
    /// Where, as it was before the first measurement.
    pub(super) machine: MachineNote,
    /// What was found.
    pub(super) figures: Vec<Measurement>,
}

/// The figures as rows of three fields, which blanks part: value, unit, and all the rest of the line what was measured.
fn rows(figures: &[Measurement]) -> String {
    let rows = figures
        .iter()
        .map(|it| vec![table::number(it.value), it.unit.clone(), it.what.clone()]);
    table::aligned(&rows.collect::<Vec<_>>(), &[0])
}

/// Prints the figures as a table, or writes them as the flags ask for.
///
/// # Errors
/// A file that cannot be written.
pub(super) fn report(
    bench: &str,
    figures: &[Measurement],
    machine: MachineNote,
    flags: &BenchFlags,
) -> anyhow::Result<()> {
    report_as(bench, figures, &rows(figures), machine, flags)
}

/// [`report`] with another table.
///
/// # Errors
/// As there.
pub(super) fn report_as(
    bench: &str,
    figures: &[Measurement],
    table: &str,
    machine: MachineNote,
    flags: &BenchFlags,
) -> anyhow::Result<()> {
    let report = Report {
        bench: bench.to_owned(),
        quick: flags.quick,
        threads: flags.threads,
        machine,
        figures: figures.to_vec(),
    };
    publish(&report, table, flags.json.as_deref())
}

/// Prints `table` and writes `report` to `json`; to stdout, alone, if that is `-`.
///
/// # Errors
/// A file that cannot be written.
pub(super) fn publish(
    report: &(impl Serialize + DeserializeOwned),
    table: &str,
    json: Option<&Path>,
) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(report).context("writing the figures as JSON")?;
    text.push('\n');
    match json {
        Some(path) if path == Path::new("-") => print(&text),
        Some(path) => {
            fs::write(path, text).with_context(|| format!("writing {}", path.display()))?;
            print(table)
        }
        None => print(table),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_load_is_described() {
        assert_eq!(load("6.60 5.35 4.10 3/200 1234"), Some(6.6));
    }

    #[test]
    fn a_row_is_read_back_by_its_blanks() {
        let figures = [
            ("C51 + local-local DIM, 64x64x3", 5.25, "updates/s"),
            ("32 rows: 1.20 GFLOP, arithmetic", 61_234.0, "GFLOP/s"),
            ("learner", 0.5, "%"),
        ]
        .map(|(what, value, unit)| Measurement {
            what: what.into(),
            value,
            unit: unit.into(),
        });
        let text = rows(&figures);
        let read = text.lines().map(|line| {
            let words: Vec<_> = line.split_whitespace().collect();
            Measurement {
                what: words[2..].join(" "),
                value: words[0].parse().unwrap(),
                unit: words[1].into(),
            }
        });
        assert_eq!(read.collect::<Vec<_>>(), figures, "{text}");
    }

    #[test]
    fn a_report_reads_back_as_it_was_written() {
        let report = Report {
            bench: "learner".into(),
            quick: true,
            threads: 2,
            machine: MachineNote::this(),
            figures: vec![Measurement::found("an update", 5.25, "updates/s")],
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("figures.json");
        publish(&report, "", Some(&file)).unwrap();
        let read: Report = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
        assert_eq!(read, report);
    }
}
