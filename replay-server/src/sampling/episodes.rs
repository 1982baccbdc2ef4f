//! From a stored episode to a row of a batch: which transitions can be an anchor, the steps that follow it, the frames of a state,
//! and what the row has beside them: a_t, a_{t+1}, the n-step return, and how far ahead s_{t+n} and s_{t+k} are, with each k drawn here.
//! It does not choose the anchor and reads no frame.

use driml_protocol::{End, FRAME_STACK_MAX, Horizon, NO_ACTION, RowScalars, RunSpec, TimeoutRule};
use rand::Rng;

use super::horizon::{self, Affinity};
use crate::{
    config,
    storage::ring::{Previous, Ring, Step},
};

/// An anchor t and what follows it: s_t, .., s_{t+m}, where m is the reach or the episode ends at s_{t+m}. Never empty.
#[derive(Default)]
pub(crate) struct Window {
    steps: Vec<(u64, Step)>,
}

impl Window {
    /// Index of s_{t+i} in the ring; i must not pass the end of the window.
    pub(crate) fn index(&self, i: usize) -> u64 {
        self.steps[i].0
    }

    /// Step t+i; i must not pass the end of the window.
    pub(crate) fn step(&self, i: usize) -> &Step {
        &self.steps[i].1
    }

    /// Steps t, t+1, .. to the end of the window.
    pub(crate) fn steps(&self) -> impl Iterator<Item = &Step> {
        self.steps.iter().map(|(_, step)| step)
    }
}

/// What a transition needs around it to be an anchor, and how its states are put together.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Episodes {
    /// Steps that must follow an anchor in its episode.
    pub(crate) reach: usize,
    pub(crate) frame_stack: usize,
    timeout: TimeoutRule,
}

impl Episodes {
    pub(crate) fn new(spec: &RunSpec) -> Self {
        Self {
            reach: config::reach(spec) as usize,
            frame_stack: spec.frame_stack as usize,
            timeout: spec.timeout,
        }
    }

    /// Whether the held transition `t` can be an anchor; if so, `window` is its window.
    ///
    /// It can if its stack's frames are held and `reach` steps follow it or its episode ends before. With
    /// `TimeoutRule::Bootstrap` a timed-out transition has no return at all, so it cannot.
    pub(crate) fn walk(&self, ring: &Ring, t: u64, window: &mut Window) -> bool {
        window.steps.clear();
        let mut index = t;
        loop {
            let step = *ring.step(index);
            window.steps.push((index, step));
            if step.end.is_episode_end() || window.steps.len() > self.reach {
                break;
            }
            match step.next() {
                Some(next) => index = next,
                None => return false,
            }
        }
        self.is_whole(ring, t)
    }

    /// Whether the held transition `t` has all but the steps that follow it: its stack's frames, and a return.
    pub(crate) fn is_whole(&self, ring: &Ring, t: u64) -> bool {
        let timed_out = ring.step(t).end == End::TimedOut && self.timeout == TimeoutRule::Bootstrap;
        !timed_out && self.stack_is_held(ring, t)
    }

    fn stack_is_held(&self, ring: &Ring, t: u64) -> bool {
        let mut index = t;
        for _ in 1..self.frame_stack {
            match ring.previous(index) {
                Previous::Start => return true,
                Previous::Held(previous) => index = previous,
                Previous::Gone => return false,
            }
        }
        true
    }

    /// The frames that make the state at `index`, as indices in the ring, oldest first.
    ///
    /// At the start of a level its first frame fills the slots of the frames before it. The stack must be held, which it is
    /// for every state of a window: it reaches back to the anchor's stack at most.
    pub(crate) fn stack(&self, ring: &Ring, mut index: u64) -> impl Iterator<Item = u64> {
        let mut indices = [index; FRAME_STACK_MAX as usize];
        for slot in (0..self.frame_stack - 1).rev() {
            match ring.previous(index) {
                Previous::Start => {}
                Previous::Held(previous) => index = previous,
                Previous::Gone => {
                    unreachable!("the stack of {index} was checked with its anchor")
                }
            }
            indices[slot] = index;
        }
        indices.into_iter().take(self.frame_stack)
    }
}

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
/// of the step that timed out and bootstraps from its state (`TimeoutRule::Bootstrap`).
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
