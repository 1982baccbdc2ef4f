//! How an update's time grows with the sizes of batch, observation and network, beside what it computes.
//! Batches are made up, as those of `learner` are.

use driml_learner::{
    Agent, DeviceName, Precision,
    cost::{UpdateCost, UpdateShape},
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    effort::Effort,
    learner::SyntheticBatch,
    measurements::{Measurement, named},
    settings,
};

/// What grows, and the settings over those of the paper: C51 + global DIM, 256 rows of 64x64x3, 51 atoms, vectors of 512.
const SIZES: [(&str, &[&str]); 13] = [
    ("32 rows", &["learner.batch_size=32"]),
    ("64 rows", &["learner.batch_size=64"]),
    ("128 rows", &["learner.batch_size=128"]),
    ("256 rows of 64x64, 51 atoms, vectors of 512", &[]),
    ("512 rows", &["learner.batch_size=512"]),
    ("48x48", &["input.height=48", "input.width=48"]),
    ("84x84", &["input.height=84", "input.width=84"]),
    ("104x80", &["input.height=104", "input.width=80"]),
    ("11 atoms", &["model.atoms=11"]),
    ("201 atoms", &["model.atoms=201"]),
    ("vectors of 64", &["model.rkhs=64"]),
    ("vectors of 256", &["model.rkhs=256"]),
    ("vectors of 1024", &["model.rkhs=1024"]),
];

/// For each size updates a second, and the arithmetic that this is: the products that `driml inspect` counts.
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
    for (name, sets) in SIZES {
        let config = settings::of_run(settings::WORLD, settings::AGENT, "paper", sets)?;
        let config = config.with_whole_frames()?;
        let shape = UpdateShape::of(&config.learner, config.run.horizon.positives());
        let gflop = UpdateCost::of(&config.model, &shape).total() as f64 / 1e9;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let rows = SyntheticBatch::draw(&config, &mut rng);
        let (model, update) = (config.model.clone(), config.learner.update.clone());
        let mut learner = Agent::new(model, update, &compute, &mut rng)?;
        let rate = effort.rate_by_median(|| learner.update(&rows.batch()).map(drop))?;
        let name = named(format!("{name}: {gflop:.2} GFLOP"), precision);
        figures.push(Measurement::found(name.clone(), rate, "updates/s"));
        let speed = format!("{name}, arithmetic");
        figures.push(Measurement::found(speed, rate * gflop, "GFLOP/s"));
    }
    Ok(figures)
}
