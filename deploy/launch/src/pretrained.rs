//! Networks that are played without a run: each is one file, f16 weights with the run's settings in the metadata. Some are built in.
//! Such a file cannot be trained on: it has neither auxiliary heads nor the state of an optimiser.

use std::{fs, path::Path};

use anyhow::Context;
use driml_learner::{
    Compute,
    checkpoint::{METADATA_KEY, describe, read_description},
};
use driml_machine::error::{did_you_mean, usage};
use driml_model::{Parameters, Precision, WeightDtype, is_bf16_fast};
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::evaluate::{EPSILON, Player};

/// Each game, with its file in `deploy/pretrained/`.
macro_rules! built_in_games {
    ($($game:literal),+) => {
        &[$(($game, include_bytes!(concat!("../../pretrained/", $game, ".safetensors")))),+]
    };
}

const PREFIX: &str = "pretrained:";
/// The extension of a weights file; other paths are run folders.
const EXTENSION: &str = "safetensors";
/// The built-in networks, by the name of the game. To add one, run `driml evaluate RUN --export deploy/pretrained/GAME.safetensors`
/// and add its name here.
const BUILT_IN: &[(&str, &[u8])] = built_in_games!["bigfish", "coinrun", "fruitbot", "starpilot"];

const EXPORTED_KEY: &str = "exported";

/// What the description of an exported network has in addition to that of a checkpoint.
#[derive(Serialize, Deserialize)]
struct Exported {
    /// The run's resolved settings, TOML.
    settings: String,
    updates: u64,
    is_averaged: bool,
}

/// Reads the network `name`, which is built in or a file; none if `name` is a run's folder.
///
/// # Errors
/// A name that no built-in network has, a file that cannot be read or is not an exported network.
pub fn load(name: &Path) -> anyhow::Result<Option<Player>> {
    let shown = name.display().to_string();
    if let Some(game) = shown.strip_prefix(PREFIX) {
        let built_in = BUILT_IN.iter().find(|(known, _)| *known == game);
        let (_, bytes) = built_in.with_context(|| {
            let games = BUILT_IN.iter().map(|(known, _)| *known);
            let near = did_you_mean(game, games.clone());
            let known: Vec<_> = games.map(|it| format!("{PREFIX}{it}")).collect();
            let known = known.join(", ");
            usage!("no pretrained weights of {game:?}{near}; there are {known}")
        })?;
        return load_bytes(&shown, bytes).map(Some);
    }
    if name.extension().is_none_or(|it| it != EXTENSION) || name.is_dir() {
        return Ok(None);
    }
    let bytes = fs::read(name).map_err(|e| usage!("reading {shown}: {e}"))?;
    load_bytes(&shown, &bytes).map(Some)
}

fn load_bytes(name: &str, bytes: &[u8]) -> anyhow::Result<Player> {
    let described = read_description(bytes);
    let described =
        described.map_err(|e| usage!("{name} is damaged, or not a safetensors file: {e}"))?;
    let exported = described.and_then(|it| it.get(EXPORTED_KEY).cloned());
    let exported: Exported = exported
        .and_then(|it| serde_json::from_value(it).ok())
        .with_context(|| {
            usage!(
                "{name} is not an exported network: its metadata has no settings; `driml evaluate RUN --export FILE.{EXTENSION}` writes one"
            )
        })?;
    let settings = format!("the settings in {name}");
    let mut config = RunConfig::parse(&settings, &exported.settings)?;
    config.learner.publish_dtype = WeightDtype::F16;
    // The run's precision was chosen for the machine that trained.
    if !is_bf16_fast() {
        config.actor.precision = Precision::F32;
    }
    let model = config.model.without_dim();
    let network = Parameters::load_safetensors(&model, |_| true, bytes, &Compute::CPU.device)
        .with_context(|| usage!("{name} does not have the weights of its settings"))?;
    Ok(Player {
        config,
        network,
        updates: exported.updates,
        is_averaged: exported.is_averaged,
        epsilon: EPSILON,
    })
}

/// Exports the network, without DIM's heads, as the bytes of a file that [`load`] reads.
pub fn export(player: &Player) -> anyhow::Result<Vec<u8>> {
    let config = &player.config;
    let model = config.model.without_dim();
    let mut description: Value =
        serde_json::from_str(&describe(&config.run, &model, &config.input))?;
    description[EXPORTED_KEY] = serde_json::to_value(Exported {
        settings: config.to_toml(),
        updates: player.updates,
        is_averaged: player.is_averaged,
    })?;
    let network = player.network.without_dim()?;
    let description = description.to_string();
    Ok(network.to_described_safetensors(WeightDtype::F16, METADATA_KEY, &description)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{play_returns, untrained_player};

    fn said(bytes: &[u8]) -> String {
        format!("{:#}", load_bytes("a.file", bytes).map(drop).unwrap_err())
    }

    #[test]
    fn every_built_in_network_is_of_its_game() {
        for (game, bytes) in BUILT_IN {
            let player = load_bytes(game, bytes).unwrap();
            assert_eq!(player.config.run.world, format!("procgen:{game}"));
        }
    }

    #[test]
    fn an_exported_network_is_read_and_plays() {
        let player = untrained_player("chain", "driml-ada");
        let bytes = export(&player).unwrap();
        assert_eq!(bytes, export(&player).unwrap());
        let read = load_bytes("x", &bytes).unwrap();
        assert_eq!((read.updates, read.weights_name()), (7, "averaged"));
        assert_eq!(read.config.run, player.config.run);
        for (name, var) in read.network.iter() {
            let both = [var, player.network.get(name).unwrap()];
            let both = both.map(|it| it.flatten_all().unwrap().to_vec1::<f32>().unwrap());
            for (rounded, exact) in both[0].iter().zip(&both[1]) {
                let size = exact.abs().max(WeightDtype::F16.min_normal());
                let error = WeightDtype::F16.rounding_error() as f32 * size;
                let is_near = (rounded - exact).abs() <= error;
                assert!(is_near, "{name}: {rounded}, {exact}");
            }
        }
        assert_eq!(play_returns(&read).len(), 4);
        // Exporting what was read rounds nothing again.
        let again = load_bytes("x", &export(&read).unwrap()).unwrap();
        assert_eq!(play_returns(&read), play_returns(&again));
        assert_eq!(play_returns(&read), play_returns(&read.with_f32()));
    }

    #[test]
    fn what_does_not_fit_names_both_sides() {
        let bytes = export(&untrained_player("chain", "c51")).unwrap();
        assert!(said(&bytes[..99]).contains("is damaged, or not a safetensors"));

        // Weights of one network beside the settings of another.
        let mut mixed = untrained_player("chain", "c51");
        for (from, to, why) in [
            ("hidden = 32", "hidden = 16", "has shape"),
            ("num_actions = 3", "num_actions = 5", " = 5, but it"),
        ] {
            let text = mixed.config.to_toml().replace(from, to);
            let description = serde_json::json!({
                EXPORTED_KEY: Exported { settings: text, updates: 1, is_averaged: false }
            });
            let network = &mixed.network;
            let bytes = network
                .to_described_safetensors(WeightDtype::F16, METADATA_KEY, &description.to_string())
                .unwrap();
            let text = said(&bytes);
            assert!(text.contains(why) && text.contains("a.file"), "{text}");
        }
        mixed.network = untrained_player("mspacman", "c51").network;
        let bytes = export(&mixed).unwrap();
        let why = said(&bytes);
        assert!(why.contains("has shape") && why.contains("wanted"), "{why}");
    }
}
