//! A real replay of tiny frames, for tests that play the replay server themselves.

use std::collections::BTreeSet;

use driml_protocol::{ActorJoin, Buffer, Chunk, ChunkHeader, Horizon, RequestId, RunSpec};
use driml_replay_server::{Config, Replay};

/// Frames of 4 x 4 bytes that are not stacked.
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

/// One shard of `transitions`, each sampled once; as many may come before any is sampled.
pub(crate) fn config(transitions: u64) -> Config {
    Config {
        replay_ratio: 1.0,
        slack_transitions: transitions,
        ..Config::unlimited(transitions)
    }
}

/// The incarnation of every actor.
const INCARNATION: u64 = 1;

/// Lets an actor take part.
pub(crate) fn join(replay: &mut Replay, actor: u32) {
    let join = ActorJoin {
        actor,
        incarnation: INCARNATION,
    };
    replay.join_actor(join).unwrap();
}

/// The first chunk of an actor of any run.
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

/// An actor's chunk of `steps` steps of one environment, all zeroes; the ones before it were as long.
pub(crate) fn chunk(spec: &RunSpec, actor: u32, sequence: u64, steps: u32) -> Chunk {
    Chunk::zeroed(ChunkHeader {
        sequence,
        first_transition: sequence * u64::from(steps),
        ..header(spec, actor, 1, steps)
    })
}

/// The returns of the rows of so many batches, as numbers: of transitions that are episodes of their own, their rewards.
pub(crate) fn numbers(replay: &mut Replay, batches: u64, rows: u32) -> BTreeSet<u64> {
    let mut numbers = BTreeSet::new();
    let mut request = RequestId::first(1);
    for _ in 0..batches {
        let batch = replay.draw_for(request, rows, Buffer::zeroed).unwrap();
        let returns = batch.unpack().n_step_returns();
        numbers.extend(returns.into_iter().map(|it| it as u64));
        request = request.next();
    }
    numbers
}
