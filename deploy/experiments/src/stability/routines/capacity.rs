//! Replays that hold no more than a row or a few need.

use driml_protocol::{End, RunSpec, TimeoutRule};
use driml_replay_server::{Replay, Unready};
use rand::Rng;

use super::replays::{chunk, replay_of, spec};
use crate::stability::check::{Context, Routine, Row};

const CAPACITY: Routine = Routine {
    name: "replay",
    range: "capacities from n_step + frame_stack on; n_step 1 to 1,000",
};
/// Rows of a batch.
const ROWS: u32 = 4;

/// Stores so many further steps of a reward of 1, whose frames are their numbers.
fn insert(replay: &mut Replay, sequence: u64, inserted: u64, steps: usize) {
    let mut chunk = chunk(&vec![(1.0, End::Running); steps]);
    (chunk.header.sequence, chunk.header.first_transition) = (sequence, inserted);
    for (row, number) in (0..steps).zip(inserted as u32..) {
        chunk.frame_mut(row).copy_from_slice(&number.to_le_bytes());
    }
    replay.insert(&chunk);
}

/// A replay's sizes.
#[derive(Clone, Copy, Debug)]
struct Sizes {
    capacity: u64,
    n_step: u32,
    frame_stack: u32,
}

impl Sizes {
    /// The least capacity that holds a row.
    fn window(self) -> u64 {
        u64::from(self.n_step) + u64::from(self.frame_stack)
    }

    /// Whether a batch is of states that are held, frame by frame, with returns of n rewards of 1; or there is none, where too few
    /// are held.
    fn is_right(self, replay: &mut Replay, inserted: u64) -> bool {
        let held = inserted.min(self.capacity);
        let oldest = inserted - held;
        // Where the stream's first step is held, its frame serves for those before it.
        let lost = if oldest == 0 {
            0
        } else {
            u64::from(self.frame_stack) - 1
        };
        let batch = match replay.sample(ROWS) {
            Ok(batch) => batch,
            Err(why) => {
                let is_too_few = held < lost + u64::from(self.n_step) + 1;
                return is_too_few && matches!(why, Unready::Wait(_));
            }
        };
        let anchors = oldest + lost..(inserted).saturating_sub(self.n_step.into());
        let stack = self.frame_stack as usize;
        let states = batch.states_t();
        let mut right = states.chunks_exact(4 * stack).map(|state| {
            let newest = number(state, stack, stack - 1);
            let mut frames = (0..stack).map(|at| (number(state, stack, at), stack - 1 - at));
            anchors.contains(&newest)
                && frames.all(|(found, before)| found == newest.saturating_sub(before as u64))
        });
        right.all(|right| right)
            && batch
                .n_step_returns()
                .iter()
                .all(|&sum| sum == self.n_step as f32)
            && batch.bootstrap_discounts().iter().all(|&rest| rest == 1.0)
    }
}

/// The number that is frame `at` of a state [1, 4, stack].
fn number(state: &[u8], stack: usize, at: usize) -> u64 {
    let byte = |i: usize| state[i * stack + at];
    u32::from_le_bytes([byte(0), byte(1), byte(2), byte(3)]).into()
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut refused = Row::new(
        CAPACITY,
        "capacities 1 to 8 and 1,000, n_step 1 to 8 and 1,000, 1, 2 and 4 frames a state",
        "capacities below n_step + frame_stack that are not refused by name, or others that are",
        0.0,
    );
    let mut filled = Row::new(
        CAPACITY,
        "the same and 1,001 to 1,008, filled three times and more by chunks of any length",
        "batches with a frame that is not held or of another step, or a return that is not n; none, or one too early",
        0.0,
    );
    let n_steps = (1..=8).chain([1000]);
    let capacities = (1..=8).chain([1000, 1001, 1002, 1004, 1008]);
    for (n_step, capacity) in
        n_steps.flat_map(|n_step| capacities.clone().map(move |capacity| (n_step, capacity)))
    {
        for frame_stack in [1, 2, 4] {
            let sizes = Sizes {
                capacity,
                n_step,
                frame_stack,
            };
            let spec = RunSpec {
                frame_stack,
                ..spec(n_step, 1.0, TimeoutRule::Terminal)
            };
            let mut replay = match replay_of(&spec, ROWS, capacity) {
                Ok(replay) => replay,
                Err(e) => {
                    let name = format!("replay.capacity_transitions = {capacity} ");
                    let is_small = capacity < sizes.window();
                    refused.must(is_small && e.to_string().contains(&name), || {
                        format!("{sizes:?}: {e}")
                    });
                    continue;
                }
            };
            refused.must(capacity >= sizes.window(), || format!("{sizes:?}"));
            let (mut inserted, mut sequence) = (0, 0);
            while inserted < 3 * capacity {
                let most = capacity.min(300);
                let steps = context.rng.random_range(1..=most);
                insert(&mut replay, sequence, inserted, steps as usize);
                inserted += steps;
                sequence += 1;
                let right = sizes.is_right(&mut replay, inserted);
                filled.must(right, || format!("{sizes:?}, {inserted} stored"));
            }
        }
        context.progress.advance(0)?;
    }
    Ok(vec![refused, filled])
}
