//! What the parts say of themselves, asked for over zenoh as any client would.
//! It keeps the last answers and judges nothing.

use std::time::Duration;

use anyhow::Context;
use driml_protocol::{Keys, Kind, LearnerStatus, ReplayStatus, codec, session};
use serde::de::DeserializeOwned;
use zenoh::{Session, Wait, bytes::ZBytes, qos::Priority};

/// How long an answer may take; a part that is busy answers the next time.
const ANSWER_MAX: Duration = Duration::from_secs(2);

/// A client of a run that asks its parts how they are.
pub struct Statuses {
    /// One for each shard of the replay.
    sessions: Vec<Session>,
    keys: Keys,
    spec_hash: u64,
    /// Each replay server's last answer.
    pub shards: Vec<ReplayStatus>,
    /// The same, as of one.
    pub replay: ReplayStatus,
    /// The learner's last answer.
    pub learner: LearnerStatus,
}

impl Statuses {
    /// A client over open sessions, one for each shard of the replay.
    pub fn new(sessions: Vec<Session>, keys: Keys, spec_hash: u64) -> Self {
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
    pub fn ask_replay(&mut self) -> anyhow::Result<()> {
        let key = self.keys.replay_status();
        let answers = self
            .sessions
            .iter()
            .map(|session| self.ask(session, &key, Kind::ReplayStatus));
        let shards = answers.collect::<anyhow::Result<Vec<_>>>()?;
        self.replay = ReplayStatus::merged(&shards);
        self.shards = shards;
        Ok(())
    }

    /// Asks the learner.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run.
    pub fn ask_learner(&mut self) -> anyhow::Result<()> {
        let key = self.keys.learner_status();
        let session = self
            .sessions
            .first()
            .context("a run has at least one replay server")?;
        self.learner = self.ask(session, &key, Kind::LearnerStatus)?;
        Ok(())
    }

    fn ask<T: DeserializeOwned>(
        &self,
        session: &Session,
        key: &str,
        kind: Kind,
    ) -> anyhow::Result<T> {
        let answer = session::ask(
            session,
            key,
            ZBytes::new(),
            Priority::InteractiveHigh,
            ANSWER_MAX,
        )?;
        let (status, _) = codec::decode(&answer.to_bytes(), kind, Some(self.spec_hash))
            .with_context(|| key.to_owned())?;
        Ok(status)
    }

    /// Leaves the run; the last answers stay.
    pub fn close(&self) {
        for session in &self.sessions {
            if let Err(e) = session.close().wait() {
                tracing::debug!("closing the session: {e}");
            }
        }
    }
}
