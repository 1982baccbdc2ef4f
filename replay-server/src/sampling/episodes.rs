//! Makes a row of a batch from a stored episode: decides which transitions can be anchors, finds an anchor's steps and a state's frames,
//! and computes the row's scalars: a_t, a_{t+1}, the n-step return, and the distances to s_{t+n} and s_{t+k}. Draws each k.
//! It does not choose the anchor and reads no frame.

use driml_protocol::{End, FRAME_STACK_MAX, Horizon, NO_ACTION, RowScalars, RunSpec, TimeoutRule};
use rand::Rng;

use super::horizon::{self, Affinity};
use crate::{
    config,
    storage::ring::{Previous, Ring, Step},
};

/// An anchor t and the steps after it: t, .., t+m, where m is `lookahead_steps`, or the episode ends with step t+m.
#[derive(Default)]
pub(crate) struct Window {
    steps: Vec<(u64, Step)>,
}

impl Window {
    /// Returns the ring index of s_{t+i}; i must not pass the end of the window.
    pub(crate) fn index(&self, i: usize) -> u64 {
        self.steps[i].0
    }

    /// Returns step t+i; i must not pass the end of the window.
    pub(crate) fn step(&self, i: usize) -> &Step {
        &self.steps[i].1
    }

    /// Returns the steps t, t+1, .. to the end of the window.
    pub(crate) fn steps(&self) -> impl Iterator<Item = &Step> {
        self.steps.iter().map(|(_, step)| step)
    }
}

/// The rules that decide which transitions can be anchors and which frames make a state.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AnchorRules {
    /// Steps that must follow an anchor, unless its episode ends before.
    pub(crate) lookahead_steps: usize,
    pub(crate) frame_stack: usize,
    timeout: TimeoutRule,
}

impl AnchorRules {
    pub(crate) fn new(spec: &RunSpec) -> Self {
        Self {
            lookahead_steps: config::lookahead_steps(spec) as usize,
            frame_stack: spec.frame_stack as usize,
            timeout: spec.timeout,
        }
    }

    /// Whether the held transition `t` can be an anchor; if so, `window` is its window.
    ///
    /// `t` can be an anchor if its stack's frames are held, and `lookahead_steps` steps follow it or its episode ends before. With
    /// `TimeoutRule::Bootstrap` a timed-out transition has no return, so it cannot be an anchor.
    pub(crate) fn find_window(&self, ring: &Ring, t: u64, window: &mut Window) -> bool {
        window.steps.clear();
        let mut index = t;
        loop {
            let step = *ring.step(index);
            window.steps.push((index, step));
            if step.end.is_episode_end() || window.steps.len() > self.lookahead_steps {
                break;
            }
            match step.next() {
                Some(next) => index = next,
                None => return false,
            }
        }
        self.has_return_and_stack(ring, t)
    }

    /// Whether the held transition `t` can be an anchor apart from the steps after it: it has a return, and its stack's frames are held.
    pub(crate) fn has_return_and_stack(&self, ring: &Ring, t: u64) -> bool {
        let timed_out = ring.step(t).end == End::TimedOut && self.timeout == TimeoutRule::Bootstrap;
        !timed_out && self.stack_indices(ring, t).is_some()
    }

    /// Returns the ring indices of the frames that make the state at `index`, oldest first; `None` if one of them is gone. If an anchor's
    /// stack is held, so is that of every state of its window, as none reaches further back.
    ///
    /// At the start of a level, the level's first frame also takes the places of the frames before it.
    pub(crate) fn stack_indices(
        &self,
        ring: &Ring,
        mut index: u64,
    ) -> Option<impl Iterator<Item = u64>> {
        let mut indices = [index; FRAME_STACK_MAX as usize];
        for slot in (0..self.frame_stack - 1).rev() {
            match ring.previous(index) {
                Previous::Start => {}
                Previous::Held(previous) => index = previous,
                Previous::Gone => return None,
            }
            indices[slot] = index;
        }
        Some(indices.into_iter().take(self.frame_stack))
    }
}

/// Computes the scalars of a row, among them the return and k. Its scratch space saves an allocation per row.
pub(crate) struct RowAssembler {
    horizon: Horizon,
    timeout: TimeoutRule,
    /// gamma^0 ..= gamma^n.
    discounts: Vec<f64>,
    actions: Vec<u8>,
}

impl RowAssembler {
    pub(crate) fn new(spec: &RunSpec) -> Self {
        let powers = std::iter::successors(Some(1.0), |power| Some(power * spec.gamma));
        Self {
            horizon: spec.horizon,
            timeout: spec.timeout,
            discounts: powers.take(spec.n_step as usize + 1).collect(),
            actions: Vec::with_capacity(spec.horizon.k_max() as usize),
        }
    }

    /// Computes the row of the anchor of `window`. Also returns the i of the state s_{t+i} to bootstrap from, if any.
    pub(crate) fn assemble(
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
        let (n_step_return, after) = n_step_return(&self.discounts, self.timeout, window.steps());
        // A bootstrap state with discount 0 is not sent.
        let bootstrap = after.filter(|&i| self.discounts[i] as f32 != 0.0);
        self.actions.clear();
        let same_level = window.steps().take_while(|step| step.end == End::Running);
        let actions = same_level.map(|step| step.action);
        self.actions
            .extend(actions.take(self.horizon.k_max() as usize));
        let furthest = horizon::draw_k(self.horizon, affinity, &self.actions, rng);
        let k_first = match self.horizon.positives() {
            2.. => 1,
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

/// Maximum relative error of a return in a batch, from the rounding to f32. For returns below 1.2e-38, the smallest normal f32, it is
/// relative to 1.2e-38.
pub const RETURN_ERROR: f64 = 6.1e-8;

/// Returns the maximum error of a return of `n` terms before that rounding, relative to the sum of their absolute values, as terms may
/// cancel. The causes are the f64 roundings of each power of gamma, product and sum.
pub fn return_sum_error(n: usize) -> f64 {
    (2 * n + 2) as f64 * f64::EPSILON / 2.0
}

/// Returns the sum of gamma^i r_{t+i} over i < n, and the i of the state to bootstrap from: n, or none if the episode ended before.
/// `discounts` are gamma^0 to gamma^n. The sum is f64, so that rewards of very different sizes cancel correctly. Its error is
/// [`return_sum_error`].
///
/// A time-out counts as a terminal step (`TimeoutRule::Terminal`), or it ends the return before the step that timed out and bootstraps
/// from that step's state (`TimeoutRule::Bootstrap`).
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

/// Rounds a return to f32, with the error [`RETURN_ERROR`], and clamps it to the finite range, which rewards at their limit may exceed by
/// rounding. A learner rejects returns that are not finite; the projection maps both values to the end of the support.
fn return_f32(sum: f64) -> f32 {
    sum.clamp(f32::MIN.into(), f32::MAX.into()) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// For some n, the sum of the largest rewards that the replay server accepts rounds to more than the largest f32.
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
