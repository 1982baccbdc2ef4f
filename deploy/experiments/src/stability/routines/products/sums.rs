//! What products are held to: sums of products in float64 beside the sums of their sizes, and the rows of the page.

use candle_core::{Device, Tensor, Var};
use driml_model::Precision;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    check::{Routine, Row},
    routines::losses::worse,
};

/// More are not looked at of one tensor: each is a sum of its own.
const PLACES_MAX: usize = 4_000;

const F32: Routine = Routine {
    name: "products, f32",
    range: "operands finite, the sum of their products' sizes below 3.4e38",
};
const BF16: Routine = Routine {
    name: "products, bf16",
    range: "operands within 3.38e38, the sum of their products' sizes below 3.3e38",
};

pub(super) const fn routine(precision: Precision) -> Routine {
    match precision {
        Precision::F32 => F32,
        Precision::Bf16 => BF16,
    }
}

/// What a sum of products should be, the sum of the products' sizes, their number, and the size of the largest operand.
#[derive(Default)]
pub(super) struct Sum {
    pub(super) value: f64,
    pub(super) sizes: f64,
    pub(super) terms: usize,
    largest: f64,
}

impl Sum {
    pub(super) fn add(&mut self, a: f64, b: f64) {
        self.value += a * b;
        self.sizes += (a * b).abs();
        self.terms += 1;
        self.largest = self.largest.max(a.abs()).max(b.abs());
    }

    /// The error of `found`, as a share of what is promised; none where the promise does not hold.
    pub(super) fn error(&self, found: f32, precision: Precision) -> Option<f64> {
        // Rounding to bf16 may add a 128th.
        if self.sizes * 1.01 >= f64::from(f32::MAX) || self.largest > 3.38e38 {
            return None;
        }
        let allowed = precision.product_error(self.terms) * self.sizes
            + precision.product_floor(self.terms, self.largest);
        let error = (f64::from(found) - self.value).abs();
        Some(if error == 0.0 { 0.0 } else { error / allowed })
    }
}

/// The worst error of `found` at some of its places, where it should be `sum_of` the place.
pub(super) fn worst(
    found: &[f32],
    places: &[usize],
    sum_of: impl Fn(usize) -> Sum,
    precision: Precision,
) -> f64 {
    let errors = places
        .iter()
        .filter_map(|&at| sum_of(at).error(found[at], precision));
    errors.fold(0.0, worse)
}

/// All of `count` places, or as many as may be looked at, drawn.
pub(super) fn places(count: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    match count <= PLACES_MAX {
        true => (0..count).collect(),
        false => (0..PLACES_MAX)
            .map(|_| rng.random_range(0..count))
            .collect(),
    }
}

pub(super) fn tensor(values: &[f32], shape: &[usize]) -> candle_core::Result<Var> {
    Var::from_tensor(&Tensor::from_slice(values, shape, &Device::Cpu)?)
}

pub(super) fn flat(tensor: &Tensor) -> candle_core::Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}

pub(super) fn row(precision: Precision, extreme: &str) -> Row {
    let promise = match precision {
        Precision::F32 => {
            "error, as a share of (terms + 2) 2^-24 of the products' sizes + terms 2^-150"
        }
        Precision::Bf16 => {
            "error, as a share of (2^-7 + terms 2^-24) of the products' sizes + 1.2e-38 of each operand, product and sum"
        }
    };
    Row::new(routine(precision), extreme, promise, 1.0)
}

/// So large that no product of two leaves the finite numbers.
pub(super) fn moderate(mut values: Vec<f32>) -> Vec<f32> {
    values.iter_mut().for_each(|x| *x = x.clamp(-1e17, 1e17));
    values
}
