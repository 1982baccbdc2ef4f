//! Whole replays that nobody else uses, and the chunks that are stored in them.
//! What is right of their batches is each routine's own affair.

use driml_protocol::{ActorJoin, Chunk, ChunkHeader, End, Horizon, RunSpec, Sampling, TimeoutRule};
use driml_replay_server::{Compression, Config, Replay};

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

/// A replay in which nobody waits, and which actor 0 has joined.
pub(super) fn replay(spec: &RunSpec, rows: u32) -> anyhow::Result<Replay> {
    replay_of(spec, rows, 4096)
}

/// [`replay`] that holds so many transitions.
pub(super) fn replay_of(
    spec: &RunSpec,
    rows: u32,
    capacity_transitions: u64,
) -> anyhow::Result<Replay> {
    replay_with(spec, rows, &config(capacity_transitions))
}

/// Of a replay in which nobody waits and rows are drawn uniformly.
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
pub(super) fn replay_with(spec: &RunSpec, rows: u32, config: &Config) -> anyhow::Result<Replay> {
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
