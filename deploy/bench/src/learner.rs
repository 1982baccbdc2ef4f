//! Updates of the learner at the paper's sizes, and one of them by candle's stock operations.
//! Batches are made up: nothing but the arithmetic is measured.

use driml_learner::{Agent, Batch, DeviceName, Precision};
use driml_settings::config::RunConfig;
use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    candle_baseline::CandleBaseline,
    effort::Effort,
    measurements::{Measurement, named},
    settings,
};

/// What is measured: its name, agent, preset and further settings.
const CASES: [(&str, &str, &str, &[&str]); 4] = [
    ("C51, 64x64x3", "c51", "paper", &[]),
    (GLOBAL_DIM, "driml-ada", "paper", &[]),
    (
        "C51 + local-local + global-global DIM, 64x64x3",
        "driml-ada",
        "paper",
        &["learner.update.lambda.3t3=1"],
    ),
    (
        "C51 + global-global DIM, 104x80x3",
        "driml-ada",
        "paper-observation",
        &[],
    ),
];
/// The update that candle's stock operations do too.
const GLOBAL_DIM: &str = "C51 + global-global DIM, 64x64x3";

/// Updates a second on a device; candle's stock operations beside it on the CPU alone.
///
/// # Errors
/// An update that failed.
pub(super) fn measure(
    effort: &Effort,
    device: DeviceName,
    precision: Precision,
) -> anyhow::Result<Vec<Measurement>> {
    let compute = device.open(precision)?;
    let mut figures = Vec::new();
    for (name, agent, preset, sets) in CASES {
        let config = settings::of_run(settings::WORLD, agent, preset, sets)?.with_whole_frames()?;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let rows = SyntheticBatch::draw(&config, &mut rng);
        let batch = rows.batch();
        let (model, update) = (config.model.clone(), config.learner.update.clone());
        let mut learner = Agent::new(model, update, &compute, &mut rng)?;
        let rate = effort.rate_by_median(|| learner.update(&batch).map(drop))?;
        figures.push(Measurement::found(
            named(name, precision),
            rate,
            "updates/s",
        ));
        if name == GLOBAL_DIM && device == DeviceName::Cpu && precision == Precision::F32 {
            let mut stock = CandleBaseline::new(&learner)?;
            let rate = effort.rate_by_median(|| stock.update(&batch).map(drop))?;
            let name = format!("{name}, candle's stock operations");
            figures.push(Measurement::found(name, rate, "updates/s"));
        }
    }
    Ok(figures)
}

/// A batch that no world gave.
pub(super) struct SyntheticBatch {
    frames: [Vec<u8>; 3],
    action: Vec<u8>,
    next_action: Vec<u8>,
    n_step_return: Vec<f32>,
    bootstrap_discount: Vec<f32>,
    positive_valid: Vec<u8>,
}

impl SyntheticBatch {
    /// Random bytes, actions and returns, of the sizes that `config` has.
    pub(super) fn draw(config: &RunConfig, rng: &mut ChaCha8Rng) -> Self {
        let rows = config.learner.batch_size as usize;
        let mut frames = || {
            let mut frames = vec![0; rows * config.model.frame_len()];
            rng.fill_bytes(&mut frames);
            frames
        };
        let frames = [frames(), frames(), frames()];
        let mut actions = || {
            let draw = |_| rng.random_range(0..config.model.num_actions) as u8;
            (0..rows).map(draw).collect::<Vec<_>>()
        };
        let (action, next_action) = (actions(), actions());
        let gamma_n = config.run.gamma.powi(config.run.n_step as i32) as f32;
        Self {
            frames,
            action,
            next_action,
            n_step_return: (0..rows).map(|_| rng.random_range(-2.0..2.0)).collect(),
            bootstrap_discount: vec![gamma_n; rows],
            positive_valid: vec![1; rows],
        }
    }

    pub(super) fn batch(&self) -> Batch<'_> {
        let [states_t, states_k, states_n] = &self.frames;
        Batch {
            rows: self.action.len(),
            states_t,
            anchors: None,
            positives: 1,
            states_k,
            states_n,
            action: &self.action,
            next_action: &self.next_action,
            n_step_return: &self.n_step_return,
            bootstrap_discount: &self.bootstrap_discount,
            positive_valid: &self.positive_valid,
        }
    }
}
