//! An evaluation for programs: a table of every episode's return, and one JSON object.
//! What a person reads is printed in `mod`.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use anyhow::Context;
use clap::ValueEnum;
use driml_launch::{
    evaluate::{Levels, Player},
    run_folder::rounded,
    stats::mean_and_deviation,
};
use serde_json::json;

/// Who played, and the returns of the episodes.
type Played<'a> = (&'a str, Vec<f64>);

/// A file of returns.
pub(super) struct Table {
    path: PathBuf,
    file: BufWriter<File>,
}

impl Table {
    /// Makes the file, so that one that cannot be made is known before anything is played.
    pub(super) fn begin(path: &Path) -> anyhow::Result<Self> {
        let file = File::create(path).with_context(|| format!("--returns {}", path.display()))?;
        Ok(Self {
            path: path.to_owned(),
            file: BufWriter::new(file),
        })
    }

    /// Writes all returns.
    pub(super) fn finish(&mut self, played: &[Played<'_>]) -> anyhow::Result<()> {
        self.write(played)
            .with_context(|| format!("writing {}", self.path.display()))
    }

    fn write(&mut self, played: &[Played<'_>]) -> std::io::Result<()> {
        writeln!(self.file, "policy,episode,return")?;
        for (name, returns) in played {
            for (episode, value) in (1..).zip(returns) {
                writeln!(self.file, "{name},{episode},{}", rounded(*value))?;
            }
        }
        self.file.flush()
    }
}

/// The object, on a line of its own.
pub(super) fn json(
    player: &Player,
    levels: Levels,
    seed: u64,
    played: &[Played<'_>],
) -> anyhow::Result<String> {
    let spec = &player.config.run;
    let policies: serde_json::Map<_, _> = played
        .iter()
        .map(|(name, returns)| {
            let (mean, deviation) = mean_and_deviation(returns);
            let of = json!({ "mean_return": mean, "standard_deviation": deviation, "episodes": returns.len() });
            ((*name).to_owned(), of)
        })
        .collect();
    let levels = levels.to_possible_value();
    let object = json!({
        "world": spec.world,
        "agent": spec.agent,
        "updates": player.updates,
        "weights": player.config.learner.publish_as,
        "averaged": player.is_averaged,
        "arithmetic": player.config.actor.precision,
        "levels": levels.map(|it| it.get_name().to_owned()),
        "seed": seed,
        "policies": policies,
    });
    Ok(serde_json::to_string(&object)? + "\n")
}
