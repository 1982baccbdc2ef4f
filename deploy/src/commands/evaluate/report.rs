//! An evaluation for programs: a table of every episode's return, and one JSON object.
//! What a person reads is printed in `mod`.

use std::{
    fs::File,
    io::{self, Write},
};

use clap::ValueEnum;
use driml_launch::{
    evaluate::{Levels, Player},
    run_folder::rounded,
    stats::mean_and_deviation,
};
use serde_json::json;

/// Who played, and the returns of the episodes.
type Played<'a> = (&'a str, Vec<f64>);

pub(super) fn write(mut file: &File, played: &[Played<'_>]) -> io::Result<()> {
    let mut text = "policy,episode,return\n".to_owned();
    for (name, returns) in played {
        for (episode, value) in (1..).zip(returns) {
            text += &format!("{name},{episode},{}\n", rounded(*value));
        }
    }
    file.write_all(text.as_bytes())
}

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
        "epsilon": player.epsilon,
        "policies": policies,
    });
    Ok(serde_json::to_string(&object)? + "\n")
}
