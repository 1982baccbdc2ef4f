//! Code of all commands that join a run: how they reach the run, and how they clean up when they exit.

use std::{io, path::PathBuf, sync::Arc};

use anyhow::Context;
use clap::Args;
use driml_launch::{endpoint::DEFAULT_NAMESPACE, rendezvous, shared_memory};
use driml_machine::error::{Interrupted, Usage};
use driml_protocol::{
    Keys,
    session::{self, Connection, Endpoints},
    tls::{Credentials, Role},
};

/// Flags for how a process reaches the run.
#[derive(Debug, Args)]
pub(crate) struct JoinFlags {
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = DEFAULT_NAMESPACE)]
    pub(crate) namespace: String,
    /// Exit when the parent process PID exits
    #[arg(long, value_name = "PID", hide = true)]
    pub(crate) exit_with_parent: Option<u32>,
}

/// The flag for when a replay server or a learner exits.
#[derive(Debug, Args)]
pub(crate) struct KeepAliveFlag {
    /// After the run, keep answering until Ctrl-C or a signal
    #[arg(long)]
    pub(super) keep_alive: bool,
}

/// The flag for the certificates of a process.
#[derive(Debug, Args)]
pub(crate) struct TlsFlags {
    /// Use mutual TLS with the certificates in DIR, made by deploy/certs.sh; endpoints are then quic/HOST:PORT (over UDP) or unix
    /// sockets. DIR has ca.pem, ROLE.pem and ROLE.key, where ROLE is actor-N (N is its --id), learner, replay-server or, for
    /// status and watch, observer
    #[arg(long, value_name = "DIR")]
    pub(crate) tls_dir: Option<PathBuf>,
}

/// The flag to trust every client that can connect.
#[derive(Debug, Args)]
pub(crate) struct NetworkFlag {
    /// Allow other machines to connect without certificates: anyone who reaches the endpoint can read, change and stop the run
    #[arg(long, requires = "listen", conflicts_with = "tls_dir")]
    pub(crate) allow_insecure: bool,
}

impl TlsFlags {
    pub(crate) const fn is_set(&self) -> bool {
        self.tls_dir.is_some()
    }

    pub(super) fn credentials(&self, role: Role) -> Result<Option<Arc<Credentials>>, Usage> {
        let read = |folder: &PathBuf| Credentials::read(folder, role).map(Arc::new);
        let read = self.tls_dir.as_ref().map(read).transpose();
        let read = read.map_err(|e| Usage(e.to_string()))?;
        if let Some(advice) = read.as_ref().and_then(|it| it.advice()) {
            tracing::warn!("{advice}");
        }
        Ok(read)
    }

    /// Returns how a process in this role reaches the run at these endpoints.
    pub(super) fn connection(
        &self,
        role: Role,
        namespace: &str,
        connect: Vec<String>,
    ) -> Result<Connection, Usage> {
        Ok(Connection {
            credentials: self.credentials(role)?,
            keys: Keys::new(namespace).map_err(Usage)?,
            endpoints: Endpoints::connect_to(connect),
        })
    }
}

/// Removes the shared memory of processes that were killed, and calls `listen` to listen for signals.
pub(super) fn prepare_join<T>(
    flags: &JoinFlags,
    listen: fn(Option<u32>) -> io::Result<T>,
) -> anyhow::Result<T> {
    if flags.exit_with_parent.is_none() {
        session::remove_orphaned_shared_memory();
    }
    listen(flags.exit_with_parent).context("listening for signals")
}

/// Removes what a process leaves outside the run folder. If `ran` is false, the run is not over, and this fails as [`Interrupted`], so that
/// a scheduler that stops the process does not count it as complete.
pub(super) fn clean_up_after(ran: anyhow::Result<bool>) -> anyhow::Result<()> {
    rendezvous::leave();
    shared_memory::remove_own_segments();
    match ran? {
        true => Ok(()),
        false => Err(Interrupted.into()),
    }
}
