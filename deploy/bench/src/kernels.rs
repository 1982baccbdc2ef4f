//! Measures how close the kernels come to the processor's highest rate of products: convolutions alone, and whole updates.
//! The convolutions are 3 x 3 with ReLU, on 256 maps of a residual stage with their border of zeros.

use candle_core::{Device, Tensor};
use driml_learner::DeviceName;
use driml_model::{conv_stack, multiply_in_first_cache};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{learner::work_and_gflop, report::Bench};

const ROWS: usize = 256;
/// Side and channels of the maps of each stage, which has as many input channels as output channels.
const STAGES: [(usize, usize); 3] = [(32, 16), (16, 32), (8, 32)];
const TORSOS: [&str; 2] = ["nature", "impala"];
const TILES: usize = 10_000;

pub(super) fn measure(bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let meter = bench.meter;
    for precision in bench.flags.precisions(DeviceName::Cpu) {
        let mut record = |what: &str, gflop: f64, calls: f64| {
            bench.record(what, precision, gflop * calls, "GFLOP/s");
        };
        let gflop = multiply_in_first_cache(precision, TILES) / 1e9;
        let calls = meter.rate_by_median(|| Ok(multiply_in_first_cache(precision, TILES)))?;
        record("products in the first cache", gflop, calls);
        for (side, channels) in STAGES {
            let maps = random(&[ROWS, side + 2, side + 2, channels])?;
            let (weight, bias) = (random(&[channels, channels, 3, 3])?, random(&[channels])?);
            let gflop = (2 * ROWS * side * side * 9 * channels * channels) as f64 / 1e9;
            let layer = [(&weight, &bias, 1)];
            let calls = meter.rate_by_median(|| Ok(conv_stack(&maps, &layer, precision)?))?;
            let what = format!("convolution of 256 maps, {side}x{side}x{channels}");
            record(&what, gflop, calls);
        }
        let compute = DeviceName::Cpu.open(precision)?;
        for torso in TORSOS {
            let set = format!("model.torso={torso}");
            let (work, gflop) = work_and_gflop("c51", &[&set], &compute)?;
            let what = format!("update of C51, {torso}: {gflop:.2} GFLOP");
            record(&what, gflop, meter.rate_by_median(work)?);
        }
    }
    Ok(())
}

/// Returns a tensor of random numbers in [-1, 1).
fn random(shape: &[usize]) -> candle_core::Result<Tensor> {
    let rng = ChaCha8Rng::seed_from_u64(1);
    let values = rng.random_iter::<f32>().map(|it| 2.0 * it - 1.0);
    Tensor::from_iter(values.take(shape.iter().product()), &Device::Cpu)?.reshape(shape)
}
