//! Measures how far an update of any precision, network and weights is from the same update in f32 by candle's own operations.
//! It applies no tolerances: the parity check does, which compares both ways of computing with float64.

use candle_core::Device;
use driml_model::{Compute, Kernels, argmax};
use driml_protocol::NO_ACTION;

use crate::{agent::Agent, batch::Batch, error::Result, tensors::to_vec_f64};

/// The reference's way of computing: on the CPU, without this project's kernels.
pub const REFERENCE: Compute = Compute {
    device: Device::Cpu,
    kernels: Kernels::Candle,
};

/// How far an agent's numbers are from a reference's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateDeviation {
    /// The agent's total loss.
    pub own_loss: f64,
    /// The reference's total loss.
    pub reference_loss: f64,
    /// |total - reference| / |reference|.
    pub loss: f64,
    /// 2-norm of the difference of the gradients over that of the reference's gradients, all parameters together; 0 if both are 0.
    pub gradient: f64,
    /// 1 - cosine of the angle between the gradients.
    pub angle: f64,
    /// Share of rows with the reference's greedy action in s_{t+n}, among the rows that bootstrap; 1 if none does.
    pub same_next_action: f64,
}

impl UpdateDeviation {
    /// Compares `agent` on `batch` with `reference`, an agent of the same parameters on [`REFERENCE`]. Both use the noise of `agent`.
    pub fn new(agent: &Agent, batch: &Batch<'_>, reference: &Agent) -> Result<Self> {
        let noise = agent.noise();
        let own = agent.gradients_with(batch, &noise)?;
        let expected = reference.gradients_with(batch, &noise)?;
        let (mut difference, mut dot, mut own_square, mut square) = (0.0, 0.0, 0.0, 0.0);
        for (name, var) in reference.online().iter() {
            let [got, expected] = [&own.gradients, &expected.gradients].map(|gradients| {
                let gradient = gradients.get(name);
                gradient.map_or_else(|| Ok(vec![0.0; var.elem_count()]), to_vec_f64)
            });
            for (got, expected) in got?.iter().zip(expected?) {
                difference += (got - expected).powi(2);
                dot += got * expected;
                own_square += got * got;
                square += expected * expected;
            }
        }
        let [own_next, next] = [&own, &expected].map(|it| &it.next_greedy_action);
        let next = own_next.iter().zip(next);
        let next = next.filter(|(own, _)| **own != NO_ACTION);
        let next: Vec<bool> = next.map(|(own, expected)| own == expected).collect();
        let same_next = next.iter().filter(|same| **same).count() as f64;
        let [own_loss, reference_loss] = [&own, &expected].map(|it| f64::from(it.losses.total));
        Ok(Self {
            own_loss,
            reference_loss,
            loss: (own_loss - reference_loss).abs() / reference_loss.abs(),
            gradient: match difference {
                0.0 => 0.0,
                _ => f64::sqrt(difference / square),
            },
            angle: 1.0 - dot / f64::sqrt(own_square * square),
            same_next_action: if next.is_empty() {
                1.0
            } else {
                same_next / next.len() as f64
            },
        })
    }
}

/// How far values [B, A] are from a reference's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QDeviation {
    /// Root mean square of the errors, in units of return.
    pub rms: f64,
    /// The largest error.
    pub max: f64,
    /// Share of rows whose best action is the reference's.
    pub same_action: f64,
}

impl QDeviation {
    /// Compares `got` [B, A] with `expected` [B, A].
    pub fn new(got: &[f32], expected: &[f32], num_actions: usize) -> Self {
        let (mut square, mut max) = (0.0, 0f64);
        for (&got, &expected) in got.iter().zip(expected) {
            let error = (f64::from(got) - f64::from(expected)).abs();
            square += error * error;
            max = max.max(error);
        }
        let rows = expected.len() / num_actions;
        let [own, reference] = [got, expected].map(|it| it.chunks_exact(num_actions).map(argmax));
        let same = own.zip(reference).filter(|(a, b)| a == b).count();
        Self {
            rms: (square / expected.len() as f64).sqrt(),
            max,
            same_action: same as f64 / rows as f64,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_compared_row_by_row() {
        let found = QDeviation::new(&[1.0, 2.0, 5.0, 4.0], &[1.0, 2.5, 4.0, 4.5], 2);
        assert_eq!((found.max, found.same_action), (1.0, 0.5));
        assert!((found.rms - (1.5f64 / 4.0).sqrt()).abs() < 1e-12);
    }
}
