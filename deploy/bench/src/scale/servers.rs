//! The replay servers of a bench as processes of their own, and what they did in a while.
//! Who asks them for what is `synthetic`.

use std::{
    path::Path,
    sync::atomic::{AtomicU64, Ordering},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_launch::{
    console::Screen,
    endpoint::NAMESPACE,
    managed_process::{ManagedProcess, Surroundings},
    status_client::Statuses,
};
use driml_protocol::{
    Keys, ReplayStatus,
    session::{self, Endpoints},
};
use nix::unistd::{SysconfVar, sysconf};
use zenoh::{Session, Wait};

use crate::{
    replay::reach,
    settings::{self, AGENT},
};

/// How often a server is asked that does not answer.
const ASKED_MAX: u32 = 10;
/// How long a server may take to end.
const END_MAX: Duration = Duration::from_secs(30);

/// What some servers did in a while, all together.
pub(super) struct Watched {
    /// Transitions stored a second.
    pub(super) stored: f64,
    /// Batches a second that the learner got.
    pub(super) batches: f64,
    /// Cores that the servers used.
    pub(super) cores: f64,
    /// Resident memory of the servers, MiB.
    pub(super) memory: f64,
    /// Their account of themselves at the end.
    pub(super) replay: ReplayStatus,
}

/// The replay servers that are measured.
pub(super) struct Servers {
    processes: Vec<ManagedProcess>,
    endpoints: Vec<String>,
    pub(super) keys: Keys,
}

impl Servers {
    /// Starts `shards` of them, each once the one before it listens.
    pub(super) fn start(shards: u32, sets: &[String], folder: &Path) -> anyhow::Result<Self> {
        let (mut processes, mut endpoints) = (Vec::new(), Vec::new());
        for shard in 0..shards {
            let name = format!("replay-server-{shard}");
            let socket = folder.join(format!("{shard}.sock"));
            let endpoint = format!("unixsock-stream/{}", socket.display());
            let shard = shard.to_string();
            let words = ["replay-server", "--stay", "--listen", &endpoint];
            let run = [
                "--shard",
                &shard,
                "--env",
                settings::WORLD,
                "--agent",
                AGENT,
            ];
            let args: Vec<String> = words
                .into_iter()
                .chain(run)
                .chain(sets.iter().flat_map(|set| ["--set", set.as_str()]))
                .map(Into::into)
                .collect();
            let surroundings = Surroundings {
                logs: folder,
                screen: &Screen::plain(),
                meeting: None,
            };
            let mut process = ManagedProcess::start(&name, &args, 1, surroundings)?;
            let at = Endpoints {
                listen: Vec::new(),
                connect: vec![endpoint.clone()],
            };
            let session = reach(&mut process, || session::open(&at))?;
            if let Err(e) = session.close().wait() {
                tracing::debug!("closing a session: {e}");
            }
            processes.push(process);
            endpoints.push(endpoint);
        }
        Ok(Self {
            processes,
            endpoints,
            keys: Keys::new(NAMESPACE).map_err(anyhow::Error::msg)?,
        })
    }

    /// A new session with one of them.
    pub(super) fn session(&self, shard: u32) -> anyhow::Result<Session> {
        Ok(session::open(&Endpoints {
            listen: Vec::new(),
            connect: vec![self.endpoints[shard as usize].clone()],
        })?)
    }

    /// A new session with each of them.
    pub(super) fn sessions(&self) -> anyhow::Result<Vec<Session>> {
        (0..self.processes.len() as u32)
            .map(|shard| self.session(shard))
            .collect()
    }

    /// What happens in the next `seconds`; `batches` counts those that arrived.
    pub(super) fn watch(
        &mut self,
        statuses: &mut Statuses,
        batches: &AtomicU64,
        seconds: f64,
    ) -> anyhow::Result<Watched> {
        let mut moment = |servers: &mut Self| -> anyhow::Result<(Instant, u64, u64, f64)> {
            ask(statuses)?;
            let stored = statuses.replay.transitions_inserted;
            let served = batches.load(Ordering::Relaxed);
            Ok((Instant::now(), stored, served, servers.processor_seconds()?))
        };
        let (started, stored, served, busy) = moment(self)?;
        thread::sleep(Duration::from_secs_f64(seconds));
        let (ended, stored_after, served_after, busy_after) = moment(self)?;
        let elapsed = (ended - started).as_secs_f64();
        let memory = self.processes.iter_mut().map(ManagedProcess::rss_mib);
        Ok(Watched {
            stored: (stored_after - stored) as f64 / elapsed,
            batches: (served_after - served) as f64 / elapsed,
            cores: (busy_after - busy) / elapsed,
            memory: memory.map(Option::unwrap_or_default).sum(),
            replay: statuses.replay.clone(),
        })
    }

    /// Processor time of all servers so far.
    fn processor_seconds(&mut self) -> anyhow::Result<f64> {
        let ticks_a_second = sysconf(SysconfVar::CLK_TCK)?.context("the system's clock ticks")?;
        let mut ticks = 0;
        for process in &mut self.processes {
            if process.end().is_some() {
                bail!("{}", process.exit_report());
            }
            let path = format!("/proc/{}/stat", process.pid());
            let stat = std::fs::read_to_string(&path).with_context(|| format!("reading {path}"))?;
            ticks +=
                processor_ticks(&stat).with_context(|| format!("{path} is not as expected"))?;
        }
        Ok(ticks as f64 / ticks_a_second as f64)
    }

    /// Ends them in order.
    pub(super) fn end(&mut self) {
        for process in &mut self.processes {
            process.ask_to_stop();
            process.wait_until(Instant::now() + END_MAX, || false);
        }
    }
}

/// Asks the servers how they are. Where hundreds of clients in this process receive at once, that may take a while.
///
/// # Errors
/// None of several questions was answered.
pub(super) fn ask(statuses: &mut Statuses) -> anyhow::Result<()> {
    for _ in 1..ASKED_MAX {
        if statuses.ask_replay().is_ok() {
            return Ok(());
        }
    }
    statuses.ask_replay()
}

/// Clock ticks in user and system mode, from `/proc/PID/stat`.
fn processor_ticks(stat: &str) -> Option<u64> {
    // The second field is a name in brackets that may hold anything.
    let (_, fields) = stat.rsplit_once(')')?;
    let mut fields = fields.split_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<u64>().ok();
    Some(next()? + next()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processor_time_is_read_past_any_name() {
        let stat = "7 (a ) b) S 1 1 1 0 -1 4194560 9 0 0 0 150 25 0 0 20 0 8 0 100 1 1";
        assert_eq!(processor_ticks(stat), Some(175));
        assert_eq!(processor_ticks("7 (x) S 1"), None);
    }
}
