//! How much shared memory a run takes on one host, by its settings. It takes none.

use driml_protocol::{
    BatchHeader, RunSpec, TRANSITION_BYTES,
    config::Settings,
    shared_memory::{SESSION_BYTES, pool_bytes, process_bytes},
};

use super::{joining::SHARED_LIVES_MAX, limits::number};
use crate::config::Config;

/// Sessions of others at each replay server, which make no messages in shared memory: learner, launcher, and some that look.
const OTHER_SESSIONS: usize = 4;

/// Bytes of shared memory that so many replay servers of a run take on one host, with all of its actors, as far as the settings know
/// of them.
///
/// # Errors
/// Settings that are missing.
pub fn shared_memory_bytes(settings: &Settings, servers: u32) -> anyhow::Result<usize> {
    let spec: RunSpec = settings.table("run")?;
    let config: Config = settings.table("replay")?;
    let batch_size = number(settings, "learner", "batch_size")?;
    let batch = BatchHeader::of(&spec, batch_size).sampled_by(&config.sampling);
    let server = process_bytes(batch.pool_bytes()) + OTHER_SESSIONS * SESSION_BYTES;
    let actors = number(settings, "local", "actors").unwrap_or(1);
    let sharing = actors.min(SHARED_LIVES_MAX) as usize;
    let actor = process_bytes(chunk_pool_bytes(settings, &spec, actors as usize)?);
    let servers = (servers as usize).saturating_mul(server);
    Ok(servers.saturating_add(sharing.saturating_mul(actor)))
}

/// Bytes of each actor's pool where there are so many, as actors reckon how long their chunks are.
fn chunk_pool_bytes(settings: &Settings, spec: &RunSpec, actors: usize) -> anyhow::Result<usize> {
    let actor = |key| anyhow::Ok(number(settings, "actor", key)? as usize);
    let a_step = actor("envs")?;
    let round_steps = actor("round_transitions_max").map(|it| it / (a_step * actors).max(1));
    let steps = round_steps.unwrap_or(usize::MAX).max(1);
    let steps = steps.min(actor("steps_per_chunk")?);
    let chunk = a_step * steps * (spec.frame_bytes() + TRANSITION_BYTES);
    Ok(pool_bytes(actor("chunks_in_flight_max")? + 1, chunk))
}
