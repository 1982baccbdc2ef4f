//! The launcher starts replay servers, learner and actors as processes, watches them until the run is over, and stops them in
//! order.
//! `managed_process` handles each process, `view` polls and displays the run, and `run_folder` records it.

mod processes;

pub use processes::ExternalAccess;
use processes::Launch;
pub(crate) use processes::process_names;

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use driml_learner::checkpoint::RETRY_MAX;
use driml_machine::units::{count, duration};
use driml_protocol::{
    GracefulShutdown, Silence, Waiting, config::Settings, session, shared_memory,
};
use driml_replay_server::shared_memory_bytes;
use driml_settings::config::RunConfig;

use crate::{
    console,
    endpoint::wait_until_listening,
    evaluator::Evaluator,
    last_play,
    managed_process::{ManagedProcess, stop_processes},
    open_files,
    rendezvous::Rendezvous,
    resume,
    run_folder::{Outcome, ResumePoint, RunFolder, RunRecorder, Summary, write_atomically},
    run_view::updates_served,
    view::{Display, Poller, ServerConnection},
};

/// How long the replay servers or the learner may leave requests unanswered, also after their start, before the run fails.
const SILENCE_MAX: Duration = Duration::from_secs(120);
/// How long a run may make no progress before it fails, or longer if its world may take longer.
const STALL_MAX: Duration = Duration::from_secs(600);
/// How long actors may take to deliver their transitions, once they are not needed or told to stop.
const ACTORS_DRAIN_MAX: Duration = Duration::from_secs(60);
/// How long actors may take to exit once another process has failed.
const FAILED_DRAIN_MAX: Duration = Duration::from_secs(5);
/// How long the learner may take to save, once it is told to stop. On a full disk it logs that it retries, and has [`RETRY_MAX`] more.
const LEARNER_DRAIN_MAX: Duration = Duration::from_secs(120);
/// How long the replay server may take to exit, once it is told to stop.
const REPLAY_DRAIN_MAX: Duration = Duration::from_secs(30);
/// How long the learner may leave requests for its last status unanswered.
const LAST_STATUS_MAX: Duration = Duration::from_secs(30);
const DRAIN_POLL: Duration = Duration::from_millis(100);

/// Trains with a process for each replay server, the learner and each actor, and leaves the folder `run_dir`. A run that is
/// `resumed` already has that folder and continues from the given point.
///
/// # Errors
/// A process that failed or is unresponsive, a file system error; `Interrupted` if the run was asked to stop.
pub fn run(
    config: &RunConfig,
    run_dir: &RunFolder,
    resumed: Option<ResumePoint>,
    external: ExternalAccess,
    exit_with_parent: Option<u32>,
) -> anyhow::Result<()> {
    let shutdown = GracefulShutdown::on_repeated_signals(exit_with_parent);
    let shutdown = shutdown.context("listening for signals")?;
    open_files::check_run(config)?;
    // `RunRecorder::open` removes the summary.
    let summary_before = resumed.and_then(|_| Summary::read(run_dir).ok());
    let restarts_before = summary_before.map_or([0; 2], |it| {
        [it.replay_servers_restarted, it.actors_restarted]
    });
    let evaluator = Evaluator::new(config, run_dir)?;
    let (names, events) = (process_names(config), config.local.tensorboard);
    // Before the run folder gets files.
    let rendezvous = Rendezvous::create()?;
    let recorder = RunRecorder::open(run_dir, config, names.clone(), resumed, events)?;
    let servers = names.iter().take(config.replay.shards as usize);
    let mut endpoints: Vec<_> = servers.map(|name| rendezvous.endpoint(name)).collect();
    if let (Some(listen), None) = (&external.listen, &external.tls_dir) {
        endpoints[0].clone_from(listen);
    }
    write_atomically(&run_dir.endpoints(), endpoints.join("\n").as_bytes())?;
    let rendezvous_path = rendezvous.path().as_os_str().as_encoded_bytes();
    write_atomically(&run_dir.rendezvous(), rendezvous_path)?;
    let display = Display::new(config.frames(), Instant::now());
    // Frees the shared memory that killed processes left behind.
    session::remove_orphaned_shared_memory();
    let shared_memory = config.transport.shared_memory && {
        let settings = Settings::parse(&config.to_toml())?;
        let needed = shared_memory_bytes(&settings, config.replay.shards)?;
        shared_memory::granted(shared_memory::check_room(needed)).is_some()
    };
    let point = resumed.unwrap_or_default();
    let mut poller = Poller::new(config, Vec::new());
    poller.view.begin_at(point.frames, point.updates);
    let mut launch = Launch {
        config,
        shared_memory,
        run_dir,
        endpoints,
        external,
        rendezvous,
        display,
        shutdown,
        names,
        processes: Vec::new(),
        evaluator,
        server_restarts: 0,
        actor_restarts: 0,
        poller,
        recorder,
    };

    let watched = launch.start_and_watch();
    let result = launch.stop_all(watched);
    session::remove_orphaned_shared_memory();
    crate::shared_memory::remove_own_segments();
    launch.display.screen.clear();
    let outcome = result.as_ref().map_or(Outcome::Failed, |outcome| *outcome);
    let (mut summary, written) = launch.write_summary(outcome, restarts_before);
    // An interrupted or failed run does not wait for the last evaluation.
    if outcome == Outcome::Finished {
        let screen = &launch.display.screen;
        launch.evaluator.finish(screen, &launch.shutdown.drain);
    }
    // All processes have exited, so these files are of no use. If they stay behind, the released locks show that.
    for path in [run_dir.endpoints(), run_dir.rendezvous()] {
        if let Err(e) = std::fs::remove_file(&path) {
            tracing::debug!("removing {}: {e}", path.display());
        }
    }
    resume::report_end(result, written, &summary, resumed, &config.world, run_dir)?;
    if outcome == Outcome::Finished {
        last_play::play(&mut summary, config, run_dir, &launch.shutdown.drain);
    }
    resume::print_next_steps(&summary, &config.world, run_dir)
}

impl Launch<'_> {
    fn start_and_watch(&mut self) -> anyhow::Result<Outcome> {
        self.start_up_to(self.endpoints.len())?;
        let hash = self.config.run.hash();
        let mut connections = Vec::new();
        for (name, endpoint) in self.names.iter().zip(&self.endpoints) {
            let servers = &mut self.processes;
            let mut check_alive = || servers.iter_mut().try_for_each(ManagedProcess::check_alive);
            if !wait_until_listening(endpoint, &self.shutdown.drain, &mut check_alive)? {
                return Ok(Outcome::Interrupted);
            }
            let connection = ServerConnection::open(name, endpoint, hash);
            if connection.is_err() {
                // If a server died meanwhile, its exit report says more than the connection error.
                check_alive()?;
            }
            connections.push(connection?);
        }
        // All at once, as the counts of only some servers are not those of the run.
        self.poller.servers = connections;
        self.start_up_to(self.names.len())?;
        self.watch()
    }

    fn watch(&mut self) -> anyhow::Result<Outcome> {
        let (mut standstill, mut work_before) = (Silence::default(), (0, 0));
        let steps = self.config.actor.steps_per_chunk;
        let stall_max = STALL_MAX.max(self.config.world.steps_time_max(steps));
        loop {
            if self.shutdown.drain.wait_timeout(self.poller.pause()) {
                return Ok(Outcome::Interrupted);
            }
            self.run_dir.check_intact()?;
            self.restart_dead()?;
            let poller = &mut self.poller;
            poller.poll();
            let view = &poller.view;
            for (name, silence) in [
                ("replay server", view.replay_silence),
                ("learner", view.learner_silence),
            ] {
                let silent = silence.length();
                if silent > SILENCE_MAX {
                    let why = view.servers.iter().find_map(|it| it.error.as_deref());
                    let (silent, why) = (duration(silent), why.unwrap_or("no answer"));
                    let logs = self.run_dir.logs();
                    let logs = logs.display();
                    bail!("the {name} has not answered for {silent} ({why}): see {logs}");
                }
            }
            let processes = self.processes.iter_mut();
            let rss: Vec<_> = processes.map(ManagedProcess::rss_mib).collect();
            if view.servers_answered() {
                let fetch = |shard, since| poller.fetch_episodes(shard, since, true);
                let mut warnings = self.recorder.record_episodes(view, fetch);
                warnings.extend(self.recorder.record(&mut poller.view, &rss));
                self.display.screen.print_lines(warnings);
            }
            self.recorder.fill_totals(&mut poller.view);
            let view = &poller.view;
            self.display.show(view);
            self.evaluator.poll(&self.display.screen);
            if view.is_all_learned() {
                return Ok(Outcome::Finished);
            }
            let work = view.work_done();
            let stall_max = match view.replay.waiting {
                Waiting::Finished => stall_max + RETRY_MAX,
                _ => stall_max,
            };
            // While a replay server reads its replay back from disk, the other processes wait for it.
            if work != work_before || view.recovering().next().is_some() {
                standstill.record_answer();
                work_before = work;
            } else if standstill.record_failure() > stall_max {
                bail!(
                    "no frame and no update for {}, at {} and {} ({}): see {}",
                    duration(stall_max),
                    count(view.replay.transitions_inserted, "frame"),
                    count(view.learner.updates, "update"),
                    view.replay.waiting,
                    self.run_dir.logs().display()
                );
            }
        }
    }

    /// Stops all processes in order: first the actors, which deliver their transitions; then the learner, which saves; then the
    /// replay servers, which must answer with the final counts. A second interrupt kills all at once. Returns how the run ended.
    fn stop_all(&mut self, watched: anyhow::Result<Outcome>) -> anyhow::Result<Outcome> {
        let failed = watched.as_ref().err().map(|e| format!("{e:#}"));
        // A signal that interrupts this process may reach the others first; their exit then counts as an interruption.
        let watched = match self.shutdown.drain.is_set() {
            false => watched,
            true => watched.or(Ok(Outcome::Interrupted)),
        };
        if matches!(watched, Ok(Outcome::Interrupted)) {
            self.display.screen.print_line("stopping: actors deliver what they have, the learner saves (Ctrl-C again exits at once)");
        }
        let now = self.shutdown.immediate.clone();
        let finished = matches!(watched, Ok(Outcome::Finished));
        // After a failure, the learner will hardly use what the actors still hold.
        let actors_max = match watched {
            Ok(_) => ACTORS_DRAIN_MAX,
            Err(_) => FAILED_DRAIN_MAX,
        };
        // In a finished run, the replay server tells the actors so, and they exit.
        let shards = self.endpoints.len();
        let actors = self.processes.iter_mut().skip(shards + 1);
        let actors = stop_processes(actors, !finished, actors_max, &now);
        self.wait_for_final_checkpoint();
        let learner = self.processes.iter_mut().skip(shards).take(1);
        let mut others = stop_processes(learner, true, LEARNER_DRAIN_MAX, &now);
        let poller = &mut self.poller;
        // The learner's last status may be lost, but not what it has saved.
        let saved = self.run_dir.newest_checkpoint().map_or(0, |it| it.0);
        let updates = &mut poller.view.learner.updates;
        *updates = saved.max(*updates);
        if let Err(e) = poller.poll_replay() {
            tracing::debug!("the replay server's last answer: {e:#}");
        }
        let fetch = |shard, since| poller.fetch_episodes(shard, since, true);
        self.recorder.record_episodes(&poller.view, fetch);
        // Closed before the replay server, which is the session's router: otherwise it would try to reconnect.
        poller.close();
        let servers = self.processes.iter_mut().take(shards);
        others.extend(stop_processes(servers, true, REPLAY_DRAIN_MAX, &now));
        // By the last answers, all transitions are stored and learned from, and the result is saved.
        let view = &self.poller.view;
        let served = updates_served(self.config, view.replay.rows_sampled);
        let is_complete = finished || view.is_all_learned() && view.learner.updates >= served;
        let result = match watched {
            _ if is_complete => self.run_dir.check_intact().map(|()| Outcome::Finished),
            _ if now.is_set() => Err(anyhow::anyhow!(
                "stopped at once by a second interrupt: what was not saved is lost"
            )),
            Ok(_) if !others.is_empty() => {
                let others = others.join("; ");
                Err(anyhow::anyhow!("at the end of the run, {others}"))
            }
            Ok(outcome) => self.run_dir.check_intact().map(|()| outcome),
            Err(e) => Err(e),
        };
        // Transitions that an actor could not deliver count as lost and are not an error: what was learned is saved.
        let error = result.as_ref().err();
        let error = error.map_or(String::new(), |e| format!("{e:#}"));
        let mut warnings: Vec<_> = actors.into_iter().chain(others).collect();
        warnings.extend(failed.filter(|it| !warnings.contains(it)));
        let new = warnings.iter().filter(|it| !error.contains(*it));
        let lines = new.map(|warning| format!("while stopping, {warning}"));
        self.display.screen.print_lines(lines);
        result
    }

    /// Tells the learner to stop, then polls its status until it reports that it has saved, exits or does not answer for long.
    fn wait_for_final_checkpoint(&mut self) {
        let Some(learner) = self.processes.get_mut(self.endpoints.len()) else {
            return;
        };
        if learner.exit_status().is_some() {
            return;
        }
        let poller = &mut self.poller;
        // Ask once before the signal: a learner that has finished may exit right after it.
        if let Err(e) = poller.poll_learner() {
            tracing::debug!("a question before the last: {e:#}");
        }
        learner.ask_to_stop();
        let deadline = Instant::now() + LEARNER_DRAIN_MAX + RETRY_MAX;
        let mut silence = Silence::default();
        while Instant::now() <= deadline
            && silence.length() <= LAST_STATUS_MAX
            && !self.shutdown.immediate.is_set()
            && learner.exit_status().is_none()
        {
            match poller.poll_learner() {
                Ok(()) if poller.view.learner.finished => return,
                Ok(()) => silence.record_answer(),
                Err(e) => {
                    silence.record_failure();
                    tracing::debug!("a last question: {e:#}");
                }
            }
            std::thread::sleep(DRAIN_POLL);
        }
    }

    /// Writes the last row and the summary. Prints which rows and lines are lost; the result says whether the summary was written.
    fn write_summary(
        &mut self,
        outcome: Outcome,
        [servers_before, actors_before]: [u32; 2],
    ) -> (Summary, anyhow::Result<()>) {
        let view = &mut self.poller.view;
        // A run whose servers never answered has no row.
        if !view.shards.is_empty() {
            self.recorder.record(view, &[]);
        }
        let processes = self.processes.iter();
        let logs = processes.filter_map(|it| it.log.as_ref()?.loss_message());
        let missing = console::join_losses(self.recorder.loss_messages().into_iter().chain(logs));
        missing.iter().for_each(|line| console::eprintln(line));
        let mut summary = self.recorder.summarise(outcome, view);
        summary.replay_servers_restarted = servers_before + self.server_restarts;
        summary.actors_restarted = actors_before + self.actor_restarts;
        let written = summary.write(self.run_dir);
        (summary, written)
    }
}
