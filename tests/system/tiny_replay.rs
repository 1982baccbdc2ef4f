//! A real replay of tiny frames, for tests that play the replay server themselves.

use std::collections::BTreeSet;

use driml_protocol::{ActorJoin, Buffer, Chunk, ChunkHeader, Horizon, RequestId, RunSpec};
use driml_replay_server::{Config, Replay};

/// Returns a run spec with frames of 4 x 4 bytes that are not stacked.
pub(crate) fn spec(agent: &str, horizon: Horizon) -> RunSpec {
    RunSpec {
        world: "chain".into(),
        agent: agent.into(),
        frame_height: 4,
        frame_width: 4,
        num_actions: 3,
        horizon,
        ..RunSpec::smallest()
    }
}

/// Returns a config of one shard of `transitions`, each sampled once. The shard can be filled before any is sampled.
pub(crate) fn config(transitions: u64) -> Config {
    Config {
        replay_ratio: 1.0,
        slack_transitions: transitions,
        ..Config::unlimited(transitions)
    }
}

/// The incarnation of every actor.
const INCARNATION: u64 = 1;

pub(crate) fn join_actor(replay: &mut Replay, actor: u32) {
    let join = ActorJoin::new(actor, INCARNATION);
    replay.join_actor(join).unwrap();
}

/// Returns the header of the first chunk of an actor in a run with this spec.
pub(crate) fn header(spec: &RunSpec, actor: u32, streams: u32, steps: u32) -> ChunkHeader {
    ChunkHeader {
        actor,
        incarnation: INCARNATION,
        streams,
        steps,
        frame_bytes: spec.frame_bytes() as u32,
        ..ChunkHeader::default()
    }
}

/// Returns an actor's chunk of `steps` steps of one environment, all zeros; earlier chunks have the same length.
pub(crate) fn chunk(spec: &RunSpec, actor: u32, sequence: u64, steps: u32) -> Chunk {
    Chunk::zeroed(ChunkHeader {
        sequence,
        first_transition: sequence * u64::from(steps),
        ..header(spec, actor, 1, steps)
    })
}

/// Returns the returns in the rows of `batches` batches, as integers. If transitions are whole episodes, these are their rewards.
pub(crate) fn drawn_returns(replay: &mut Replay, batches: u64, rows: u32) -> BTreeSet<u64> {
    let mut drawn = BTreeSet::new();
    let mut request = RequestId::first(1);
    for _ in 0..batches {
        let batch = replay.draw_for(request, rows, Buffer::zeroed).unwrap();
        let returns = batch.unpack().n_step_returns();
        drawn.extend(returns.into_iter().map(|it| it as u64));
        request = request.next();
    }
    drawn
}
