//! A run's folder as a plot needs it: the columns of `metrics.csv`, and the settings without the seed.
//! It judges no value.

use std::path::Path;

use anyhow::Context;
use driml_launch::run_folder::{Columns, RunFolder};
use driml_machine::error::{Usage, nearest, usage};
use driml_settings::renamed;

/// The column with the standard deviation of k; runs recorded by older programs lack it.
pub(super) const SPREAD_OF_K: &str = "sd_k";
/// The column before those of the auxiliary losses, and the one after them.
pub(super) const C51_LOSS: &str = "c51_kl";
const TOTAL_LOSS: &str = "total_loss";
/// Columns of `metrics.csv` that hold words.
const WORDS: [&str; 1] = ["waiting"];

/// The metrics of one run, and its settings.
#[derive(Debug)]
pub(crate) struct Run {
    folder: RunFolder,
    /// The folder's name.
    pub(super) name: String,
    /// World and agent, if the settings say.
    pub(super) what: Option<String>,
    /// The settings without seed and without what the machine decides; none if there are none.
    pub(super) settings: Option<toml::Table>,
    columns: Columns,
    /// The place of the column `frames`.
    frames: usize,
}

impl Run {
    /// Reads a run's folder.
    ///
    /// # Errors
    /// A folder without `metrics.csv`, or with one that is no run's.
    pub(crate) fn read(folder: &RunFolder) -> anyhow::Result<Self> {
        let path = folder.metrics();
        let text = std::fs::read(&path)
            .map_err(|e| usage!("{} is not the folder of a run: {e}", folder.display()))?;
        let columns =
            Columns::parse(&text).with_context(|| format!("reading {}", path.display()))?;
        let frames = columns.place("frames").ok_or_else(|| {
            usage!(
                "{} has no column \"frames\": it is no run's",
                path.display()
            )
        })?;
        let settings = settings(&folder.config());
        let run = settings.as_ref().and_then(|table| table.get("run"));
        let word = |key: &str| run.and_then(|run| run.get(key)?.as_str());
        Ok(Self {
            name: folder_name(folder.path()),
            what: word("world")
                .zip(word("agent"))
                .map(|(world, agent)| format!("{world} {agent}")),
            settings,
            folder: folder.clone(),
            columns,
            frames,
        })
    }

    /// The values of a column over frames; rows without a value are left out.
    ///
    /// # Errors
    /// A column that is not there, or holds words.
    pub(crate) fn values(&self, column: &str) -> Result<Vec<(f64, f64)>, Usage> {
        self.values_over(self.frames, column)
    }

    /// The values of a column over the seconds of the run; rows without a value are left out.
    ///
    /// # Errors
    /// As for [`Run::values`], and metrics without seconds.
    pub(crate) fn values_over_seconds(&self, column: &str) -> Result<Vec<(f64, f64)>, Usage> {
        let path = self.folder.metrics();
        let seconds = self.columns.place("seconds");
        let seconds =
            seconds.ok_or_else(|| usage!("{} has no column \"seconds\"", path.display()))?;
        self.values_over(seconds, column)
    }

    /// The values of a column over those in the column at `x`.
    fn values_over(&self, x: usize, column: &str) -> Result<Vec<(f64, f64)>, Usage> {
        let place = self.columns.place(column);
        let path = self.folder.metrics();
        let place = place.filter(|_| !WORDS.contains(&column)).ok_or_else(|| {
            let numbers = || {
                let all = self.columns.header.iter().map(String::as_str);
                all.filter(|name| !WORDS.contains(name))
            };
            usage!(
                "{} has no column {column:?}{}; it has {}",
                path.display(),
                nearest(column, numbers()),
                numbers().collect::<Vec<_>>().join(", ")
            )
        })?;
        let mut values = Vec::new();
        for (line, row) in self.columns.rows.iter().enumerate() {
            let number = |text: &str| {
                text.parse::<f64>().map_err(|_| {
                    usage!(
                        "{}, row {}: {text:?} is no number",
                        path.display(),
                        line + 2
                    )
                })
            };
            // What was not known yet at a time is empty.
            if !row[place].is_empty() {
                values.push((number(&row[x])?, number(&row[place])?));
            }
        }
        Ok(values)
    }

    /// The columns of auxiliary losses: those between C51's loss and the total.
    pub(super) fn auxiliary_losses(&self) -> &[String] {
        let place = |name: &str| self.columns.header.iter().position(|it| it == name);
        let between = place(C51_LOSS).zip(place(TOTAL_LOSS));
        between
            .and_then(|(first, last)| self.columns.header.get(first + 1..last))
            .unwrap_or_default()
    }

    /// Whether the column is there and not empty.
    pub(crate) fn has_values(&self, column: &str) -> bool {
        let place = self.columns.place(column);
        place.is_some_and(|place| self.columns.rows.iter().any(|row| !row[place].is_empty()))
    }
}

/// The last part of a folder's path.
pub(super) fn folder_name(folder: &Path) -> String {
    let whole = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let name = whole.file_name().unwrap_or(folder.as_os_str());
    name.to_string_lossy().into_owned()
}

/// Settings without the seed and without what differs between machines alone. A run without settings stands for itself.
fn settings(path: &Path) -> Option<toml::Table> {
    let mut table: toml::Table = std::fs::read_to_string(path).ok()?.parse().ok()?;
    renamed::update(&mut table);
    // The machine decides most of how a run is launched, but what is learned depends on how many actors there are.
    let actors = table
        .remove("local")
        .and_then(|local| local.get("actors").cloned());
    table.extend(actors.map(|actors| ("actors".to_owned(), actors)));
    table.remove("transport");
    table.get_mut("run")?.as_table_mut()?.remove("seed");
    if let Some(actor) = table.get_mut("actor").and_then(toml::Value::as_table_mut) {
        actor.remove("world_threads");
    }
    if let Some(replay) = table.get_mut("replay").and_then(toml::Value::as_table_mut) {
        replay.remove("capacity_transitions");
    }
    Some(table)
}
