//! The launcher's processes: the words that start each, and those that are started again when they have died.
//! When the first are started, and how all end, is in `mod`.

use std::path::Path;

use anyhow::bail;
use driml_protocol::session;

use super::{Launch, Outside};
use crate::{
    managed_process::{ManagedProcess, Surroundings},
    processes::Revived,
};

/// How often replay servers that keep their replay on disk are started again in a run, all together.
const RESTARTS_MAX: u32 = 8;
/// How often actors that have died are started again in one run, all together; one more is an error.
const ACTOR_RESTARTS_MAX: u32 = 16;
/// Threads of an actor and of the replay server for arithmetic: many processes share the cores.
const PROCESS_THREADS: u32 = 1;

/// A command of this program and flags with their values.
fn call<'a>(command: &str, flags: impl IntoIterator<Item = (&'a str, &'a str)>) -> Vec<String> {
    let flags = flags.into_iter().flat_map(|(flag, value)| [flag, value]);
    let words = command.split(' ').chain(flags);
    words.map(str::to_owned).collect()
}

impl Outside {
    /// Flags of the first replay server, beside where the processes meet.
    fn flags(&self) -> Vec<String> {
        let mut flags = Vec::new();
        if let (Some(listen), Some(folder)) = (&self.listen, &self.tls_dir) {
            let folder = folder.display().to_string();
            flags = ["--listen", listen, "--tls-dir", &folder]
                .map(str::to_owned)
                .to_vec();
        }
        if self.insecure_network {
            flags.push("--insecure-network".into());
        }
        flags
    }
}

impl Launch<'_> {
    fn surroundings<'a>(&'a self, logs: &'a Path) -> Surroundings<'a> {
        Surroundings {
            logs,
            screen: &self.screen,
            meeting: Some(&self.meeting),
        }
    }

    /// Starts the learner.
    pub(super) fn start_learner(&self) -> anyhow::Result<ManagedProcess> {
        let folder = self.run_dir.display().to_string();
        let device = self.config.local.learner_device.to_string();
        let connect = self.endpoints.iter().map(|it| ("--connect", it.as_str()));
        let flags = [("--run-dir", folder.as_str()), ("--device", &device)];
        let args = call("learner --stay", flags.into_iter().chain(connect));
        let logs = self.run_dir.logs();
        let threads = self.config.local.learner_threads;
        ManagedProcess::start("learner", &args, threads, self.surroundings(&logs))
    }

    /// Starts an actor.
    pub(super) fn start_actor(&self, id: u32) -> anyhow::Result<ManagedProcess> {
        let (number, endpoint) = (
            id.to_string(),
            &self.endpoints[id as usize % self.endpoints.len()],
        );
        let mut flags = vec![("--connect", endpoint.as_str()), ("--id", &number)];
        if self.config.world.name().foreign_code().is_some() {
            flags.push(("--env", &self.config.run.world));
        }
        let args = call("actor", flags);
        let logs = self.run_dir.logs();
        let name = format!("actor-{id}");
        ManagedProcess::start(&name, &args, PROCESS_THREADS, self.surroundings(&logs))
    }

    /// What is still restarted.
    pub(super) fn revived(&self) -> Revived {
        Revived {
            servers: self.config.local.durable && self.restarts < RESTARTS_MAX,
            actors: self.actor_restarts < ACTOR_RESTARTS_MAX,
        }
    }

    /// Restarts actors that have died. What one had not delivered is lost; the run continues.
    pub(super) fn revive_actors(&mut self) -> anyhow::Result<()> {
        for id in 0..self.processes.actors.len() {
            let actor = &mut self.processes.actors[id];
            if self.actor_restarts == ACTOR_RESTARTS_MAX || !actor.may_be_started_again() {
                continue;
            }
            let report = actor.exit_report();
            if !self.config.world.is_resumable() {
                bail!(
                    "{report}\nactor-{id} is not started again: the ghosts of this run change as episodes pass, and a new process would \
                     count these from 0"
                );
            }
            self.actor_restarts += 1;
            self.screen.line(&format!(
                "{report}\nactor-{id} is started again ({} of {ACTOR_RESTARTS_MAX} times in a run)",
                self.actor_restarts
            ));
            session::sweep_shared_memory();
            self.processes.actors[id] = self.start_actor(id as u32)?;
        }
        Ok(())
    }

    /// Starts the replay server of one shard.
    pub(super) fn start_server(&self, shard: usize) -> anyhow::Result<ManagedProcess> {
        let config = self.run_dir.config().display().to_string();
        let number = shard.to_string();
        let folder = self.run_dir.replay().display().to_string();
        let mut flags = vec![
            ("--listen", self.endpoints[shard].as_str()),
            ("--shard", &number),
            ("--config", &config),
        ];
        if self.config.transport.shared_memory && !self.shared_memory {
            flags.push(("--set", "transport.shared_memory=false"));
        }
        if self.config.local.durable {
            flags.push(("--replay-dir", &folder));
        }
        let mut args = call("replay-server --stay", flags);
        if shard == 0 {
            args.extend(self.outside.flags());
        }
        let logs = self.run_dir.logs();
        let name = &self.servers[shard];
        ManagedProcess::start(name, &args, PROCESS_THREADS, self.surroundings(&logs))
    }

    /// Restarts replay servers that have died, if they keep their replay on disk.
    pub(super) fn revive_servers(&mut self) -> anyhow::Result<()> {
        if !self.config.local.durable {
            return Ok(());
        }
        for shard in 0..self.processes.replay_servers.len() {
            let server = &mut self.processes.replay_servers[shard];
            if server.end().is_none() || self.restarts == RESTARTS_MAX {
                continue;
            }
            self.restarts += 1;
            let report = server.exit_report();
            self.screen.line(&format!(
                "{report}\n{} is started again with what it has kept ({} of {RESTARTS_MAX} times in a run)",
                self.servers[shard], self.restarts
            ));
            session::sweep_shared_memory();
            let server = self.start_server(shard)?;
            self.processes.replay_servers[shard] = server;
        }
        Ok(())
    }
}
