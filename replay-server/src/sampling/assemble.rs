//! Makes one row of a batch: a_t, a_{t+1}, the n-step return, how far ahead s_{t+n} and s_{t+k} are, with each k drawn here.
//! It does not choose the anchor and reads no frame.

use driml_protocol::{End, Horizon, NO_ACTION, RowScalars, RunSpec, TimeoutRule};
use rand::Rng;

use super::{
    episodes::Window,
    horizon::{self, Affinity},
};
use crate::storage::ring::Step;

/// The rules of return and positive, and scratch space so that a row allocates nothing.
pub(crate) struct Assembler {
    horizon: Horizon,
    timeout: TimeoutRule,
    /// gamma^0 ..= gamma^n.
    discounts: Vec<f64>,
    actions: Vec<u8>,
}

impl Assembler {
    pub(crate) fn new(spec: &RunSpec) -> Self {
        let powers = std::iter::successors(Some(1.0), |power| Some(power * spec.gamma));
        Self {
            horizon: spec.horizon,
            timeout: spec.timeout,
            discounts: powers.take(spec.n_step as usize + 1).collect(),
            actions: Vec::with_capacity(spec.horizon.k_max() as usize),
        }
    }

    /// The row of the anchor that `window` begins with, and the i of the state s_{t+i} that it bootstraps from, if it does.
    pub(crate) fn row(
        &mut self,
        affinity: &Affinity,
        window: &Window,
        rng: &mut impl Rng,
    ) -> (RowScalars, Option<usize>) {
        let anchor = window.step(0);
        let next_action = if anchor.end == End::Running {
            window.step(1).action
        } else {
            NO_ACTION
        };
        let (n_step_return, follows) = n_step_return(&self.discounts, self.timeout, window.steps());
        // A state that counts for nothing does not travel.
        let bootstrap = follows.filter(|&i| self.discounts[i] as f32 != 0.0);
        self.actions.clear();
        let same_level = window.steps().take_while(|step| step.end == End::Running);
        let actions = same_level.map(|step| step.action);
        self.actions
            .extend(actions.take(self.horizon.k_max() as usize));
        let furthest = horizon::draw_k(self.horizon, affinity, &self.actions, rng);
        let k_first = match self.horizon {
            Horizon::All { .. } => 1,
            _ => furthest,
        };
        let scalars = RowScalars {
            action: anchor.action,
            next_action,
            n_step_return: return_f32(n_step_return),
            bootstrap_discount: bootstrap.map_or(0.0, |i| self.discounts[i] as f32),
            positives: match furthest {
                0 => 0,
                _ => furthest + 1 - k_first,
            },
            k_first,
        };
        (scalars, bootstrap)
    }
}

/// Largest error of a return that is sent, as a share of it (of 1.2e-38, the least normal number, if that is larger): an f32's last
/// place.
pub const RETURN_ERROR: f64 = 6.1e-8;

/// Largest error of the sum of `n` terms beside that, as a share of the sum of their sizes, as they may cancel: the rounding in f64 of
/// each power of gamma, product and sum.
pub fn return_sum_error(n: usize) -> f64 {
    (2 * n + 2) as f64 * f64::EPSILON / 2.0
}

/// Sum of gamma^i r_{t+i} over i < n, and the i of the state to bootstrap from: n, unless the episode ended before.
/// `discounts` are gamma^0 to gamma^n. The sum is f64, so that rewards of very different sizes cancel as they should: it is right to
/// [`return_sum_error`].
///
/// After a terminal step nothing follows. A time-out counts as one (`TimeoutRule::Terminal`), or cuts the return short
/// of its own step and bootstraps from that step's state (`TimeoutRule::Bootstrap`).
fn n_step_return<'a>(
    discounts: &[f64],
    timeout: TimeoutRule,
    steps: impl Iterator<Item = &'a Step>,
) -> (f64, Option<usize>) {
    let n = discounts.len() - 1;
    let mut sum = 0.0;
    for (i, step) in steps.take(n).enumerate() {
        if step.end == End::TimedOut && timeout == TimeoutRule::Bootstrap {
            return (sum, Some(i));
        }
        sum += discounts[i] * f64::from(step.reward);
        if step.end.is_episode_end() {
            return (sum, None);
        }
    }
    (sum, Some(n))
}

/// A return as it travels. One beyond the finite f32, as rewards at their limit may round to, is the largest there is: the
/// projection takes both for the end of the support, and a learner refuses what is not finite. Right to [`RETURN_ERROR`].
fn return_f32(sum: f64) -> f32 {
    sum.clamp(f32::MIN.into(), f32::MAX.into()) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rewards at the limit that the replay server sets, whose sum rounds to more than a float can be for some n.
    #[test]
    fn a_return_is_a_number_whatever_the_rewards() {
        for n in 1..=1000u16 {
            let reward = f32::MAX / f32::from(n);
            let sum = f64::from(n) * f64::from(reward);
            let found = [return_f32(sum), -return_f32(-sum)];
            let whole = found
                .iter()
                .all(|r| (f32::MAX * 0.999_999..=f32::MAX).contains(r));
            assert!(whole, "{n} steps of {reward:e}: {found:?}");
        }
        assert_eq!(
            (return_f32(1e300), return_f32(-1e300)),
            (f32::MAX, f32::MIN)
        );
        assert_eq!((return_f32(0.1), return_f32(1e-300)), (0.1, 0.0));
    }
}
