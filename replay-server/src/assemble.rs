//! Writes one row of a batch: s_t, a_t, a_{t+1}, the n-step return, s_{t+n}, and s_{t+k} for each k, drawn here.
//! It does not choose the anchor.

use driml_protocol::{End, Horizon, NO_ACTION, RunSpec, TimeoutRule, batch::BatchRowsMut};
use rand::Rng;

use crate::{
    episodes::{Episodes, Window},
    horizon::{self, Affinity},
    ring::Ring,
};

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

    /// Writes the row of the window's anchor and gives its k, of several positives the furthest, 0 without any.
    pub(crate) fn write_row(
        &mut self,
        (ring, episodes, affinity): (&Ring, &Episodes, &Affinity),
        window: &Window,
        rng: &mut impl Rng,
        (rows, row): (&mut BatchRowsMut<'_>, usize),
    ) -> u32 {
        let anchor = window.step(0);
        let next_action = if anchor.end == End::Running {
            window.step(1).action
        } else {
            NO_ACTION
        };
        let (n_step_return, bootstrap) = self.n_step_return(window);
        let discount = bootstrap.map_or(0.0, |i| self.discounts[i]);
        rows.set(
            row,
            anchor.action,
            next_action,
            n_step_return as f32,
            discount as f32,
        );
        episodes.write_state(ring, window.index(0), rows.frame_t(row));
        match bootstrap {
            Some(i) => episodes.write_state(ring, window.index(i), rows.frame_n(row)),
            None => rows.frame_n(row).fill(0),
        }
        let drawn = self.draw_k(affinity, window, rng);
        for p in 0..self.horizon.positives() {
            let k = match self.horizon {
                Horizon::All { .. } => drawn.and_then(|furthest| horizon::all::k_of(p, furthest)),
                _ => drawn,
            };
            match k {
                Some(k) => {
                    episodes.write_state(ring, window.index(k as usize), rows.positive(p, row, k));
                }
                None => rows.no_positive(p, row),
            }
        }
        drawn.unwrap_or(0)
    }

    /// Sum of gamma^i r_{t+i} over i < n, and the i of the state to bootstrap from: n, unless the episode ended before.
    ///
    /// After a terminal step nothing follows. A time-out counts as one (`TimeoutRule::Terminal`), or cuts the return short
    /// of its own step and bootstraps from that step's state (`TimeoutRule::Bootstrap`).
    fn n_step_return(&self, window: &Window) -> (f64, Option<usize>) {
        let n = self.discounts.len() - 1;
        let mut sum = 0.0;
        for (i, step) in window.steps().take(n).enumerate() {
            if step.end == End::TimedOut && self.timeout == TimeoutRule::Bootstrap {
                return (sum, Some(i));
            }
            sum += self.discounts[i] * f64::from(step.reward);
            if step.end.is_episode_end() {
                return (sum, None);
            }
        }
        (sum, Some(n))
    }

    /// k, or none where no positive is served or a_t ended its episode or level.
    ///
    /// H is the number of states after s_t, at most k_max, that come before the end of the episode or level.
    fn draw_k(&mut self, affinity: &Affinity, window: &Window, rng: &mut impl Rng) -> Option<u32> {
        self.actions.clear();
        let same_level = window.steps().take_while(|step| step.end == End::Running);
        self.actions.extend(
            same_level
                .map(|step| step.action)
                .take(self.horizon.k_max() as usize),
        );
        if self.actions.is_empty() {
            return None;
        }
        horizon::draw_k(self.horizon, affinity, &self.actions, rng)
    }
}
