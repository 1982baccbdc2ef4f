//! Clients of a benchmark take part in a run as actors and learner do.
//! They declare no liveliness: nobody else plays their part.

use anyhow::Context;
use driml_protocol::{ActorJoin, Keys, LearnerJoin, Shutdown, join};
use zenoh::Session;

/// The life of an actor whose chunks [`super::recording`] makes.
pub(super) const EPOCH: u64 = 1;
/// The number of a benchmark's learner.
pub(super) const LEARNER: u64 = 1;

/// Joins as an actor.
///
/// # Errors
/// The replay server does not answer or refuses.
pub(super) fn join_as_actor(
    session: &Session,
    keys: &Keys,
    spec_hash: u64,
    actor: u32,
) -> anyhow::Result<()> {
    let join = ActorJoin {
        actor,
        epoch: EPOCH,
    };
    join::as_actor(session, keys, spec_hash, join, &Shutdown::default())?
        .context("nobody told this client to stop")?;
    Ok(())
}

/// Joins as the learner, which has learned from nothing.
///
/// # Errors
/// As [`join_as_actor`].
pub(super) fn join_as_learner(
    session: &Session,
    keys: &Keys,
    spec_hash: u64,
) -> anyhow::Result<()> {
    let join = LearnerJoin {
        learner: LEARNER,
        rows_sampled: 0,
    };
    join::as_learner(session, keys, spec_hash, join, &Shutdown::default())?
        .context("nobody told this client to stop")?;
    Ok(())
}
