//! Asks all parts of a run that can be asked, and says how fast they were since the last time.

use std::time::{Duration, Instant};

use anyhow::Context;
use driml_machine::error::usage;
use driml_protocol::{
    CodecError, EpisodesReply, EpisodesRequest, Hello, Keys, LearnerStatus, PartsStatus,
    Recovering, ReplayStatus, RunClient, join, reach,
    session::{self, Endpoints, SMALL_MESSAGE_BYTES_MAX, SessionError},
    tls::Credentials,
};
use driml_settings::config::RunConfig;
use zenoh::Wait;

use super::{
    advice,
    numbers::Numbers,
    snapshot::{ServerAnswer, Snapshot},
};
use crate::{ended_episodes::EndedEpisodes, rates::Rates};

/// How long an answer may take.
const ANSWER_MAX: Duration = Duration::from_secs(3);

/// A run's replay servers, as one that only asks is connected to them.
pub struct Connection {
    /// The run's settings.
    pub config: RunConfig,
    /// Updates after which the run goes on, if it was resumed; none before its learner has joined.
    pub after_updates: Option<u64>,
    /// Each with its endpoint.
    servers: Vec<(String, RunClient)>,
    rates: Rates,
    /// The last answers of all replay servers and of the learner.
    last: (ReplayStatus, Option<LearnerStatus>),
    /// Episodes that ended and were not taken yet.
    episodes: EndedEpisodes,
}

impl Connection {
    /// Connects to the replay servers at `endpoints`, with an observer's certificate where they want one.
    ///
    /// # Errors
    /// Nobody listens there, or somebody who is no replay server of this program and namespace.
    pub fn open(
        endpoints: &[String],
        namespace: &str,
        credentials: Option<&Credentials>,
    ) -> anyhow::Result<Self> {
        let keys = Keys::new(namespace).map_err(driml_machine::error::Usage)?;
        let mut servers = Vec::new();
        let mut first = None;
        for endpoint in endpoints {
            let reached = Endpoints {
                listen: Vec::new(),
                connect: vec![endpoint.clone()],
            };
            // Whoever only looks does not wait for somebody to come.
            reach::look(endpoint)?;
            let session = session::open_as(&reached, &keys, credentials, SMALL_MESSAGE_BYTES_MAX)?;
            let (config_toml, after_updates) = match join::hello_within(&session, &keys, ANSWER_MAX)
            {
                Ok(hello) => (
                    hello.config_toml,
                    hello.has_learner.then_some(hello.after_updates),
                ),
                Err(SessionError::Unreadable { why, .. }) => {
                    return Err(why).with_context(|| {
                        format!("the greeting of the replay server on {endpoint}")
                    });
                }
                Err(SessionError::Recovering(Recovering {
                    config_toml: Some(config_toml),
                    ..
                })) => (config_toml, None),
                Err(SessionError::Nobody { .. }) => {
                    return Err(usage!(
                        "somebody listens on {endpoint}, but it is no replay server with the namespace {namespace:?}"
                    )
                    .into());
                }
                Err(other) => {
                    let what = format!("the replay server on {endpoint} does not answer");
                    return Err(anyhow::Error::new(other).context(what));
                }
            };
            let own = RunConfig::parse("the replay server's settings", &config_toml)?;
            let spec_hash = own.run.hash();
            let (of, _) = first.get_or_insert((own, after_updates));
            if of.run.hash() != spec_hash {
                return Err(usage!(
                    "{} and {endpoint} are of different runs: name the replay shards of one",
                    endpoints[0]
                )
                .into());
            }
            servers.push((
                endpoint.clone(),
                RunClient::new(session, keys.clone(), spec_hash),
            ));
        }
        let (config, after_updates) = first.context("no endpoint to ask")?;
        Ok(Self {
            config,
            after_updates,
            servers,
            rates: Rates::default(),
            last: Default::default(),
            episodes: EndedEpisodes::default(),
        })
    }

    /// The episodes that ended by the last answers and were not fetched before, each answer with its shard. What a server does not
    /// answer now comes the next time.
    pub(crate) fn fetch_episodes(
        &mut self,
        shards: &[ReplayStatus],
    ) -> Vec<(usize, EpisodesReply)> {
        for (shard, ((_, client), status)) in self.servers.iter().zip(shards).enumerate() {
            let ask = |since| client.ask(&EpisodesRequest { since }, ANSWER_MAX);
            if let Err(e) = self.episodes.fetch(shard, status.episodes, ask) {
                tracing::debug!("episodes of shard {shard}: {e}");
            }
        }
        self.episodes.take()
    }

    /// Leaves the run.
    pub fn close(&self) {
        for (_, client) in &self.servers {
            if let Err(e) = client.session().close().wait() {
                tracing::debug!("closing the session: {e}");
            }
        }
    }

    /// Asks everybody. Who does not answer is said in the snapshot.
    pub fn ask(&mut self) -> Snapshot {
        let ask = |(endpoint, client): &(String, RunClient)| {
            let answers = client
                .fetch::<ReplayStatus>(ANSWER_MAX)
                .and_then(|replay| Ok((replay, client.fetch::<PartsStatus>(ANSWER_MAX)?)));
            let is_another_run = matches!(
                &answers,
                Err(SessionError::Unreadable {
                    why: CodecError::RunSpec { .. },
                    ..
                })
            );
            let (answers, recovering, error) = match answers {
                Ok(answers) => (Some(answers), None, None),
                Err(SessionError::Recovering(it)) => (None, Some(it.progress), None),
                Err(e) => (None, None, Some(e.to_string())),
            };
            let is_gone = error.is_some() && reach::look(endpoint).is_err();
            let (replay, parts) = answers.unzip();
            ServerAnswer {
                endpoint: endpoint.clone(),
                replay,
                parts,
                recovering,
                error,
                is_gone,
                is_another_run,
            }
        };
        let servers: Vec<_> = self.servers.iter().map(ask).collect();
        // The learner is asked through the first of them.
        let first = self.servers.first();
        let first = first.filter(|_| servers[0].replay.is_some());
        if let (None, Some((_, client))) = (self.after_updates, first) {
            let hello = client.fetch::<Hello>(ANSWER_MAX);
            let known = hello.ok().filter(|it| it.has_learner);
            self.after_updates = known.map(|it| it.after_updates);
        }
        let learner = first.and_then(|(_, client)| client.fetch::<LearnerStatus>(ANSWER_MAX).ok());
        let answered: Vec<_> = servers.iter().filter_map(|it| it.replay.clone()).collect();
        let (replay, learner) = match servers.iter().all(|it| it.is_gone) {
            true => self.last.clone(),
            false => (ReplayStatus::merged(&answered), learner),
        };
        if answered.len() == servers.len() && learner.is_some() {
            let updates = learner.as_ref().map_or(0, |it| it.updates);
            self.rates
                .add(Instant::now(), replay.transitions_inserted, updates);
        }
        if answered.len() == servers.len() {
            let learner = learner.clone().or(self.last.1.take());
            self.last = (replay.clone(), learner);
        }
        let config = &self.config;
        let mut snapshot = Snapshot {
            world: config.run.world.clone(),
            agent: config.run.agent.clone(),
            seed: config.run.seed,
            run_spec: format!("{:016x}", config.run.hash()),
            well: false,
            numbers: Numbers::of(&replay, learner.as_ref(), self.rates.per_second()),
            frames_planned: config.frames(),
            updates_planned: config.updates(),
            replay_ratio_planned: config.replay.replay_ratio,
            actors_planned: config.local.actors,
            servers,
            replay,
            learner,
            waits: Vec::new(),
            to_go_on: Vec::new(),
        };
        snapshot.waits = advice::waits(&snapshot);
        snapshot.to_go_on = advice::to_go_on(&snapshot);
        snapshot.well = snapshot.to_go_on.is_empty();
        snapshot
    }
}
