//! Updates of the learner at the paper's sizes, and one of them by candle's stock operations.
//! Batches are made up: nothing but the arithmetic is measured.

use driml_learner::{Agent, Batch, Compute, DeviceName, EqualStates, Precision, UpdateError};
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
/// That update where this share of s_t and s_{t+k}, and of s_{t+n}, repeats another state; what is done with them.
const REPEATS: [(f64, EqualStates, &str); 6] = [
    (0.0, EqualStates::Each, "no states repeat, each computed"),
    (0.0, EqualStates::Once, "no states repeat, equal ones once"),
    (
        0.04,
        EqualStates::Each,
        "4% of states repeat, each computed",
    ),
    (
        0.04,
        EqualStates::Once,
        "4% of states repeat, equal ones once",
    ),
    (
        0.38,
        EqualStates::Each,
        "38% of states repeat, each computed",
    ),
    (
        0.38,
        EqualStates::Once,
        "38% of states repeat, equal ones once",
    ),
];

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
        let mut learner = Agent::new(model, update, &compute, &mut rng)?
            .with_equal_states(config.learner.equal_states);
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
    if device == DeviceName::Cpu {
        figures.extend(repeats(effort, precision)?);
    }
    Ok(figures)
}

/// Updates a second where states of a batch repeat, in turn.
fn repeats(effort: &Effort, precision: Precision) -> anyhow::Result<Vec<Measurement>> {
    let config = settings::of_run(settings::WORLD, "driml-ada", "paper", &[])?;
    let compute = Compute::cpu(precision);
    let mut updates = Vec::new();
    for (share, equal_states, _) in REPEATS {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut rows = SyntheticBatch::draw(&config, &mut rng);
        rows.repeat(share);
        let (model, update) = (config.model.clone(), config.learner.update.clone());
        let mut learner =
            Agent::new(model, update, &compute, &mut rng)?.with_equal_states(equal_states);
        updates.push(move |_: usize| learner.update(&rows.batch()).map(drop));
    }
    let mut works: Vec<&mut dyn FnMut(usize) -> Result<(), UpdateError>> = Vec::new();
    for update in &mut updates {
        works.push(update);
    }
    let rates = effort.rates_in_turn(&mut works)?;
    let mut figures = Vec::new();
    for ((_, _, what), rate) in REPEATS.into_iter().zip(rates) {
        let name = named(
            format!("C51 + global-global DIM, 60x60x3, {what}"),
            precision,
        );
        figures.push(Measurement::found(name, rate, "updates/s"));
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

    /// Makes this share of s_t and s_{t+k} together, and of s_{t+n}, copies of states before them, spread evenly.
    fn repeat(&mut self, share: f64) {
        let len = self.frames[0].len() / self.action.len();
        for plane in &mut self.frames {
            let mut owed = 0.0;
            for row in 1..plane.len() / len {
                owed += share;
                if owed >= 1.0 {
                    owed -= 1.0;
                    plane.copy_within((row - 1) * len..row * len, row * len);
                }
            }
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
            importance_weight: None,
        }
    }
}
