//! The launcher's session to a replay server that is still starting.
//! It starts no process; the actors and the learner connect by themselves.

use std::{
    sync::mpsc::sync_channel,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_machine::units::duration;
use driml_protocol::{
    fault,
    session::{self, Endpoints},
};

use crate::interrupts::Interrupts;

/// How long the replay server may take to listen.
const LISTEN_MAX: Duration = Duration::from_secs(30);

/// A session to the replay server as soon as it listens; none after an interrupt. `check_alive` says whether it still can.
pub(crate) fn connect(
    endpoint: &str,
    interrupts: &Interrupts,
    mut check_alive: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<Option<zenoh::Session>> {
    let endpoints = Endpoints {
        listen: Vec::new(),
        connect: vec![endpoint.to_owned()],
    };
    let deadline = Instant::now() + LISTEN_MAX;
    let (tell, told) = sync_channel(0);
    // Opening may take seconds, in which the replay server may end: so it runs on another thread.
    let open = move || {
        loop {
            fault::point("connect");
            let opened = session::open(&endpoints);
            let is_open = opened.is_ok();
            // The receiver is gone if the run has ended meanwhile.
            if tell.send(opened).is_err() || is_open {
                return;
            }
        }
    };
    let thread = std::thread::Builder::new().name("connect".into());
    thread.spawn(open).context("starting a thread")?;
    while interrupts.count() == 0 {
        check_alive()?;
        let opened = told.recv_timeout(Duration::from_millis(50));
        let is_late = Instant::now() > deadline;
        match opened {
            Ok(Ok(session)) => return Ok(Some(session)),
            Ok(Err(e)) if is_late => return Err(e).context("reaching the replay server"),
            Ok(Err(e)) => tracing::debug!("the replay server does not listen yet: {e}"),
            Err(_) if is_late => bail!(
                "the replay server does not listen on {endpoint} after {}",
                duration(LISTEN_MAX)
            ),
            Err(_) => {}
        }
    }
    Ok(None)
}
