//! The poller: asks the processes of a run for their status, as any client could, and keeps the answers in a [`RunView`].
//! This module judges nothing and changes nothing.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_machine::error::{Usage, usage};
use driml_protocol::{
    CodecError, EpisodesReply, EpisodesRequest, Keys, ReplayStatus, RunClient, RunInfo, Waiting,
    join, reach,
    session::{self, Connection, Endpoints, SMALL_MESSAGE_BYTES_MAX, SessionError},
};
use driml_settings::config::RunConfig;
use zenoh::{Session, Wait};

use crate::{
    endpoint::DEFAULT_NAMESPACE,
    run_view::{PAUSE_MIN, Plan, RunView, ServerAnswer},
    view::advice::SILENT_SERVER,
};

/// How long an answer may take; a process that is busy may answer the next poll.
const ANSWER_MAX: Duration = Duration::from_secs(3);

/// The time between two polls.
const POLL: Duration = Duration::from_secs(1);
/// The same once all rows are sampled: the learner may exit soon after its last status, and the end of a run is timed by it.
const LAST_POLL: Duration = Duration::from_millis(200);

/// A replay server to which the poller is connected.
#[derive(Debug)]
pub struct ServerConnection {
    name: String,
    endpoint: String,
    /// The client of this server; the poller closes its session.
    client: RunClient,
}

/// Polls the processes of a run.
pub struct Poller {
    /// The run's settings.
    pub config: RunConfig,
    /// The state of the run, by the answers of its processes.
    pub view: RunView,
    pub(crate) servers: Vec<ServerConnection>,
    /// The end of the last poll.
    polled: Instant,
}

impl Poller {
    /// A poller for the run with these settings, connected to its replay servers already, one per shard, or to none yet.
    pub fn new(config: &RunConfig, servers: Vec<ServerConnection>) -> Self {
        Self {
            view: RunView::new(Plan::new(config)),
            config: config.clone(),
            servers,
            polled: Instant::now(),
        }
    }

    /// Connects to the replay server at each endpoint of `connection`, which has an observer's certificate if they require one.
    ///
    /// # Errors
    /// Nothing listens at an endpoint, or something that is not a replay server of this program and namespace.
    pub fn open(connection: &Connection) -> anyhow::Result<Self> {
        let (endpoints, keys) = (&connection.endpoints.connect, &connection.keys);
        let mut servers = Vec::new();
        let mut config: Option<RunConfig> = None;
        let mut shards = BTreeMap::new();
        for endpoint in endpoints {
            // An observer does not wait for a server that does not listen yet.
            reach::check_listening(endpoint)?;
            let server = connection.to_endpoint(endpoint);
            let session = server.open(SMALL_MESSAGE_BYTES_MAX)?;
            let (served, shard) = fetch_settings(&session, keys, endpoint)?;
            let hash = served.run.hash();
            if config.get_or_insert(served).run.hash() != hash {
                bail!(usage!(
                    "{} and {endpoint} belong to different runs: give the endpoints of one run",
                    endpoints[0]
                ));
            }
            if let Some(shard) = shard
                && let Some(earlier) = shards.insert(shard, endpoint)
            {
                bail!(usage!(
                    "{earlier} and {endpoint} are both shard {shard}: give each endpoint once"
                ));
            }
            servers.push(ServerConnection {
                name: endpoint.clone(),
                endpoint: endpoint.clone(),
                client: RunClient::new(session, keys.clone(), hash),
            });
        }
        Ok(Self::new(&config.context("no endpoint to ask")?, servers))
    }

    pub(crate) const fn pause(&self) -> Duration {
        match self.view.replay.waiting {
            Waiting::Finished => LAST_POLL,
            _ => POLL,
        }
    }

    /// Polls all processes. The view names those that do not answer.
    pub fn poll(&mut self) -> &RunView {
        let servers: Vec<_> = self.servers.iter().map(ServerConnection::poll).collect();
        // The learner is asked through the first server.
        let first = self.servers.first().filter(|_| servers[0].replay.is_some());
        let view = &mut self.view;
        if let (None, Some(first)) = (view.after_updates, first) {
            let run_info = first.client.fetch::<RunInfo>(ANSWER_MAX);
            let known = run_info.ok().filter(|it| it.has_learner);
            view.after_updates = known.map(|it| it.after_updates);
        }
        view.set_learner(first.and_then(|it| it.client.fetch(ANSWER_MAX).ok()));
        let shards: Option<Vec<_>> = servers.iter().map(|it| it.replay.clone()).collect();
        match shards {
            Some(shards) => view.set_replay(shards),
            None => _ = view.replay_silence.record_failure(),
        }
        view.servers = servers;
        let poll_max = 2 * ANSWER_MAX * self.servers.len() as u32;
        let was_stopped = self.polled.elapsed() > PAUSE_MIN + poll_max;
        self.polled = Instant::now();
        if was_stopped || view.recovering().next().is_some() {
            // This process could not ask, or the server is alive and no other process can be asked through it.
            view.replay_silence.record_answer();
            view.learner_silence.record_answer();
        }
        view
    }

    /// Asks only the replay servers, for their counts.
    pub fn poll_replay(&mut self) -> anyhow::Result<()> {
        let answers = self.servers.iter().map(|it| it.client.fetch(ANSWER_MAX));
        self.view.set_replay(answers.collect::<Result<_, _>>()?);
        Ok(())
    }

    /// Asks only the learner.
    pub fn poll_learner(&mut self) -> anyhow::Result<()> {
        let first = self.servers.first().context("no connected replay server")?;
        self.view.set_learner(Some(first.client.fetch(ANSWER_MAX)?));
        Ok(())
    }

    /// Requests the episodes of a shard that ended after the first `since`, as the launcher or as another observer. None if the shard
    /// does not answer.
    pub(crate) fn fetch_episodes(
        &self,
        shard: usize,
        since: u64,
        is_launcher: bool,
    ) -> Option<EpisodesReply> {
        let request = EpisodesRequest { since, is_launcher };
        let reply = self.servers[shard].client.ask(&request, ANSWER_MAX);
        let failed = |e: &SessionError| tracing::debug!("episodes of shard {shard}: {e}");
        reply.inspect_err(failed).ok()
    }

    /// Closes the sessions; the last answers stay in the view.
    pub fn close(&self) {
        for server in &self.servers {
            if let Err(e) = server.client.session().close().wait() {
                tracing::debug!("closing the session: {e}");
            }
        }
    }
}

impl ServerConnection {
    /// Connects to a server that `driml train` has started at `endpoint`, of the run with this hash.
    pub fn open(name: &str, endpoint: &str, spec_hash: u64) -> anyhow::Result<Self> {
        let session = session::open(&Endpoints::connect_to(vec![endpoint.to_owned()]))?;
        let keys = Keys::new(DEFAULT_NAMESPACE).map_err(Usage)?;
        Ok(Self {
            name: name.to_owned(),
            endpoint: endpoint.to_owned(),
            client: RunClient::new(session, keys, spec_hash),
        })
    }

    fn poll(&self) -> ServerAnswer {
        let replay = self.client.fetch::<ReplayStatus>(ANSWER_MAX);
        let answers = replay.and_then(|it| Ok((it, self.client.fetch(ANSWER_MAX)?)));
        let mut answer = ServerAnswer {
            name: self.name.clone(),
            endpoint: self.endpoint.clone(),
            ..ServerAnswer::default()
        };
        match answers {
            Ok((replay, processes)) => {
                (answer.replay, answer.processes) = (Some(replay), Some(processes))
            }
            Err(SessionError::Recovering(it)) => answer.recovering = Some(it.progress),
            Err(e) => {
                answer.is_another_run = matches!(
                    &e,
                    SessionError::Unreadable { why, .. } if matches!(why, CodecError::RunSpec { .. })
                );
                answer.is_gone = reach::check_listening(&self.endpoint).is_err_and(|e| e.is_closed);
                answer.error = Some(e.to_string());
            }
        }
        answer
    }
}

/// The settings and the shard that a replay server reports. While it reads its replay back from disk, its shard is not known.
fn fetch_settings(
    session: &Session,
    keys: &Keys,
    endpoint: &str,
) -> anyhow::Result<(RunConfig, Option<u32>)> {
    let mut fetched = join::fetch_run_info_once(session, keys, ANSWER_MAX);
    if matches!(fetched, Err(SessionError::NoResponder { .. })) {
        // A replay server listens shortly before it answers.
        std::thread::sleep(POLL);
        fetched = join::fetch_run_info_once(session, keys, ANSWER_MAX);
    }
    let (config_toml, shard) = match fetched {
        Ok(run_info) => (run_info.config_toml, Some(run_info.shard.0)),
        Err(SessionError::Recovering(recovering)) => (recovering.config_toml, None),
        Err(SessionError::Unreadable { why, .. }) => {
            let what = format!("reading the run info of the replay server on {endpoint}");
            return Err(why).context(what);
        }
        Err(SessionError::NoResponder { .. }) => {
            bail!(usage!(
                "a program listens on {endpoint}, but it is not a replay server with the namespace {:?}: check the endpoint and --namespace",
                keys.namespace()
            ));
        }
        Err(other) => {
            let what = format!("the replay server on {endpoint} does not answer: {SILENT_SERVER}");
            return Err(anyhow::Error::new(other).context(what));
        }
    };
    let config = RunConfig::parse("the replay server's settings", &config_toml)?;
    Ok((config, shard))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::config;

    #[test]
    fn a_pause_of_this_process_is_no_silence_of_the_others() {
        let mut poller = Poller::new(&config("smoke", "chain", "c51", &[]), Vec::new());
        for (pause_s, is_silent) in [(1, true), (60, false)] {
            let pause = Duration::from_secs(pause_s);
            poller.polled = Instant::now().checked_sub(pause).unwrap();
            let silence = poller.poll().learner_silence.length();
            assert_eq!(silence > Duration::ZERO, is_silent, "after {pause_s} s");
        }
    }
}
