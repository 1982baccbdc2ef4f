//! Replays that hold no more than a row or a few need.

use driml_protocol::{End, TimeoutRule};
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

/// Whether a batch is of transitions that are held, with returns of `n` rewards of 1; or there is none, where too few are held.
fn is_right(replay: &mut Replay, n: u32, inserted: u64, capacity: u64) -> bool {
    let held = inserted.min(capacity);
    let needed = u64::from(n) + 1;
    let batch = match replay.sample(ROWS) {
        Ok(batch) => batch,
        Err(why) => return held < needed && matches!(why, Unready::Wait(_)),
    };
    let anchors = inserted - held..(inserted + 1).saturating_sub(needed);
    let states = batch.states_t();
    let mut numbers = states
        .chunks_exact(4)
        .map(|frame| u64::from(u32::from_le_bytes([frame[0], frame[1], frame[2], frame[3]])));
    numbers.all(|number| anchors.contains(&number))
        && batch.n_step_returns().iter().all(|&sum| sum == n as f32)
        && batch.bootstrap_discounts().iter().all(|&rest| rest == 1.0)
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut refused = Row::new(
        CAPACITY,
        "capacities 1 to 8 and 1,000, n_step 1 to 8 and 1,000",
        "capacities below n_step + 1 that are not refused by name, or others that are",
        0.0,
    );
    let mut filled = Row::new(
        CAPACITY,
        "capacities to 8 and 1,001 to 1,008, filled three times and more by chunks of any length",
        "batches with a row that is not held or a return that is not n; none, or one too early",
        0.0,
    );
    for n in (1..=8).chain([1000]) {
        for capacity in (1..=8).chain([1000, 1001, 1002, 1008]) {
            let input = || format!("capacity {capacity}, n_step {n}");
            let spec = spec(n, 1.0, TimeoutRule::Terminal);
            let mut replay = match replay_of(&spec, ROWS, capacity) {
                Ok(replay) => replay,
                Err(e) => {
                    let name = format!("replay.capacity_transitions = {capacity} ");
                    let is_small = capacity <= u64::from(n);
                    refused.must(is_small && e.to_string().contains(&name), input);
                    continue;
                }
            };
            refused.must(capacity > u64::from(n), input);
            let (mut inserted, mut sequence) = (0, 0);
            while inserted < 3 * capacity {
                let most = capacity.min(300);
                let steps = context.rng.random_range(1..=most);
                insert(&mut replay, sequence, inserted, steps as usize);
                inserted += steps;
                sequence += 1;
                let right = is_right(&mut replay, n, inserted, capacity);
                filled.must(right, || {
                    format!("capacity {capacity}, n_step {n}, {inserted} stored")
                });
            }
        }
        context.progress.advance(0)?;
    }
    Ok(vec![refused, filled])
}
