//! The launcher's session to a replay server that is still starting.
//! It starts no process; the actors and the learner connect by themselves.

use std::time::{Duration, Instant};

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
    loop {
        // Opening may take seconds, in which the replay server may end: so it runs on another thread.
        let endpoints = endpoints.clone();
        let (tell, told) = std::sync::mpsc::channel();
        let open = move || {
            fault::point("connect");
            // The receiver is gone if the run has ended meanwhile.
            let _ = tell.send(session::open(&endpoints));
        };
        let thread = std::thread::Builder::new().name("connect".into());
        thread.spawn(open).context("starting a thread")?;
        let opened = loop {
            if interrupts.count() > 0 {
                return Ok(None);
            }
            check_alive()?;
            match told.recv_timeout(Duration::from_millis(50)) {
                Ok(opened) => break opened,
                Err(_) if Instant::now() > deadline => {
                    bail!(
                        "the replay server does not listen on {endpoint} after {}",
                        duration(LISTEN_MAX)
                    )
                }
                Err(_) => {}
            }
        };
        match opened {
            Ok(session) => return Ok(Some(session)),
            Err(e) if Instant::now() > deadline => {
                return Err(e).context("reaching the replay server");
            }
            Err(e) => tracing::debug!("the replay server does not listen yet: {e}"),
        }
    }
}
