//! Clients of a benchmark take part in a run as actors and learner do.
//! What they then send is each bench's own.

use std::time::Duration;

use anyhow::Context;
use driml_protocol::{
    ActorJoin, Keys, LearnerJoin, Shutdown, WeightsHeader, WeightsUpload, codec, join, session,
};
use zenoh::{Session, Wait, liveliness::LivelinessToken, qos::Priority};

/// The life of an actor whose chunks [`super::recording`] makes.
pub(super) const EPOCH: u64 = 1;
/// The number of a benchmark's learner.
pub(super) const LEARNER: u64 = 1;
/// How long an upload may take.
const UPLOAD_MAX: Duration = Duration::from_secs(10);

/// Joins as an actor, which counts as connected until the result is dropped.
///
/// # Errors
/// The replay server does not answer or refuses.
pub(super) fn join_as_actor(
    session: &Session,
    keys: &Keys,
    spec_hash: u64,
    actor: u32,
) -> anyhow::Result<LivelinessToken> {
    let alive = alive(session, keys.actor_alive(actor, EPOCH))?;
    let join = ActorJoin {
        actor,
        epoch: EPOCH,
    };
    join::as_actor(session, keys, spec_hash, join, &Shutdown::default())?
        .context("nobody told this client to stop")?;
    Ok(alive)
}

/// Joins as the learner, which has learned from nothing and counts as connected until the result is dropped.
///
/// # Errors
/// As [`join_as_actor`].
pub(super) fn join_as_learner(
    session: &Session,
    keys: &Keys,
    spec_hash: u64,
) -> anyhow::Result<LivelinessToken> {
    let alive = alive(session, keys.learner_alive(LEARNER))?;
    let join = LearnerJoin {
        learner: LEARNER,
        rows_sampled: 0,
    };
    join::as_learner(session, keys, spec_hash, join, &Shutdown::default())?
        .context("nobody told this client to stop")?;
    Ok(alive)
}

fn alive(session: &Session, key: String) -> anyhow::Result<LivelinessToken> {
    let token = session.liveliness().declare_token(key).wait();
    token.map_err(|e| anyhow::anyhow!("declaring a client alive: {e}"))
}

/// Hands over weights, as the learner does after so many `updates`.
///
/// # Errors
/// The replay server does not answer or refuses.
pub(super) fn upload_weights(
    session: &Session,
    keys: &Keys,
    spec_hash: u64,
    updates: u64,
    weights: &[u8],
) -> anyhow::Result<()> {
    let upload = WeightsUpload {
        learner: LEARNER,
        weights: WeightsHeader::new(updates, updates, weights),
    };
    let head = codec::seal(spec_hash, &upload, weights)?;
    let message = session::join_planes(head, weights.to_vec().into());
    let key = keys.weights_upload();
    session::ask(session, &key, message, Priority::DataHigh, UPLOAD_MAX)?;
    Ok(())
}
