//! Whole replays: n-step returns and discounts, as their batches have them, and replays that hold no more than a row or a few need.

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, End, Horizon, InsertReply, RunSpec, Sampling, TimeoutRule,
};
use driml_replay_server::{Compression, Config, RETURN_ERROR, Replay, Unready, return_sum_error};
use rand::Rng;

use crate::stability::{
    edges::{clamped, exact_sum, finite, one_of},
    property::{Cases, broken},
};

/// Of a world whose frames are the number of their step.
pub(super) fn spec(n_step: u32, gamma: f64, timeout: TimeoutRule) -> RunSpec {
    RunSpec {
        world: "counter".into(),
        agent: "c51".into(),
        seed: 1,
        frame_height: 1,
        frame_width: 4,
        frame_channels: 1,
        frame_stack: 1,
        num_actions: 2,
        n_step,
        gamma,
        horizon: Horizon::None,
        timeout,
    }
}

/// Of a replay in which neither side waits and rows are drawn uniformly.
pub(super) const fn config(capacity_transitions: u64) -> Config {
    Config {
        capacity_transitions,
        shards: 1,
        compression: Compression::None,
        compressed_bytes_max: None,
        sampling: Sampling::Uniform,
        disk_bytes_max: None,
        fsync_ms: None,
        replay_ratio: 8.0,
        warmup_transitions: 0,
        slack_transitions: 1 << 40,
        transitions_max: None,
        since: None,
    }
}

/// A replay which actor 0 has joined.
pub(super) fn replay(spec: &RunSpec, rows: u32, config: &Config) -> anyhow::Result<Replay> {
    let mut replay = Replay::new(spec, config, rows)?;
    let join = ActorJoin {
        actor: 0,
        incarnation: 1,
    };
    replay.join_actor(join).map_err(anyhow::Error::msg)?;
    Ok(replay)
}

/// Steps of one stream as a chunk.
pub(super) fn chunk(steps: &[(f32, End)]) -> Chunk {
    let mut chunk = Chunk::zeroed(ChunkHeader {
        actor: 0,
        incarnation: 1,
        sequence: 0,
        first_transition: 0,
        weights_version: 0,
        leaving: false,
        streams: 1,
        steps: steps.len() as u32,
        frame_bytes: 4,
    });
    for (row, (reward, end)) in steps.iter().enumerate() {
        chunk
            .frame_mut(row)
            .copy_from_slice(&(row as u32).to_le_bytes());
        chunk.set(row, 1, *reward, *end);
    }
    chunk
}

/// The number that is frame `at` of a state [1, 4, stack].
pub(super) fn number(state: &[u8], stack: usize, at: usize) -> u64 {
    let byte = |i: usize| state[i * stack + at];
    u32::from_le_bytes([byte(0), byte(1), byte(2), byte(3)]).into()
}

/// One replay's steps.
struct Stream {
    n: usize,
    gamma: f64,
    timeout: TimeoutRule,
    steps: Vec<(f32, End)>,
}

impl Stream {
    /// Return of the row at step `t`, the sum of its terms' sizes, and its discount.
    fn expected(&self, t: usize) -> (f64, f64, f64) {
        let (mut terms, mut follows) = (Vec::new(), Some(self.n));
        for (i, (reward, end)) in self.steps[t..].iter().take(self.n).enumerate() {
            if *end == End::TimedOut && self.timeout == TimeoutRule::Bootstrap {
                follows = Some(i);
                break;
            }
            terms.push(self.gamma.powi(i as i32) * f64::from(*reward));
            if end.is_episode_end() {
                follows = None;
                break;
            }
        }
        let largest = f64::from(f32::MAX);
        let sizes = exact_sum(terms.iter().map(|term| term.abs()));
        let discount = follows.map_or(0.0, |i| self.gamma.powi(i as i32));
        (exact_sum(terms).clamp(-largest, largest), sizes, discount)
    }

    fn see(&self, extreme: &str, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let rows = 16;
        let spec = spec(self.n as u32, self.gamma, self.timeout);
        let mut replay = replay(&spec, rows, &config(4096))?;
        let stored = replay.insert(&chunk(&self.steps));
        let is_stored = matches!(stored, InsertReply::Stored { .. });
        anyhow::ensure!(
            is_stored,
            "a chunk within the limits was not stored: {stored:?}"
        );
        // An episode may have ended nowhere in reach.
        let Ok(batch) = replay.sample(rows) else {
            return Ok(());
        };
        let found = batch.n_step_returns().into_iter();
        let found = found.zip(batch.bootstrap_discounts());
        for (state, (found, discount)) in batch.states_t().chunks_exact(4).zip(found) {
            let t = number(state, 1, 0) as usize;
            let (expected, sizes, expected_discount) = self.expected(t);
            let least = f64::from(f32::MIN_POSITIVE);
            let allowed =
                RETURN_ERROR * expected.abs().max(least) + return_sum_error(self.n) * sizes;
            let of_return = (f64::from(found) - expected).abs() / allowed;
            let allowed = RETURN_ERROR * expected_discount.max(least);
            let of_discount = (f64::from(discount) - expected_discount).abs() / allowed;
            let (n, gamma) = (self.n, self.gamma);
            let input = format_args!("n = {n}, gamma = {gamma:e}, the row at {t}: {found:e}");
            cases.see(extreme, input, [of_return.max(of_discount)])?;
        }
        Ok(())
    }
}

fn ends(count: usize, likely: f64, rng: &mut impl Rng) -> Vec<End> {
    let mut end = || match rng.random_bool(likely) {
        true => one_of(&[End::Terminal, End::TimedOut, End::LevelChange], rng),
        false => End::Running,
    };
    (0..count).map(|_| end()).collect()
}

pub(crate) fn returns(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for n in [1usize, 7, 1000] {
        let count = 2 * n + 40;
        let most = f32::MAX / n as f32;
        let kinds = [
            [0.0; 3],
            [1e-45; 3],
            [1e30, 1.0, -1e30],
            [most; 3],
            [-most, most, 0.0],
        ];
        for gamma in [0.0, 1e-320, 0.5, 0.99, 1.0 - 1e-12, 1.0] {
            for (kind, rewards) in kinds.iter().enumerate() {
                let period = if kind == 4 { 2 } else { 3 };
                let rewards = rewards.iter().copied().take(period).cycle();
                for timeout in [TimeoutRule::Terminal, TimeoutRule::Bootstrap] {
                    let ends = ends(count, 0.5 / n as f64, &mut cases.rng);
                    let stream = Stream {
                        n,
                        gamma,
                        timeout,
                        steps: rewards.clone().zip(ends).collect(),
                    };
                    let extreme = "rewards 0, 1e-45, +-1e30 that cancel, 3.4e38 / n; n 1, 7, 1,000; gamma 0, 1e-320, 0.5, 0.99, 1 - 1e-12, 1";
                    stream.see(extreme, cases)?;
                }
            }
        }
    }
    for _ in cases.draws(0.1) {
        let rng = &mut cases.rng;
        let n = rng.random_range(1..60);
        let most = f32::MAX / n as f32;
        let count = n + rng.random_range(17..60);
        let ends = ends(count, rng.random_range(0.0..0.2), rng);
        let rewards = clamped(count, most, rng).into_iter();
        let stream = Stream {
            n,
            steps: rewards.zip(ends).collect(),
            gamma: match rng.random_range(0..3) {
                0 => rng.random(),
                1 => f64::from(finite(rng)).abs().min(1.0),
                _ => one_of(&[0.0, 1e-320, 0.99, 1.0 - 1e-12, 1.0], rng),
            },
            timeout: one_of(&[TimeoutRule::Terminal, TimeoutRule::Bootstrap], rng),
        };
        stream.see("drawn", cases)?;
    }
    Ok(())
}

/// Rows of a batch of a replay that holds little.
const ROWS: u32 = 4;

/// A replay's sizes.
#[derive(Clone, Copy, Debug)]
struct Sizes {
    capacity: u64,
    n_step: u32,
    frame_stack: u32,
}

impl Sizes {
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
        let anchors = oldest + lost..inserted.saturating_sub(self.n_step.into());
        let stack = self.frame_stack as usize;
        batch.states_t().chunks_exact(4 * stack).all(|state| {
            let newest = number(state, stack, stack - 1);
            let expected = |at| newest.saturating_sub((stack - 1 - at) as u64);
            anchors.contains(&newest)
                && (0..stack).all(|at| number(state, stack, at) == expected(at))
        }) && batch
            .n_step_returns()
            .iter()
            .all(|&sum| sum == self.n_step as f32)
            && batch.bootstrap_discounts().iter().all(|&rest| rest == 1.0)
    }

    fn see(self, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let Self {
            capacity,
            n_step,
            frame_stack,
        } = self;
        let spec = RunSpec {
            frame_stack,
            ..spec(n_step, 1.0, TimeoutRule::Terminal)
        };
        let found = replay(&spec, ROWS, &config(capacity));
        let is_small = capacity < u64::from(n_step) + u64::from(frame_stack);
        let name = format!("replay.capacity_transitions = {capacity} ");
        let said = found.as_ref().err().map(ToString::to_string);
        let right = match &said {
            Some(said) => is_small && said.contains(&name),
            None => !is_small,
        };
        let extreme =
            "capacities 1 to 8 and 1,000, n_step 1 to 8 and 1,000, 1, 2 and 4 frames a state";
        cases.see(extreme, format_args!("{self:?}: {said:?}"), [broken(right)])?;
        let Ok(mut replay) = found else {
            return Ok(());
        };
        let (mut inserted, mut sequence) = (0, 0);
        while inserted < 3 * capacity {
            let steps = cases.rng.random_range(1..=capacity.min(300));
            let mut chunk = chunk(&vec![(1.0, End::Running); steps as usize]);
            (chunk.header.sequence, chunk.header.first_transition) = (sequence, inserted);
            for (row, number) in (0..steps as usize).zip(inserted as u32..) {
                chunk.frame_mut(row).copy_from_slice(&number.to_le_bytes());
            }
            replay.insert(&chunk);
            inserted += steps;
            sequence += 1;
            let right = self.is_right(&mut replay, inserted);
            let extreme =
                "the same and 1,001 to 1,008, filled three times and more by chunks of any length";
            let input = format_args!("{self:?}, {inserted} stored");
            cases.see(extreme, input, [None, Some(broken(right))])?;
        }
        Ok(())
    }
}

pub(crate) fn capacity(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for n_step in (1..=8).chain([1000]) {
        for capacity in (1..=8).chain([1000, 1001, 1002, 1004, 1008]) {
            for frame_stack in [1, 2, 4] {
                let sizes = Sizes {
                    capacity,
                    n_step,
                    frame_stack,
                };
                sizes.see(cases)?;
            }
        }
    }
    Ok(())
}
