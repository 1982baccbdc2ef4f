//! The launcher's processes: the command line of each, and the restart of processes that have died.
//! When the first processes start, and how all of them end, is in `mod`.

use std::{
    ffi::{OsStr, OsString},
    path::PathBuf,
};

use anyhow::{Context, bail};
use driml_machine::error::EXIT_USAGE;
use driml_protocol::{GracefulShutdown, session};
use driml_settings::config::RunConfig;

use crate::{
    evaluator::Evaluator,
    managed_process::{ManagedProcess, is_orderly_exit, program_command},
    rendezvous::Rendezvous,
    run_folder::{RunFolder, RunRecorder},
    view::{Display, Poller},
};

/// How often replay servers that keep their replay on disk are restarted in one run, in total; one more failure is an error.
const RESTARTS_MAX: u32 = 8;
/// How often actors that have died are restarted in one run, in total; one more failure is an error.
const ACTOR_RESTARTS_MAX: u32 = 16;
/// Threads for arithmetic in an actor and in a replay server: one, as many processes share the cores.
const PROCESS_THREADS: u32 = 1;

/// The role of a process: the replay server of a shard, the learner, or the actor with an ID.
#[derive(Clone, Copy)]
enum ProcessRole {
    ReplayServer(usize),
    Learner,
    Actor(usize),
}

/// The names of the processes that the launcher starts: replay servers, learner, actors.
pub(crate) fn process_names(config: &RunConfig) -> Vec<String> {
    let mut names: Vec<String> = match config.replay.shards {
        1 => vec!["replay-server".into()],
        shards => (0..shards).map(|i| format!("replay-server-{i}")).collect(),
    };
    names.push("learner".into());
    names.extend((0..config.local.actors).map(|id| format!("actor-{id}")));
    names
}

/// How clients from outside the run reach the replay server.
#[derive(Clone, Debug, Default)]
pub struct ExternalAccess {
    /// The endpoint that replaces the private unix socket; with certificates, an endpoint in addition to the socket.
    pub listen: Option<String>,
    /// The folder of certificates.
    pub tls_dir: Option<PathBuf>,
    /// Whether every client that can connect is trusted.
    pub allow_insecure: bool,
}

/// A run that is started on one machine: its processes, and the parts that watch and record it.
pub(super) struct Launch<'a> {
    pub(super) config: &'a RunConfig,
    /// Whether chunks and batches go through shared memory: the settings ask for it, and there is enough for all processes.
    pub(super) shared_memory: bool,
    pub(super) run_dir: &'a RunFolder,
    /// The endpoint of each replay server, one per shard.
    pub(super) endpoints: Vec<String>,
    pub(super) external: ExternalAccess,
    pub(super) rendezvous: Rendezvous,
    pub(super) display: Display,
    pub(super) shutdown: GracefulShutdown,
    /// The names of all processes, and the processes started so far, both in the order replay servers, learner, actors.
    pub(super) names: Vec<String>,
    pub(super) processes: Vec<ManagedProcess>,
    pub(super) evaluator: Evaluator,
    pub(super) server_restarts: u32,
    pub(super) actor_restarts: u32,
    /// Has no connection until all replay servers listen.
    pub(super) poller: Poller,
    /// Dropped last: until then its lock keeps other launchers out of the folder.
    pub(super) recorder: RunRecorder,
}

impl Launch<'_> {
    /// The role of the process at index `number` of `names`.
    fn role(&self, number: usize) -> ProcessRole {
        match number.checked_sub(self.endpoints.len()) {
            None => ProcessRole::ReplayServer(number),
            Some(0) => ProcessRole::Learner,
            Some(after) => ProcessRole::Actor(after - 1),
        }
    }

    pub(super) fn start_up_to(&mut self, count: usize) -> anyhow::Result<()> {
        for number in self.processes.len()..count {
            self.processes.push(self.start(number)?);
        }
        Ok(())
    }

    fn start(&self, number: usize) -> anyhow::Result<ManagedProcess> {
        let role = self.role(number);
        let (command, threads) = match role {
            ProcessRole::ReplayServer(_) => ("replay-server --keep-alive", PROCESS_THREADS),
            ProcessRole::Learner => ("learner --keep-alive", self.config.local.learner_threads),
            ProcessRole::Actor(_) => ("actor", PROCESS_THREADS),
        };
        let mut args: Vec<OsString> = command.split(' ').map(OsString::from).collect();
        let mut flag = |name: &str, value: &dyn AsRef<OsStr>| {
            args.extend([OsString::from(name), value.as_ref().to_owned()]);
        };
        let (local, endpoints) = (&self.config.local, &self.endpoints);
        match role {
            ProcessRole::ReplayServer(shard) => {
                flag("--listen", &endpoints[shard]);
                flag("--shard", &shard.to_string());
                flag("--config", &self.run_dir.config());
                if self.config.transport.shared_memory && !self.shared_memory {
                    flag("--set", &"transport.shared_memory=false");
                }
                if local.durable {
                    flag("--replay-dir", &self.run_dir.replay());
                }
                // The first server can also be reached from outside the run.
                let external = &self.external;
                if shard == 0
                    && let (Some(listen), Some(folder)) = (&external.listen, &external.tls_dir)
                {
                    flag("--listen", listen);
                    flag("--tls-dir", folder);
                }
                if shard == 0 && external.allow_insecure {
                    args.push("--allow-insecure".into());
                }
            }
            ProcessRole::Learner => {
                flag("--run-dir", &self.run_dir.path());
                flag("--device", &local.learner_device.to_string());
                endpoints.iter().for_each(|it| flag("--connect", it));
            }
            ProcessRole::Actor(id) => {
                flag("--connect", &endpoints[id % endpoints.len()]);
                flag("--id", &id.to_string());
                if self.config.world.name().foreign_code().is_some() {
                    flag("--env", &self.config.run.world);
                }
            }
        }
        let name = &self.names[number];
        let lock = self.rendezvous.lock_handle();
        let mut command = program_command(&args, threads);
        command.stdin(lock.with_context(|| format!("starting {name}"))?);
        ManagedProcess::start(name, command, &self.run_dir.logs(), &self.display.screen)
    }

    /// Whether an actor has exited although frames are missing. Asks the replay server again, so that its answer is newer than the exit.
    fn is_actor_needed(&mut self) -> bool {
        let poller = &mut self.poller;
        let actors = self.processes.iter_mut().skip(self.endpoints.len() + 1);
        let mut exits = actors.map(ManagedProcess::exit_status);
        if poller.view.replay.finished || !exits.any(|it| it.is_some()) {
            return false;
        }
        poller.poll_replay().is_ok() && !poller.view.replay.finished
    }

    /// Restarts processes that have died: replay servers that keep their replay on disk, and actors. Transitions that an actor had
    /// not delivered are lost; the run continues. Fails if a process has died that is not restarted.
    pub(super) fn restart_dead(&mut self) -> anyhow::Result<()> {
        let is_actor_needed = self.is_actor_needed();
        for number in 0..self.processes.len() {
            let role = self.role(number);
            let process = &mut self.processes[number];
            let Some(status) = process.exit_status() else {
                continue;
            };
            let is_actor = matches!(role, ProcessRole::Actor(_));
            if is_actor && is_orderly_exit(status) && !is_actor_needed {
                continue;
            }
            let (name, report) = (&self.names[number], process.exit_report());
            let (restarts, max, with_replay) = match role {
                // A new process would reject its configuration again.
                _ if status.code() == Some(EXIT_USAGE.into()) => bail!("{report}"),
                ProcessRole::ReplayServer(_) if self.config.local.durable => {
                    (&mut self.server_restarts, RESTARTS_MAX, " with its replay")
                }
                ProcessRole::Actor(_) if process.is_restartable() => {
                    (&mut self.actor_restarts, ACTOR_RESTARTS_MAX, "")
                }
                _ => bail!("{report}"),
            };
            if *restarts >= max {
                bail!("{report}");
            }
            if is_actor && !self.config.world.is_resumable() {
                bail!(
                    "{report}\n{name} cannot be restarted, so start the run again: the ghosts of this run change as episodes pass, and a \
                     new process would count these from 0"
                );
            }
            *restarts += 1;
            self.display.screen.print_line(&format!(
                "{report}\nrestarting {name}{with_replay} (restart {restarts} of at most {max})"
            ));
            session::remove_orphaned_shared_memory();
            self.processes[number] = self.start(number)?;
        }
        Ok(())
    }
}
