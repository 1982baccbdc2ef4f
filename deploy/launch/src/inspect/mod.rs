//! `driml inspect`: what a world and an agent build, compute and send, what it would be if everything were on, and why each part is there.
//! It follows from the settings, but for what rows of batches hold, which is found by playing.

mod bytes;
mod everything;
mod line;
mod networks;
mod play;
mod text;
mod update;
pub mod worlds;

use anyhow::Context;
use driml_protocol::Batch;
use driml_settings::config::RunConfig;
use serde::Serialize;

use everything::{EVERYTHING, Everything};
pub use line::Line;
pub use play::RowShares;

/// What a world and an agent cost.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    /// The world's name, as `--env` takes it.
    pub world: String,
    /// The agent's name, as `--agent` takes it.
    pub agent: String,
    /// What [`Line::everything`] stands for.
    pub everything: &'static str,
    /// Scalars of all networks that the learner holds, layer by layer.
    pub parameters: Vec<Line>,
    /// Multiplications and additions of one update, part by part.
    pub update_flops: Vec<Line>,
    /// Multiplications and additions of one decision of an actor, layer by layer.
    pub decision_flops: Vec<Line>,
    /// Bytes of what travels and of what is kept. These are no parts of one sum.
    pub bytes: Vec<Line>,
    /// What rows hold, if that was looked at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub played: Option<RowShares>,
}

impl Inspection {
    /// Counts for the settings of a run.
    ///
    /// # Errors
    /// The sizes of the weights cannot be had.
    pub fn of(config: &RunConfig) -> anyhow::Result<Self> {
        let every = Everything::of(config);
        Ok(Self {
            world: config.run.world.clone(),
            agent: config.run.agent.clone(),
            everything: EVERYTHING,
            parameters: networks::parameters(config, &every),
            update_flops: update::update_flops(config, &every),
            decision_flops: networks::decision_flops(config, &every),
            bytes: bytes::bytes(config, &every).context("the size of the weights")?,
            played: None,
        })
    }

    /// Plays a run of `config`, all its frames, without learning, and counts what the rows of its batches hold.
    ///
    /// # Errors
    /// A world that cannot be had or fails.
    pub fn play(config: &RunConfig) -> anyhow::Result<RowShares> {
        play::play(config).with_context(|| format!("playing {}", config.run.world))
    }

    /// Plays as [`Inspection::play`] does, until there are `count` batches or the run ends.
    ///
    /// # Errors
    /// As there.
    pub fn batches(config: &RunConfig, count: usize) -> anyhow::Result<Vec<Batch>> {
        let mut batches = Vec::with_capacity(count);
        play::each_batch(config, |batch| {
            batches.push(batch);
            batches.len() < count
        })
        .with_context(|| format!("playing {}", config.run.world))?;
        Ok(batches)
    }

    /// As JSON.
    ///
    /// # Errors
    /// A failing serialisation.
    pub fn json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }

    /// As tables for a terminal.
    pub fn describe(&self) -> String {
        let heading = format!("{} on {}", self.agent, self.world);
        let tables = [
            text::table("parameters", &self.parameters, true),
            text::table("FLOPs of an update", &self.update_flops, true),
            text::table("FLOPs of a decision", &self.decision_flops, true),
            text::table("bytes", &self.bytes, false),
        ];
        let played = self.played.as_ref().map(text::played).unwrap_or_default();
        format!(
            "{heading}\n\n{}\n{played}everything: {}\n",
            tables.join("\n"),
            self.everything
        )
    }
}

#[cfg(test)]
mod tests;
