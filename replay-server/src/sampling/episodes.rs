//! Walks along stored episodes: which transitions can be an anchor, the steps that follow it, and the frames of a state.
//! It does not draw anchors and computes no returns.

use driml_protocol::{End, FRAME_STACK_MAX, RunSpec, TimeoutRule};

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
