//! Measures updates of the learner at the paper's sizes, and as sizes grow.
//! Only the update is timed, on synthetic batches.

use driml_learner::{
    Agent, Compute, DeviceName, Kernels, OwnedBatch, Precision,
    cost::{UpdateCost, UpdateShape},
};
use driml_machine::speed_meter::Work;
use driml_settings::config::RunConfig;
use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    flags::BenchLearnerArgs,
    report::Bench,
    settings::{self, AGENT, WORLD},
};

/// The cases, as [`settings::case`] reads them.
const CASES: &str = "\
C51, 64x64x3|c51|paper
C51 + global-global DIM, 64x64x3|driml-ada|paper
C51 + local-local + global-global DIM, 64x64x3|driml-ada|paper|learner.update.lambda.3t3=1
C51 + global-global DIM, 104x80x3|driml-ada|paper-observation
C51, impala, 64x64x3|c51|paper|model.torso=impala
C51, impala, 64x64x3, 64 rows|c51|paper|model.torso=impala|learner.batch_size=64
C51, impala, half width, 64x64x3|c51|paper|model.torso=impala|model.channels=[8,16,16]
C51 + global-global DIM, impala, 64x64x3|driml-ada|paper|model.torso=impala";
/// The update that is also computed with candle's own operations, as on a GPU, instead of our kernels.
pub(super) const GLOBAL_DIM_CASE: &str = "C51 + global-global DIM, 64x64x3";
pub(super) const CANDLE_SUFFIX: &str = "candle's own operations";
/// Shares of s_t and s_{t+k}, and of s_{t+n}, that are copies of another state.
const REPEATED: [(f64, &str); 3] = [
    (0.0, "no states repeat"),
    (0.04, "4% of states repeat"),
    (0.38, "38% of states repeat"),
];
const DEDUPLICATION: [(&str, &str); 2] = [
    ("learner.deduplicate_states=false", "each computed"),
    ("learner.deduplicate_states=true", "equal ones once"),
];
/// The growing sizes, and settings that override the paper's: C51 + global DIM, 256 rows of 64x64x3, 51 atoms, vectors of 512.
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
    ("vectors of 64", &["model.embedding_dim=64"]),
    ("vectors of 256", &["model.embedding_dim=256"]),
    ("vectors of 1024", &["model.embedding_dim=1024"]),
];

/// Measures updates per second on a device, in each precision; on the CPU also with candle's own operations.
pub(super) fn measure(args: &BenchLearnerArgs, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let device = args.on.device;
    for precision in bench.flags.precisions(device) {
        let compute = device.open(precision)?;
        match args.growth {
            true => growth(precision, &compute, bench)?,
            false => paper(precision, &compute, device == DeviceName::Cpu, bench)?,
        }
    }
    Ok(())
}

/// Measures updates at the paper's sizes; on a CPU also with candle's own operations, and with repeated states in a batch.
fn paper(
    precision: Precision,
    compute: &Compute,
    on_cpu: bool,
    bench: &mut Bench<'_>,
) -> anyhow::Result<()> {
    let meter = bench.meter;
    let mut record = |what: &str, rate| bench.record(what, precision, rate, "updates/s");
    for case in CASES.lines() {
        let (name, config) = settings::case(case)?;
        let rate = meter.rate_by_median(updates(&config, compute, 0.0)?)?;
        record(name, rate);
        if name == GLOBAL_DIM_CASE && on_cpu && precision == Precision::F32 {
            let mut candle = compute.clone();
            candle.kernels = Kernels::Candle;
            let rate = meter.rate_by_median(updates(&config, &candle, 0.0)?)?;
            record(&format!("{name}, {CANDLE_SUFFIX}"), rate);
        }
    }
    if !on_cpu {
        return Ok(());
    }
    let (mut names, mut works) = (Vec::new(), Vec::new());
    for (share, repeated) in REPEATED {
        for (set, computed) in DEDUPLICATION {
            let config = settings::run_config(WORLD, AGENT, "paper", &[set])?;
            works.push(updates(&config, compute, share)?);
            names.push(format!(
                "C51 + global-global DIM, 60x60x3, {repeated}, {computed}"
            ));
        }
    }
    for (name, rate) in names.iter().zip(meter.rates_in_turn(&mut works)?) {
        record(name, rate);
    }
    Ok(())
}

/// Measures updates per second at each size, and GFLOP/s of the products that `driml inspect` counts.
fn growth(precision: Precision, compute: &Compute, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    for (name, sets) in SIZES {
        let sets = [sets, &["learner.deduplicate_states=false"]].concat();
        let (work, gflop) = work_and_gflop(AGENT, &sets, compute)?;
        let rate = bench.meter.rate_by_median(work)?;
        let name = format!("{name}: {gflop:.2} GFLOP");
        bench.record(&name, precision, rate, "updates/s");
        let what = format!("{name}, arithmetic");
        bench.record(&what, precision, rate * gflop, "GFLOP/s");
    }
    Ok(())
}

/// Returns the work of an update of this agent with settings that override the paper's, and the GFLOP of that update.
pub(super) fn work_and_gflop(
    agent: &str,
    sets: &[&str],
    compute: &Compute,
) -> anyhow::Result<(Work<'static>, f64)> {
    let config = settings::run_config(WORLD, agent, "paper", sets)?.with_whole_frames()?;
    let shape = UpdateShape::for_learner(&config.learner, config.run.horizon.positives());
    let gflop = UpdateCost::compute(&config.model, &shape).total() as f64 / 1e9;
    Ok((updates(&config, compute, 0.0)?, gflop))
}

/// Returns the work of an update with these settings, on a synthetic batch with the share `repeated` of repeated states.
fn updates(config: &RunConfig, compute: &Compute, repeated: f64) -> anyhow::Result<Work<'static>> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut rows = synthetic_batch(config, &mut rng);
    repeat_states(&mut rows, repeated);
    let (model, update) = (config.model.clone(), config.learner.update.clone());
    let agent = Agent::new(model, update, compute, &mut rng)?;
    let mut agent = agent.with_deduplication(config.learner.deduplicate_states);
    Ok(Box::new(move || {
        agent.update(&rows.batch())?;
        Ok(())
    }))
}

/// Makes a synthetic batch with the sizes of `config`: random bytes, actions and returns.
fn synthetic_batch(config: &RunConfig, rng: &mut ChaCha8Rng) -> OwnedBatch {
    let rows = config.learner.batch_size as usize;
    let mut states = || {
        let mut states = vec![0; rows * config.model.frame_len()];
        rng.fill_bytes(&mut states);
        states
    };
    let [states_t, states_k, states_n] = [states(), states(), states()];
    let mut actions = || {
        let draw = |_| rng.random_range(0..config.model.num_actions) as u8;
        (0..rows).map(draw).collect()
    };
    let (action, next_action) = (actions(), actions());
    let gamma_n = config.run.gamma.powi(config.run.n_step as i32) as f32;
    OwnedBatch {
        states_t,
        states_k,
        states_n,
        action,
        next_action,
        n_step_return: (0..rows).map(|_| rng.random_range(-2.0..2.0)).collect(),
        bootstrap_discount: vec![gamma_n; rows],
        positive_valid: vec![1; rows],
        ..OwnedBatch::default()
    }
}

/// Replaces this share of s_t and s_{t+k} together, and of s_{t+n}, by copies of states before them, spread evenly.
fn repeat_states(batch: &mut OwnedBatch, share: f64) {
    let len = batch.states_t.len() / batch.action.len();
    for plane in [
        &mut batch.states_t,
        &mut batch.states_k,
        &mut batch.states_n,
    ] {
        let mut copies_due = 0.0;
        for row in 1..plane.len() / len {
            copies_due += share;
            if copies_due >= 1.0 {
                copies_due -= 1.0;
                plane.copy_within((row - 1) * len..row * len, row * len);
            }
        }
    }
}
