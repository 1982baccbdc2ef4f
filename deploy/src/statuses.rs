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
pub(crate) struct Statuses {
    session: Session,
    keys: Keys,
    spec_hash: u64,
    /// The replay server's last answer.
    pub(crate) replay: ReplayStatus,
    /// The learner's last answer.
    pub(crate) learner: LearnerStatus,
}

impl Statuses {
    /// A client over an open session.
    pub(crate) fn new(session: Session, keys: Keys, spec_hash: u64) -> Self {
        Self {
            session,
            keys,
            spec_hash,
            replay: ReplayStatus::default(),
            learner: LearnerStatus::default(),
        }
    }

    /// Asks the replay server.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run.
    pub(crate) fn ask_replay(&mut self) -> anyhow::Result<()> {
        let key = self.keys.replay_status();
        self.replay = self.ask(&key, Kind::ReplayStatus)?;
        Ok(())
    }

    /// Asks the learner.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run.
    pub(crate) fn ask_learner(&mut self) -> anyhow::Result<()> {
        let key = self.keys.learner_status();
        self.learner = self.ask(&key, Kind::LearnerStatus)?;
        Ok(())
    }

    fn ask<T: DeserializeOwned>(&self, key: &str, kind: Kind) -> anyhow::Result<T> {
        let answer = session::ask(
            &self.session,
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
    pub(crate) fn close(&self) {
        if let Err(e) = self.session.close().wait() {
            tracing::debug!("closing the session: {e}");
        }
    }
}
