//! How far an update of any precision, network and weights is from the same in float64.
//! It judges nothing: tolerances are for the cases of the parity check.

use candle_core::DType;
use driml_protocol::NO_ACTION;

use super::float64::Float64;
use crate::{agent::Agent, batch::Batch, error::UpdateError};

/// How far an agent's numbers are from float64's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorOfUpdate {
    /// |total - reference| / |reference|.
    pub loss: f64,
    /// 2-norm of the gradients' difference over that of the reference, all parameters together.
    pub gradient: f64,
    /// 1 - cosine of the angle between the gradients.
    pub angle: f64,
    /// Root mean square error of a value of s_t, in units of return.
    pub q_rms: f64,
    /// Largest error of a value of s_t, in units of return.
    pub q_max: f64,
    /// Share of rows whose greedy action in s_t is the reference's.
    pub same_action: f64,
    /// Share of rows that bootstrap whose greedy action in s_{t+n} is the reference's; 1 if none does.
    pub same_next_action: f64,
}

impl ErrorOfUpdate {
    /// Of `agent` on `batch`, as it computes it, against `reference` of both.
    ///
    /// # Errors
    /// What the agent's own arithmetic says.
    pub fn of(agent: &Agent, batch: &Batch<'_>, reference: &Float64) -> Result<Self, UpdateError> {
        let own = agent.evaluate(batch)?;
        let (mut apart, mut dot, mut own_square, mut square) = (0.0, 0.0, 0.0, 0.0);
        for (name, expected) in &reference.gradients {
            let got: Vec<f64> = match own.gradients.get(name) {
                Some(gradient) => gradient.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?,
                None => vec![0.0; expected.len()],
            };
            for (got, expected) in got.iter().zip(expected) {
                apart += (got - expected).powi(2);
                dot += got * expected;
                own_square += got * got;
                square += expected * expected;
            }
        }
        let values = QError::of(
            &agent.q_values_t(batch)?,
            &reference.q_values_t,
            agent.model().num_actions,
        );
        let next: Vec<bool> = own
            .next_greedy_action
            .iter()
            .zip(&reference.next_greedy_action)
            .filter(|(own, _)| **own != NO_ACTION)
            .map(|(own, expected)| own == expected)
            .collect();
        let same_next = next.iter().filter(|same| **same).count() as f64;
        Ok(Self {
            loss: (f64::from(own.total) - reference.total).abs() / reference.total.abs(),
            gradient: (apart / square).sqrt(),
            angle: 1.0 - dot / (own_square * square).sqrt(),
            q_rms: values.rms,
            q_max: values.max,
            same_action: values.same_action,
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
pub struct QError {
    /// Root mean square of the errors, in units of return.
    pub rms: f64,
    /// The largest error.
    pub max: f64,
    /// Share of rows whose best action is the reference's.
    pub same_action: f64,
}

impl QError {
    /// Of `got` [B, A] against `expected` [B, A].
    pub fn of(got: &[f32], expected: &[f64], num_actions: usize) -> Self {
        let errors = got
            .iter()
            .zip(expected)
            .map(|(&got, expected)| (f64::from(got) - expected).abs());
        let (mut square, mut max) = (0.0, 0f64);
        for error in errors {
            square += error * error;
            max = max.max(error);
        }
        let rows = expected.len() / num_actions;
        let own = got.chunks_exact(num_actions).map(best);
        let reference = expected.chunks_exact(num_actions).map(best);
        let same = own.zip(reference).filter(|(a, b)| a == b).count();
        Self {
            rms: (square / expected.len() as f64).sqrt(),
            max,
            same_action: same as f64 / rows as f64,
        }
    }
}

/// The place of the first largest value.
fn best<T: PartialOrd>(values: &[T]) -> usize {
    (1..values.len()).fold(
        0,
        |best, at| if values[at] > values[best] { at } else { best },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_compared_row_by_row() {
        let found = QError::of(&[1.0, 2.0, 5.0, 4.0], &[1.0, 2.5, 4.0, 4.5], 2);
        assert_eq!((found.max, found.same_action), (1.0, 0.5));
        assert!((found.rms - (1.5f64 / 4.0).sqrt()).abs() < 1e-12);
    }
}
