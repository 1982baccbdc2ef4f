//! Clients of a benchmark take part in a run as actors and learner do.
//! What they then send is each bench's own.

use std::time::Duration;

use anyhow::Context;
use driml_protocol::{
    ActorJoin, Alive, LearnerJoin, RunClient, Shutdown, Tally, WeightsHeader, WeightsUpload, join,
};
use zenoh::liveliness::LivelinessToken;

/// The life of an actor whose chunks [`super::recording`] makes.
pub(super) const INCARNATION: u64 = 1;
/// The number of a benchmark's learner.
pub(super) const LEARNER: u64 = 1;
/// How long an upload may take.
const UPLOAD_MAX: Duration = Duration::from_secs(10);

/// Joins as an actor, which counts as connected until the result is dropped.
///
/// # Errors
/// The replay server does not answer or refuses.
pub(super) fn join_as_actor(client: &RunClient, actor: u32) -> anyhow::Result<LivelinessToken> {
    let alive = alive(client, Alive::actor(actor, INCARNATION))?;
    let join = ActorJoin {
        actor,
        incarnation: INCARNATION,
    };
    join::as_actor(client, join, &Shutdown::default())?
        .context("nobody told this client to stop")?;
    Ok(alive)
}

/// Joins as the learner, which has learned from nothing and counts as connected until the result is dropped.
///
/// # Errors
/// As [`join_as_actor`].
pub(super) fn join_as_learner(client: &RunClient) -> anyhow::Result<LivelinessToken> {
    let alive = alive(client, Alive::learner(LEARNER))?;
    let join = LearnerJoin {
        learner: LEARNER,
        run: LEARNER,
        updates: 0,
        tally: Tally::default(),
        other_shards: Tally::default(),
        restart: false,
    };
    join::as_learner(client, join, &Shutdown::default())?
        .context("nobody told this client to stop")?;
    Ok(alive)
}

fn alive(client: &RunClient, who: Alive) -> anyhow::Result<LivelinessToken> {
    let token = client.declare_alive(who);
    token.map_err(|e| anyhow::anyhow!("declaring a client alive: {e}"))
}

/// Hands over weights, as the learner does after `updates` updates.
///
/// # Errors
/// The replay server does not answer or refuses.
pub(super) fn upload_weights(
    client: &RunClient,
    updates: u64,
    weights: &[u8],
) -> anyhow::Result<()> {
    let upload = WeightsUpload {
        learner: LEARNER,
        weights: WeightsHeader::new(updates, updates, weights),
    };
    let sealed = client.seal_with(&upload, weights.to_vec().into())?;
    client.send(sealed, UPLOAD_MAX)?.wait()?;
    Ok(())
}
