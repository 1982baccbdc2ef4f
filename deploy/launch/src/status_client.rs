//! The status of the replay servers and the learner, asked for over zenoh as any client would.
//! It keeps the last answers and judges nothing.

use std::time::Duration;

use anyhow::Context;
use driml_protocol::{
    EpisodesRequest, Keys, LearnerStatus, RecoveryProgress, ReplayStatus, RunClient,
    session::SessionError,
};
use zenoh::{Session, Wait};

use crate::ended_episodes::EndedEpisodes;

/// How long an answer may take; a process that is busy answers the next time.
const ANSWER_MAX: Duration = Duration::from_secs(2);

/// A client of a run that asks its processes for their status.
pub struct Statuses {
    /// One for each shard of the replay.
    clients: Vec<RunClient>,
    /// Each replay server's last answer.
    pub shards: Vec<ReplayStatus>,
    /// The same, as of one.
    pub replay: ReplayStatus,
    /// Each replay server that has just said that it reads its replay back from disk: which shard it is, and how far.
    pub recovering: Vec<(usize, RecoveryProgress)>,
    /// The learner's last answer.
    pub learner: LearnerStatus,
    /// Episodes that ended and were not taken yet.
    pub(crate) episodes: EndedEpisodes,
}

impl Statuses {
    /// A client over open sessions, one for each shard of the replay.
    pub fn new(sessions: Vec<Session>, keys: Keys, spec_hash: u64) -> Self {
        let client = |session| RunClient::new(session, keys.clone(), spec_hash);
        Self {
            clients: sessions.into_iter().map(client).collect(),
            shards: Vec::new(),
            replay: ReplayStatus::default(),
            recovering: Vec::new(),
            learner: LearnerStatus::default(),
            episodes: EndedEpisodes::default(),
        }
    }

    /// Asks the replay servers how they are, and for the episodes that ended.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run; one that is `recovering`, too.
    pub fn ask_replay(&mut self) -> anyhow::Result<()> {
        let answers = self.clients.iter().map(|client| client.fetch(ANSWER_MAX));
        let answers: Vec<Result<ReplayStatus, _>> = answers.collect();
        let recovering = answers
            .iter()
            .enumerate()
            .filter_map(|(shard, it)| match it {
                Err(SessionError::Recovering(it)) => Some((shard, it.progress)),
                _ => None,
            });
        self.recovering = recovering.collect();
        let shards = answers.into_iter().collect::<Result<Vec<_>, _>>()?;
        self.replay = ReplayStatus::merged(&shards);
        self.shards = shards;
        for (shard, (client, status)) in self.clients.iter().zip(&self.shards).enumerate() {
            let ask = |since| client.ask(&EpisodesRequest { since }, ANSWER_MAX);
            self.episodes.fetch(shard, status.episodes, ask)?;
        }
        Ok(())
    }

    /// Asks the learner.
    ///
    /// # Errors
    /// No answer in time, or one that is not of this run.
    pub fn ask_learner(&mut self) -> anyhow::Result<()> {
        let client = self
            .clients
            .first()
            .context("a run has at least one replay server")?;
        self.learner = client.fetch(ANSWER_MAX)?;
        Ok(())
    }

    /// Leaves the run; the last answers stay.
    pub fn close(&self) {
        for client in &self.clients {
            if let Err(e) = client.session().close().wait() {
                tracing::debug!("closing the session: {e}");
            }
        }
    }
}
