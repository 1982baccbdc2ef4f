//! The slow, obvious reference: every transition ever stored, stream by stream, and the expected content of rows.
//! It has no rings, links or windows.

use std::collections::BTreeMap;

use driml_protocol::{Chunk, ChunkHeader, End, Horizon, NO_ACTION, RunSpec, TimeoutRule};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// A transition, its index in the ring, and the version of the weights that chose its action.
#[derive(Clone, Debug)]
pub(crate) struct Record {
    pub(crate) index: u64,
    pub(crate) action: u8,
    pub(crate) reward: f32,
    pub(crate) end: End,
    pub(crate) weights_version: u64,
}

/// (actor, incarnation, stream, part). A part ends where transitions were lost.
pub(crate) type StreamKey = (u8, u8, u8, u8);

/// All transitions that were stored.
pub(crate) struct History {
    pub(crate) spec: RunSpec,
    pub(crate) capacity: u64,
    pub(crate) inserted: u64,
    /// Whether episodes and levels ever end.
    pub(crate) ends: bool,
    pub(crate) streams: BTreeMap<StreamKey, Vec<Record>>,
}

/// The expected content of a row. k is random, so only its maximum is known.
#[derive(Debug, PartialEq)]
pub(crate) struct Row {
    pub(crate) action: u8,
    pub(crate) next_action: u8,
    pub(crate) n_step_return: f64,
    pub(crate) discount: f64,
    pub(crate) bootstrap: Option<usize>,
    pub(crate) steps_left: usize,
}

pub(crate) fn spec(
    frame_channels: u32,
    frame_stack: u32,
    n_step: u32,
    horizon: Horizon,
) -> RunSpec {
    RunSpec {
        seed: 7,
        frame_height: 4,
        frame_width: 3,
        frame_channels,
        frame_stack,
        num_actions: 5,
        n_step,
        gamma: 0.9,
        horizon,
        ..RunSpec::smallest()
    }
}

pub(crate) fn random_end(rng: &mut ChaCha8Rng) -> End {
    match rng.random_range(0..20) {
        0 => End::Terminal,
        1 => End::TimedOut,
        2 => End::LevelChange,
        _ => End::Running,
    }
}

/// Returns a frame that begins with its identity; the other bytes depend on the identity and their position.
pub(crate) fn frame(spec: &RunSpec, key: StreamKey, step: usize) -> Vec<u8> {
    let id = [key.0, key.1, key.2, key.3, step as u8, (step >> 8) as u8];
    let hash = id.iter().fold(17u32, |hash, &b| {
        hash.wrapping_mul(31).wrapping_add(u32::from(b))
    });
    let fill = |at: usize| (hash.wrapping_mul(at as u32 + 1) >> 7) as u8;
    (0..spec.frame_bytes())
        .map(|at| id.get(at).copied().unwrap_or_else(|| fill(at)))
        .collect()
}

/// Returns the identity of the newest frame of a state.
pub(crate) fn identity(spec: &RunSpec, state: &[u8]) -> (StreamKey, usize) {
    let (channels, stack) = (spec.frame_channels as usize, spec.frame_stack as usize);
    let pixels = state.chunks(channels * stack);
    let newest = pixels.flat_map(|pixel| &pixel[channels * (stack - 1)..]);
    let id: Vec<u8> = newest.take(6).copied().collect();
    (
        (id[0], id[1], id[2], id[3]),
        usize::from(id[4]) + 256 * usize::from(id[5]),
    )
}

impl History {
    pub(crate) fn new(spec: &RunSpec, capacity: u64) -> Self {
        Self {
            spec: spec.clone(),
            capacity,
            inserted: 0,
            ends: true,
            streams: BTreeMap::new(),
        }
    }

    pub(crate) fn oldest(&self) -> u64 {
        self.inserted.saturating_sub(self.capacity)
    }

    /// Makes the next chunk of part `part` of an incarnation, and records it as stored.
    pub(crate) fn next_chunk(
        &mut self,
        header: ChunkHeader,
        part: u8,
        rng: &mut ChaCha8Rng,
    ) -> Chunk {
        let mut chunk = Chunk::zeroed(header);
        for stream in 0..header.streams {
            let key = (
                header.actor as u8,
                header.incarnation as u8,
                stream as u8,
                part,
            );
            let records = self.streams.entry(key).or_default();
            for step in 0..header.steps {
                let row = (stream * header.steps + step) as usize;
                let end = random_end(rng);
                let end = if self.ends { end } else { End::Running };
                let record = Record {
                    index: self.inserted,
                    action: rng.random_range(0..self.spec.num_actions as u8),
                    reward: rng.random_range(-3.0..3.0),
                    end,
                    weights_version: header.weights_version,
                };
                chunk.set(row, record.action, record.reward, end);
                chunk
                    .frame_mut(row)
                    .copy_from_slice(&frame(&self.spec, key, records.len()));
                records.push(record);
                self.inserted += 1;
            }
        }
        chunk
    }

    /// Returns the first step of the level of step `t`.
    fn level_start(records: &[Record], t: usize) -> usize {
        let ended = (0..t).rev().find(|&i| records[i].end != End::Running);
        ended.map_or(0, |i| i + 1)
    }

    /// Returns the steps whose frames make the state of step `t`, oldest first.
    fn stack_steps(&self, key: StreamKey, t: usize) -> Vec<usize> {
        let start = Self::level_start(&self.streams[&key], t);
        let stack = self.spec.frame_stack as usize;
        let step = |slot: usize| t.saturating_sub(stack - 1 - slot).max(start);
        (0..stack).map(step).collect()
    }

    pub(crate) fn state(&self, key: StreamKey, t: usize) -> Vec<u8> {
        let channels = self.spec.frame_channels as usize;
        let steps = self.stack_steps(key, t).into_iter();
        let frames: Vec<_> = steps.map(|step| frame(&self.spec, key, step)).collect();
        let pixels = 0..self.spec.frame_bytes() / channels;
        pixels
            .flat_map(|p| {
                frames
                    .iter()
                    .flat_map(move |f| &f[p * channels..(p + 1) * channels])
            })
            .copied()
            .collect()
    }

    /// Whether step `t` can be an anchor.
    pub(crate) fn is_valid(&self, key: StreamKey, t: usize) -> bool {
        let records = &self.streams[&key];
        let held = |step: &usize| records[*step].index >= self.oldest();
        let timed_out =
            records[t].end == End::TimedOut && self.spec.timeout == TimeoutRule::Bootstrap;
        if !held(&t) || timed_out || !self.stack_steps(key, t).iter().all(held) {
            return false;
        }
        // After a loss, the steps before the part's first step are unknown.
        let reaches_into_the_lost = t + 1 < self.spec.frame_stack as usize;
        if key.3 > 0 && reaches_into_the_lost && Self::level_start(records, t) == 0 {
            return false;
        }
        let reach = self.spec.n_step.max(self.spec.horizon.k_max()) as usize;
        let mut within = records[t..].iter().take(reach);
        let ends = within.any(|record| record.end.is_episode_end());
        ends || t + reach < records.len()
    }

    pub(crate) fn valid_anchors(&self) -> Vec<(StreamKey, usize)> {
        let all = self
            .streams
            .iter()
            .flat_map(|(&key, records)| (0..records.len()).map(move |t| (key, t)));
        all.filter(|&(key, t)| self.is_valid(key, t)).collect()
    }

    /// Returns the expected row of anchor `t`.
    pub(crate) fn row(&self, key: StreamKey, t: usize) -> Row {
        let records = &self.streams[&key];
        let n = self.spec.n_step as usize;
        let (mut sum, mut bootstrap) = (0.0, Some(n));
        for i in 0..n {
            let Record { reward, end, .. } = records[t + i];
            if end == End::TimedOut && self.spec.timeout == TimeoutRule::Bootstrap {
                bootstrap = Some(i);
                break;
            }
            sum += self.spec.gamma.powi(i as i32) * f64::from(reward);
            if end.is_episode_end() {
                bootstrap = None;
                break;
            }
        }
        let follow = records[t..].iter();
        let in_level = follow.take_while(|it| it.end == End::Running).count();
        Row {
            action: records[t].action,
            next_action: if records[t].end == End::Running {
                records[t + 1].action
            } else {
                NO_ACTION
            },
            n_step_return: sum,
            discount: bootstrap.map_or(0.0, |i| self.spec.gamma.powi(i as i32)),
            bootstrap,
            steps_left: in_level.min(self.spec.horizon.k_max() as usize),
        }
    }

    /// Returns the number of ended episodes, and the mean return of the last 100 that were seen completely.
    pub(crate) fn episodes(&self) -> (u64, Option<f64>) {
        let mut ended: Vec<(u64, Option<f64>)> = vec![];
        for (key, records) in &self.streams {
            let mut sum = (key.3 == 0).then_some(0.0);
            for record in records {
                sum = sum.map(|sum| sum + f64::from(record.reward));
                if record.end.is_episode_end() {
                    ended.push((record.index, sum.replace(0.0)));
                }
            }
        }
        ended.sort_by_key(|&(index, _)| index);
        let whole: Vec<f64> = ended.iter().filter_map(|&(_, sum)| sum).collect();
        let last = &whole[whole.len().saturating_sub(100)..];
        let mean = (!last.is_empty()).then(|| last.iter().sum::<f64>() / last.len() as f64);
        (ended.len() as u64, mean)
    }
}
