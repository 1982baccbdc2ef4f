//! Limits that follow from a run's settings: the maximum bytes of each kind of message (longer ones are foreign) and of shared memory.

use anyhow::Context;
use driml_protocol::{
    BatchHeader, RunSpec, TRANSITION_BYTES,
    config::Settings,
    shared_memory::{SESSION_BYTES, pool_bytes, process_bytes},
    transitions_max,
};

use crate::config::Config;

/// Maximum bytes of a message without its payload: prefix and header.
pub(super) const HEAD_BYTES_MAX: usize = 1 << 12;

/// Maximum actor incarnations that may send through shared memory; later ones use sockets. A reader keeps its mappings until it exits,
/// even if the writer has exited (zenoh issue 2571): about 3 MiB and two descriptors per incarnation.
pub(super) const SHARED_INCARNATIONS_MAX: u32 = 128;

/// Other sessions at each replay server, which send nothing through shared memory: learner, launcher, and some status clients.
const OTHER_SESSIONS: usize = 4;

const PRIORITY_BYTES_MAX: usize = 9 + 4;

/// Maximum bytes of each kind of message.
#[derive(Clone, Copy, Debug)]
pub(super) struct MessageLimits {
    pub(super) chunk: usize,
    pub(super) weights: usize,
    /// An affinity matrix, which is part of the header.
    pub(super) affinity: usize,
    /// Priorities of a batch's rows, which are part of the header.
    pub(super) priorities: usize,
    pub(super) batch_rows_max: u32,
}

impl MessageLimits {
    pub(super) fn from_settings(
        settings: &Settings,
        spec: &RunSpec,
        weights_bytes: usize,
    ) -> anyhow::Result<Self> {
        let actor = |key| read_u32(settings, "actor", key);
        // A missing setting sets no limit.
        let round_max = actor("round_transitions_max").ok().map(u64::from);
        let transitions = transitions_max(actor("envs")?, actor("steps_per_chunk")?, round_max);
        let transition_bytes = (spec.frame_bytes() + TRANSITION_BYTES) as u64;
        let chunk = usize::try_from(transitions.saturating_mul(transition_bytes))?;
        let actions = spec.num_actions as usize;
        let batch_rows_max = read_u32(settings, "learner", "batch_size")?;
        Ok(Self {
            chunk: chunk.saturating_add(HEAD_BYTES_MAX),
            // Twice as many, for a learner that encodes the same numbers at greater length.
            weights: weights_bytes
                .saturating_mul(2)
                .saturating_add(HEAD_BYTES_MAX),
            affinity: 4 * actions * actions + HEAD_BYTES_MAX,
            priorities: PRIORITY_BYTES_MAX * batch_rows_max as usize + 2 * HEAD_BYTES_MAX,
            batch_rows_max,
        })
    }

    pub(super) fn largest_bytes(&self) -> usize {
        let learned = self.weights.max(self.affinity).max(self.priorities);
        self.chunk.max(learned)
    }
}

/// Reads an integer from the settings of another process.
pub(super) fn read_u32(settings: &Settings, table: &'static str, key: &str) -> anyhow::Result<u32> {
    let values: toml::Table = settings.table(table)?;
    let value = values.get(key).and_then(toml::Value::as_integer);
    let value = value.with_context(|| format!("{table}.{key} is missing or not a whole number"))?;
    u32::try_from(value).with_context(|| format!("{table}.{key} = {value} cannot work"))
}

/// Returns the bytes of shared memory that `servers` replay servers of a run use on one host, with all actors that the settings name.
pub fn shared_memory_bytes(settings: &Settings, servers: u32) -> anyhow::Result<usize> {
    let spec: RunSpec = settings.table("run")?;
    let config: Config = settings.table("replay")?;
    let batch_size = read_u32(settings, "learner", "batch_size")?;
    let batch = BatchHeader::largest(&spec, batch_size).with_sampling(&config.sampling);
    let server = process_bytes(batch.pool_bytes()) + OTHER_SESSIONS * SESSION_BYTES;
    let actors = read_u32(settings, "local", "actors").unwrap_or(1);
    let sharing_actors = actors.min(SHARED_INCARNATIONS_MAX) as usize;
    let actor = process_bytes(chunk_pool_bytes(settings, &spec, actors as usize)?);
    let servers = (servers as usize).saturating_mul(server);
    Ok(servers.saturating_add(sharing_actors.saturating_mul(actor)))
}

/// Returns the bytes of each actor's pool if `actors` actors run. Computes the length of chunks as actors do.
fn chunk_pool_bytes(settings: &Settings, spec: &RunSpec, actors: usize) -> anyhow::Result<usize> {
    let actor = |key| anyhow::Ok(read_u32(settings, "actor", key)? as usize);
    let envs = actor("envs")?;
    let round_steps = actor("round_transitions_max").map(|it| it / (envs * actors).max(1));
    let steps = round_steps.unwrap_or(usize::MAX).max(1);
    let steps = steps.min(actor("steps_per_chunk")?);
    let chunk = envs * steps * (spec.frame_bytes() + TRANSITION_BYTES);
    Ok(pool_bytes(actor("chunks_in_flight_max")? + 1, chunk))
}
