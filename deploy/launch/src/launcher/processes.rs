//! The launcher's processes: the words that start each, and those that are started again when they have died.
//! When the first are started, and how all end, is in `mod`.

use std::{
    ffi::{OsStr, OsString},
    process::ExitStatus,
};

use anyhow::bail;
use driml_protocol::session;

use super::{Launch, Outside};
use crate::managed_process::ManagedProcess;

/// How often replay servers that keep their replay on disk are started again in a run, all together.
const RESTARTS_MAX: u32 = 8;
/// How often actors that have died are started again in one run, all together; one more is an error.
const ACTOR_RESTARTS_MAX: u32 = 16;
/// Threads of an actor and of the replay server for arithmetic: many processes share the cores.
const PROCESS_THREADS: u32 = 1;

fn call<'a>(
    command: &'a str,
    flags: impl IntoIterator<Item = (&'a str, &'a OsStr)>,
) -> Vec<OsString> {
    let flags = flags.into_iter();
    let flags = flags.flat_map(|(flag, value)| [OsStr::new(flag), value]);
    let words = command.split(' ').map(OsStr::new).chain(flags);
    words.map(OsStr::to_owned).collect()
}

impl Outside {
    /// Flags of the first replay server, beside where the processes meet.
    fn flags(&self) -> Vec<OsString> {
        let mut flags = Vec::new();
        if let (Some(listen), Some(folder)) = (&self.listen, &self.tls_dir) {
            flags.extend(["--listen".into(), listen.into()]);
            flags.extend(["--tls-dir".into(), folder.into()]);
        }
        if self.allow_insecure {
            flags.push("--allow-insecure".into());
        }
        flags
    }
}

impl Launch<'_> {
    fn start(&self, name: &str, args: &[OsString], threads: u32) -> anyhow::Result<ManagedProcess> {
        let (logs, screen) = (self.run_dir.logs(), &self.display.screen);
        ManagedProcess::start(name, args, threads, &logs, screen, Some(&self.rendezvous))
    }

    pub(super) fn start_learner(&self) -> anyhow::Result<ManagedProcess> {
        let folder = self.run_dir.path().as_os_str();
        let device = OsString::from(self.config.local.learner_device.to_string());
        let endpoints = self.endpoints.iter().map(OsStr::new);
        let connect = endpoints.map(|it| ("--connect", it));
        let flags = [("--run-dir", folder), ("--device", &device)];
        let args = call("learner --keep-alive", flags.into_iter().chain(connect));
        self.start("learner", &args, self.config.local.learner_threads)
    }

    pub(super) fn start_actor(&self, id: u32) -> anyhow::Result<ManagedProcess> {
        let number = OsString::from(id.to_string());
        let endpoint = OsStr::new(&self.endpoints[id as usize % self.endpoints.len()]);
        let mut flags = vec![("--connect", endpoint), ("--id", &number)];
        if self.config.world.name().foreign_code().is_some() {
            flags.push(("--env", OsStr::new(&self.config.run.world)));
        }
        let args = call("actor", flags);
        self.start(&format!("actor-{id}"), &args, PROCESS_THREADS)
    }

    pub(super) fn start_server(&self, shard: usize) -> anyhow::Result<ManagedProcess> {
        let (config, folder) = (self.run_dir.config(), self.run_dir.replay());
        let number = OsString::from(shard.to_string());
        let mut flags = vec![
            ("--listen", OsStr::new(&self.endpoints[shard])),
            ("--shard", &number),
            ("--config", config.as_os_str()),
        ];
        if self.config.transport.shared_memory && !self.shared_memory {
            flags.push(("--set", OsStr::new("transport.shared_memory=false")));
        }
        if self.config.local.durable {
            flags.push(("--replay-dir", folder.as_os_str()));
        }
        let mut args = call("replay-server --keep-alive", flags);
        if shard == 0 {
            args.extend(self.outside.flags());
        }
        self.start(&self.servers[shard], &args, PROCESS_THREADS)
    }

    /// Whether an actor has exited though frames are missing, by an answer that is newer than its end.
    fn is_actor_missed(&mut self) -> bool {
        let Some(poller) = &mut self.poller else {
            return false;
        };
        let mut ends = self.processes.actors.iter_mut().map(ManagedProcess::end);
        if poller.view.replay.finished || !ends.any(|it| it.is_some()) {
            return false;
        }
        poller.ask_replay().is_ok() && !poller.view.replay.finished
    }

    /// Restarts processes that have died: replay servers that keep their replay on disk, and actors. What an actor had not delivered is
    /// lost; the run continues.
    ///
    /// # Errors
    /// One that has died is not restarted.
    pub(super) fn revive(&mut self) -> anyhow::Result<()> {
        let actors_are_needed = self.is_actor_missed();
        for shard in 0..self.processes.replay_servers.len() {
            let server = &mut self.processes.replay_servers[shard];
            if !self.config.local.durable || self.server_restarts >= RESTARTS_MAX {
                server.check_alive()?;
            } else if server.end().is_some() {
                let report = server.exit_report();
                self.server_restarts += 1;
                let how = format!(
                    "{} is started again with what it has kept ({} of {RESTARTS_MAX} times in a run)",
                    self.servers[shard], self.server_restarts
                );
                self.note_restart(&report, &how);
                self.processes.replay_servers[shard] = self.start_server(shard)?;
            }
        }
        let mut learner = self.processes.learner.iter_mut();
        learner.try_for_each(ManagedProcess::check_alive)?;
        for id in 0..self.processes.actors.len() {
            let actor = &mut self.processes.actors[id];
            let is_over = |status: ExitStatus| status.success() && !actors_are_needed;
            if actor.end().is_none_or(is_over) {
                continue;
            }
            let report = actor.exit_report();
            if !actor.may_be_started_again() || self.actor_restarts >= ACTOR_RESTARTS_MAX {
                bail!("{report}");
            }
            if !self.config.world.is_resumable() {
                bail!(
                    "{report}\nactor-{id} is not started again: the ghosts of this run change as episodes pass, and a new process would \
                     count these from 0"
                );
            }
            self.actor_restarts += 1;
            let how = format!(
                "actor-{id} is started again ({} of {ACTOR_RESTARTS_MAX} times in a run)",
                self.actor_restarts
            );
            self.note_restart(&report, &how);
            self.processes.actors[id] = self.start_actor(id as u32)?;
        }
        Ok(())
    }

    fn note_restart(&self, report: &str, how: &str) {
        self.display.screen.line(&format!("{report}\n{how}"));
        session::sweep_shared_memory();
    }
}
