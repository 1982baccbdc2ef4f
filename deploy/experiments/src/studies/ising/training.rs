//! Local DIM on the Ising world: training on pairs of successive frames, and measuring how well the scores tell patch from noise.
//! Network, loss and optimiser are those of the learner. The C51 loss is left out because this world gives no rewards.

use candle_core::{Device, Tensor};
use driml_envs::{Environment, IsingConfig, IsingWorld, StepEnd};
use driml_learner::{UpdateSettings, auxiliary::dim::Dim};
use driml_model::{Features, ModelConfig};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{progress::Progress, stats::auc, studies::dim::DimLearner};

/// A table of `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// Differences from the settings of a run in this world, in the form of `--set`.
    pub(super) sets: Vec<String>,
    /// The number of seeds, 1 to this. No piece depends on it, so that more seeds can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    pub(super) updates: u64,
    /// The number of pairs in a batch. For each pair all others are negatives.
    pub(super) batch_size: usize,
    pub(super) checks: u64,
    /// The number of episodes of each measurement before the end.
    pub(super) check_episodes: usize,
    /// The number of episodes of the measurement at the end.
    pub(super) episodes: usize,
    /// Scores are measured from this environment step to the next.
    pub(super) from_t: u32,
    /// The environment step at which the late lattices are drawn.
    pub(super) late_t: u32,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Task {
    pub(super) world: IsingConfig,
    pub(super) model: ModelConfig,
    pub(super) learner: UpdateSettings,
    pub(super) settings: Settings,
}

/// The first seed of the measured worlds: the same for every training, and never used to train.
const MEASURED_SEED: u64 = 1 << 40;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Outcome {
    /// The InfoNCE loss at each update, in nats.
    pub(super) loss: Vec<f32>,
    /// Measurements, each with its number of updates. The last one is at the end, on more episodes.
    pub(super) checks: Vec<(u64, Measurement)>,
    /// Scores at each location, for the first episodes of the last measurement, in nats: log-softmax of the true pair plus ln B.
    pub(super) maps: Vec<Vec<f64>>,
}

/// How well the scores from `from_t` to the next step classify. Areas under ROC curves: 0.5 is chance, 1 is perfect.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measurement {
    /// Locations in the patch against the others. A location is in the patch if the centre of its receptive field is.
    pub(super) auc: f64,
    /// As `auc`, by the raw score without the softmax over other episodes.
    pub(super) auc_raw: f64,
    /// As `auc`, for the locations whose receptive field lies wholly inside or wholly outside the patch.
    pub(super) auc_clear: f64,
    /// Inside the patch: true pairs against pairs of two episodes whose patches both cover the location.
    pub(super) auc_pairs: f64,
    /// The InfoNCE loss, in nats.
    pub(super) loss: f64,
}

pub(super) fn train(task: &Task, seed: u64, progress: &mut Progress) -> anyhow::Result<Outcome> {
    let settings = &task.settings;
    let update_settings = &task.learner;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let dim = Dim {
        lambda: update_settings.lambda,
        tanh_clip: update_settings.tanh_clip,
    };
    let norm_max = update_settings.max_grad_norm;
    let mut learner = DimLearner::new(&task.model, dim, update_settings.adam, norm_max, &mut rng)?;
    let (mut episodes, mut batches_left) = (Episodes::default(), 0);
    let (mut loss, mut checks) = (Vec::new(), Vec::new());
    let period = (settings.updates / settings.checks.max(1)).max(1);
    for update in 0..settings.updates {
        if update.is_multiple_of(period) {
            checks.push((update, measure(task, &learner, settings.check_episodes)?.0));
        }
        if batches_left == 0 {
            // As many batches as an episode has pairs, so that each pair is used once on average.
            batches_left = (task.world.episode_steps - 1).max(1);
            // The seed is below those of the measured worlds.
            let seed = rng.random_range(0..MEASURED_SEED);
            episodes = Episodes::play(&task.world, settings.batch_size, batches_left, seed)?;
        }
        batches_left -= 1;
        let (now, next) = episodes.draw_pairs(settings.batch_size, &mut rng);
        let [now, next] = [now, next].map(|frames| features(task, &learner, &frames));
        loss.push(learner.update(&now?, &next?)?);
        progress.advance(1)?;
    }
    let (last, maps) = measure(task, &learner, settings.episodes)?;
    checks.push((settings.updates, last));
    Ok(Outcome { loss, checks, maps })
}

/// Frames [T, N, H * W] of whole episodes of N environments, and the first row and column of each patch.
#[derive(Default)]
pub(super) struct Episodes {
    pub(super) frames: Vec<Vec<u8>>,
    pub(super) origins: Vec<(usize, usize)>,
}

impl Episodes {
    /// Plays `envs` episodes and keeps `steps` + 1 frames of each.
    pub(super) fn play(
        config: &IsingConfig,
        envs: usize,
        steps: u32,
        seed: u64,
    ) -> anyhow::Result<Self> {
        let config = IsingConfig {
            episode_steps: steps + 1,
            ..config.clone()
        };
        let mut world = IsingWorld::new(&config, envs, seed)?;
        let bytes = world.frame_shape().bytes();
        let (mut rewards, mut ends) = (vec![0.0; envs], vec![StepEnd::Running; envs]);
        let mut frames = Vec::new();
        for step in 0..=steps {
            let mut frame = vec![0; envs * bytes];
            world.observe(&mut frame);
            frames.push(frame);
            if step < steps {
                world.step(&vec![0; envs], &mut rewards, &mut ends)?;
            }
        }
        let origins = (0..envs).filter_map(|env| world.patch_origin(env));
        Ok(Self {
            frames,
            origins: origins.collect(),
        })
    }

    /// Plays the first batch of episodes that [`measure`] uses.
    pub(super) fn play_measured(task: &Task, steps: u32) -> anyhow::Result<Self> {
        Self::play(&task.world, task.settings.batch_size, steps, MEASURED_SEED)
    }

    /// Draws a batch of pairs (s_t, s_{t+1}). Each row is another episode at a random t.
    fn draw_pairs(&self, rows: usize, rng: &mut ChaCha8Rng) -> (Vec<u8>, Vec<u8>) {
        let (mut now, mut next) = (Vec::new(), Vec::new());
        for row in 0..rows {
            let t = rng.random_range(0..self.frames.len() - 1);
            let bytes = self.frames[t].len() / rows;
            let place = row * bytes..(row + 1) * bytes;
            now.extend_from_slice(&self.frames[t][place.clone()]);
            next.extend_from_slice(&self.frames[t + 1][place]);
        }
        (now, next)
    }
}

/// Computes the features of these frames with the learner's network, a row for each frame.
fn features(task: &Task, learner: &DimLearner, frames: &[u8]) -> anyhow::Result<Features> {
    let model = &task.model;
    let rows = frames.len() / model.frame_len();
    let shape = (rows, model.height, model.width, model.input_channels);
    let frames = Tensor::from_slice(frames, shape, &Device::Cpu)?;
    Ok(learner.network.features(&frames)?)
}

/// Measures on whole batches of episodes, at least one. Returns also the maps of the first three episodes.
fn measure(
    task: &Task,
    learner: &DimLearner,
    episodes: usize,
) -> anyhow::Result<(Measurement, Vec<Vec<f64>>)> {
    let (world, settings) = (&task.world, &task.settings);
    let (rows, t) = (settings.batch_size, settings.from_t as usize);
    let fields = ReceptiveFields::of(&task.model);
    let mut tally = Tally::default();
    let mut maps = Vec::new();
    for batch in 0..episodes.div_ceil(rows).max(1) {
        let seed = MEASURED_SEED + batch as u64;
        let played = Episodes::play(world, rows, settings.from_t + 1, seed)?;
        let [now, next] = [t, t + 1].map(|t| features(task, learner, &played.frames[t]));
        // [L, B, B] of every anchor with every candidate, at each location.
        let scores = learner.scores(&now?, &next?)?;
        let logs = log_softmax(&scores, rows);
        let locations = scores.len() / (rows * rows);
        for location in 0..locations {
            let place = (location / fields.columns, location % fields.columns);
            let of = |origin: &(usize, usize)| fields.cover(place, *origin, world.patch_size);
            let cover: Vec<Cover> = played.origins.iter().map(of).collect();
            tally.add(location, &cover, &scores, &logs, rows);
        }
        if batch == 0 {
            let score_max = (rows as f64).ln();
            let map = |row: usize| {
                let at = |location: usize| logs[(location * rows + row) * rows + row];
                (0..locations).map(|it| at(it) + score_max).collect()
            };
            maps = (0..rows.min(3)).map(map).collect();
        }
    }
    Ok((tally.measurement(), maps))
}

/// Normalises scores [L, B, B] over the candidates of each anchor.
///
/// The log-softmax of a positive plus ln B estimates the pointwise mutual information of its two views, in nats. It is at most ln B.
/// Source: the paper's listing "DIM objective scores".
fn log_softmax(scores: &[f64], rows: usize) -> Vec<f64> {
    let normalise = |row: &[f64]| -> Vec<f64> {
        let largest = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = row.iter().map(|score| (score - largest).exp()).sum();
        let log = largest + sum.ln();
        row.iter().map(|score| score - log).collect()
    };
    scores.chunks(rows).flat_map(normalise).collect()
}

/// How the receptive field of a location overlaps the patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Cover {
    centre: bool,
    /// `Some(true)` if the whole field is in the patch, `Some(false)` if no part is, else `None`.
    whole: Option<bool>,
}

/// The receptive fields of the locations of the last convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ReceptiveFields {
    /// The side of a receptive field, in pixels.
    pub(super) side: usize,
    /// The distance between the fields of neighbouring locations, in pixels.
    pub(super) step: usize,
    pub(super) columns: usize,
}

impl ReceptiveFields {
    /// Returns the receptive fields of a network's feature map f3.
    pub(super) fn of(model: &ModelConfig) -> Self {
        let (mut side, mut step) = (1, 1);
        for layer in &model.conv {
            side += (layer.kernel - 1) * step;
            step *= layer.stride;
        }
        Self {
            side,
            step,
            columns: model.f3_shape().1,
        }
    }

    fn cover(&self, place: (usize, usize), origin: (usize, usize), patch: usize) -> Cover {
        let along = |place: usize, origin: usize| {
            let (start, end) = (place * self.step, place * self.step + self.side);
            let centre = start + self.side / 2;
            let last = origin + patch;
            [
                (origin..last).contains(&centre),
                origin <= start && end <= last,
                end <= origin || last <= start,
            ]
        };
        let (rows, columns) = (along(place.0, origin.0), along(place.1, origin.1));
        let (inside, outside) = (rows[1] && columns[1], rows[2] || columns[2]);
        Cover {
            centre: rows[0] && columns[0],
            whole: (inside || outside).then_some(inside),
        }
    }
}

/// Scores by class, [negatives, positives]: in the patch (log-softmax and raw), wholly in the patch, and true pairs.
#[derive(Default)]
struct Tally {
    inside: [Vec<f64>; 2],
    inside_raw: [Vec<f64>; 2],
    whole: [Vec<f64>; 2],
    pairs: [Vec<f64>; 2],
}

impl Tally {
    /// Adds the true pairs of a location. Inside the patch it also adds each anchor with the next episode as a false pair.
    fn add(&mut self, location: usize, cover: &[Cover], scores: &[f64], logs: &[f64], rows: usize) {
        for (row, here) in cover.iter().enumerate() {
            let at = (location * rows + row) * rows;
            let (raw, log) = (scores[at + row], logs[at + row]);
            self.inside[usize::from(here.centre)].push(log);
            self.inside_raw[usize::from(here.centre)].push(raw);
            if let Some(whole) = here.whole {
                self.whole[usize::from(whole)].push(log);
            }
            let other = (row + 1) % rows;
            if other != row && here.centre && cover[other].centre {
                self.pairs[1].push(log);
                self.pairs[0].push(logs[at + other]);
            }
        }
    }

    /// Computes the areas and the loss. An area is 0.5 if a class has no example, which only a very short measurement leaves.
    fn measurement(&self) -> Measurement {
        let area = |[no, yes]: &[Vec<f64>; 2]| auc(yes, no).unwrap_or(0.5);
        let [outside, inside] = &self.inside;
        let all = inside.iter().chain(outside);
        let count = (inside.len() + outside.len()) as f64;
        Measurement {
            auc: area(&self.inside),
            auc_raw: area(&self.inside_raw),
            auc_clear: area(&self.whole),
            auc_pairs: area(&self.pairs),
            loss: -all.sum::<f64>() / count,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_of_the_dqn_network_tile_the_paper_s_frame() {
        let layer = driml_model::ConvLayer::new;
        let task = super::super::new_task(&super::super::tests::smoke()).unwrap();
        let model = ModelConfig {
            conv: vec![layer(32, 8, 4), layer(64, 4, 2), layer(64, 3, 1)],
            ..task.model
        };
        let view = ReceptiveFields::of(&model);
        assert_eq!((view.side, view.step, view.columns), (36, 8, 7));
        assert_eq!(6 * view.step + view.side, 84);
        for (place, centre, whole) in [
            ((0, 6), true, Some(true)),
            ((6, 6), false, Some(false)),
            ((2, 6), true, None),
        ] {
            let expected = Cover { centre, whole };
            assert_eq!(view.cover(place, (0, 42), 42), expected, "{place:?}");
        }
    }

    #[test]
    fn the_softmax_is_over_candidates() {
        let logs = log_softmax(&[1.0, 1.0, 0.0, 3f64.ln()], 2);
        let probabilities: Vec<f64> = logs.iter().map(|log| log.exp()).collect();
        for (p, expected) in probabilities.iter().zip([0.5, 0.5, 0.25, 0.75]) {
            assert!((p - expected).abs() < 1e-12);
        }
    }

    #[test]
    fn episodes_are_whole_and_their_patch_stays() {
        let task = super::super::new_task(&super::super::tests::smoke()).unwrap();
        let played = Episodes::play_measured(&task, 32).unwrap();
        assert_eq!(played.frames.len(), 33);
        let shorter = Episodes::play_measured(&task, 3).unwrap();
        assert_eq!(shorter.origins, played.origins);
        assert_eq!(shorter.frames[3], played.frames[3]);
    }
}
