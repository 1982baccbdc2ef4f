//! What the parts say of themselves, asked for over zenoh as any client would.
//! It keeps the last answers and judges nothing.

use std::time::Duration;

use anyhow::Context;
use driml_protocol::{Keys, LearnerStatus, Message, ReplayStatus, codec, session};
use zenoh::{Session, Wait, bytes::ZBytes, qos::Priority};

/// How long an answer may take; a part that is busy answers the next time.
const ANSWER_MAX: Duration = Duration::from_secs(2);

/// A client of a run that asks its parts how they are.
pub(crate) struct Statuses {
    /// One for each shard of the replay.
    sessions: Vec<Session>,
    keys: Keys,
    spec_hash: u64,
    /// Each replay server's last answer.
    pub(crate) shards: Vec<ReplayStatus>,
    /// The same, as of one.
    pub(crate) replay: ReplayStatus,
    /// The learner's last answer.
    pub(crate) learner: LearnerStatus,
}

impl Statuses {
    /// A client over open sessions, one for each shard of the replay.
    pub(crate) fn new(sessions: Vec<Session>, keys: Keys, spec_hash: u64) -> Self {
        Self {
            sessions,
            keys,
            spec_hash,
            shards: Vec::new(),
            replay: ReplayStatus::default(),
            learner: LearnerStatus::default(),
        }
    }

    /// Asks the replay servers.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run.
    pub(crate) fn ask_replay(&mut self) -> anyhow::Result<()> {
        let key = self.keys.replay_status();
        let answers = self.sessions.iter().map(|session| self.ask(session, &key));
        let shards = answers.collect::<anyhow::Result<Vec<_>>>()?;
        self.replay = ReplayStatus::merged(&shards);
        self.shards = shards;
        Ok(())
    }

    /// Asks the learner.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run.
    pub(crate) fn ask_learner(&mut self) -> anyhow::Result<()> {
        let key = self.keys.learner_status();
        let session = self
            .sessions
            .first()
            .context("a run has at least one replay server")?;
        self.learner = self.ask(session, &key)?;
        Ok(())
    }

    fn ask<M: Message>(&self, session: &Session, key: &str) -> anyhow::Result<M> {
        let answer = session::ask(
            session,
            key,
            ZBytes::new(),
            Priority::InteractiveHigh,
            ANSWER_MAX,
        )?;
        let (status, _) = codec::decode(&answer.to_bytes(), Some(self.spec_hash))
            .with_context(|| key.to_owned())?;
        Ok(status)
    }

    /// Leaves the run; the last answers stay.
    pub(crate) fn close(&self) {
        for session in &self.sessions {
            if let Err(e) = session.close().wait() {
                tracing::debug!("closing the session: {e}");
            }
        }
    }
}
