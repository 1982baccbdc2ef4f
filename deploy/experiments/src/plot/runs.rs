//! Reads a run's folder for a plot: the columns of `metrics.csv`, and the settings without the seed.
//! This module does not judge any value.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
};

use anyhow::ensure;
use driml_launch::run_folder::{RunFolder, Table};
use driml_machine::error::{Usage, did_you_mean, usage};
use driml_settings::leaves;

/// The column with the standard deviation of k; runs recorded by older programs lack it.
pub(super) const SD_OF_K: &str = "sd_k";
/// The columns right before and right after those of the auxiliary losses.
pub(super) const C51_LOSS: &str = "c51_kl";
const TOTAL_LOSS: &str = "total_loss";
/// Short names of columns, which `--column` accepts.
pub(super) const SHORT_NAMES: [(&str, &str); 4] = [
    ("return", "mean_return"),
    ("loss", C51_LOSS),
    ("k", "mean_k"),
    ("speed", "frames_per_second"),
];
/// The columns of `metrics.csv` that hold words instead of numbers.
const TEXTS: [&str; 1] = ["waiting"];

/// The beginnings of the names of settings that do not influence what is learned. Time-outs, which end in `_ms`, do not either.
const OF_MACHINE: &str = "local. transport. learner.checkpoint_period_updates learner.checkpoints_kept actor.world_threads \
                          replay.capacity_transitions replay.compressed_bytes_max";

/// Settings as text, by their full dotted names.
pub(crate) type Settings = BTreeMap<String, String>;

#[derive(Debug)]
pub(crate) struct Run {
    pub(super) folder: RunFolder,
    pub(super) name: String,
    /// World and agent, if the settings can be read.
    pub(super) world_agent: Option<String>,
    pub(super) seed: Option<i64>,
    /// The settings without the seed and without those that depend on the machine; `None` if they cannot be read.
    pub(crate) settings: Option<Settings>,
    /// How many transitions of the run its replay can hold; `None` if the settings cannot be read.
    pub(super) replay_held: Option<i64>,
    /// The metrics and the evaluations of the run's checkpoints, with their files. Both have the columns `frames`, `updates`, `seconds`.
    tables: [(PathBuf, Table); 2],
}

impl Run {
    pub(crate) fn read(folder: &RunFolder) -> anyhow::Result<Self> {
        Self::read_comparing(folder, &[])
    }

    /// Reads a run whose settings `compared` distinguish it from others, although they depend on the machine.
    pub(super) fn read_comparing(folder: &RunFolder, compared: &[String]) -> anyhow::Result<Self> {
        let path = folder.metrics();
        let metrics = Table::read(&path)?;
        ensure!(
            metrics.column_index("frames").is_some(),
            usage!(
                "{} has no column \"frames\": it is not a run's",
                path.display()
            )
        );
        let evaluations = folder.evaluations();
        let evaluated = Table::read(&evaluations)?;
        let config = std::fs::read_to_string(folder.config()).ok();
        let replay_held = config.as_deref().and_then(replay_held);
        let (settings, seed) = config.and_then(|it| read_settings(&it, compared)).unzip();
        let word = |name: &str| settings.as_ref()?.get(name);
        let world_agent = word("run.world").zip(word("run.agent"));
        let world_agent = world_agent.map(|(world, agent)| format!("{world} {agent}"));
        Ok(Self {
            name: folder_name(folder.path()),
            world_agent,
            settings,
            replay_held,
            seed: seed.flatten(),
            folder: folder.clone(),
            tables: [(path, metrics), (evaluations, evaluated)],
        })
    }

    /// Returns the values (x, y) of a column over the column `x`, sorted by x. Rows without a value are left out.
    ///
    /// Rows with the same x become one point, their mean: a row is written each second, and a second may bring no new frame.
    pub(crate) fn values(&self, x: &str, column: &str) -> Result<Vec<(f64, f64)>, Usage> {
        let (path, table) = self.table_of(column);
        let x = self.column_index(table, x)?;
        let place = self.column_index(table, column)?;
        let mut values = Vec::new();
        let path = path.display();
        for (line, row) in (2..).zip(&table.rows) {
            let number = |text: &str| {
                let number = text.parse::<f64>();
                number.map_err(|_| usage!("{path}, row {line}: {text:?} is not numeric"))
            };
            // A cell is empty if its value was not known yet.
            if !row[place].is_empty() && !row[x].is_empty() {
                values.push((number(&row[x])?, number(&row[place])?));
            }
        }
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mean = |rows: &[(f64, f64)]| {
            let sum: f64 = rows.iter().map(|(_, y)| y).sum();
            (rows[0].0, sum / rows.len() as f64)
        };
        Ok(values.chunk_by(|a, b| a.0 == b.0).map(mean).collect())
    }

    /// Returns the first table that has the column, with its file; the metrics if neither table has the column.
    fn table_of(&self, column: &str) -> &(PathBuf, Table) {
        let has_column = |(_, table): &&(_, Table)| table.column_index(column).is_some();
        let found = self.tables.iter().find(has_column);
        found.unwrap_or(&self.tables[0])
    }

    fn column_index(&self, table: &Table, column: &str) -> Result<usize, Usage> {
        let place = table.column_index(column);
        place.filter(|_| !TEXTS.contains(&column)).ok_or_else(|| {
            let numbers = || {
                let mut seen = BTreeSet::from(TEXTS);
                let all = self.tables.iter().flat_map(|(_, table)| &table.header);
                all.map(String::as_str).filter(move |it| seen.insert(it))
            };
            usage!(
                "{} has no column of numbers {column:?}{}; it has {}",
                self.folder.metrics().display(),
                did_you_mean(column, numbers().chain(SHORT_NAMES.map(|it| it.0))),
                numbers().collect::<Vec<_>>().join(", ")
            )
        })
    }

    /// Returns the columns of auxiliary losses: the columns between the C51 loss and the total loss.
    pub(super) fn auxiliary_losses(&self) -> &[String] {
        let metrics = &self.tables[0].1;
        match [C51_LOSS, TOTAL_LOSS].map(|name| metrics.column_index(name)) {
            [Some(first), Some(last)] if first < last => &metrics.header[first + 1..last],
            _ => &[],
        }
    }

    pub(crate) fn has_values(&self, column: &str) -> bool {
        let (_, table) = self.table_of(column);
        let place = table.column_index(column);
        place.is_some_and(|place| table.rows.iter().any(|row| !row[place].is_empty()))
    }
}

pub(super) fn folder_name(folder: &Path) -> String {
    let whole = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let name = whole.file_name().unwrap_or(folder.as_os_str());
    name.to_string_lossy().into_owned()
}

fn replay_held(config: &str) -> Option<i64> {
    let table: toml::Table = config.parse().ok()?;
    let number = |name: &str| table.get("replay")?.get(name)?.as_integer();
    Some(number("capacity_transitions")?.min(number("transitions_max")?))
}

/// Returns the settings of a run's `config.toml` without the seed and without those that depend on the machine, unless they are
/// `compared`; and the seed. A run without settings is not grouped with others.
pub(crate) fn read_settings(config: &str, compared: &[String]) -> Option<(Settings, Option<i64>)> {
    let table: toml::Table = config.parse().ok()?;
    table.get("run")?.as_table()?;
    let mut all = flatten(&table);
    let seed = all.remove("run.seed").and_then(|seed| seed.parse().ok());
    // Most launch settings depend on the machine, but the number of actors influences what is learned.
    if let Some(actors) = all.remove("local.actors") {
        all.insert("actors".into(), actors);
    }
    all.retain(|name, _| {
        let is_in = |prefix: &str| name.starts_with(prefix);
        let is_of_machine = name.ends_with("_ms") || OF_MACHINE.split(' ').any(is_in);
        compared.iter().any(|it| is_in(it)) || !is_of_machine
    });
    Some((all, seed))
}

pub(super) fn flatten(table: &toml::Table) -> Settings {
    let text = |it: &toml::Value| it.as_str().map_or_else(|| it.to_string(), str::to_owned);
    let all = leaves(table).into_iter();
    all.map(|(name, value)| (name, text(value))).collect()
}
