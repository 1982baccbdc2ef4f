//! The thread with which an actor or the learner tells the replay server what it does.
//! Nothing waits for a report, and a lost one is not sent again: the next one follows.

use std::{
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crate::{
    client::RunClient,
    messages::report::{Participant, Report, Warning},
    process::{activity::Activity, fail_point, last_warning, shutdown::Shutdown},
};

/// How often a process reports although nothing has changed.
const PERIOD: Duration = Duration::from_secs(2);
/// How often it looks whether something has.
const TICK: Duration = Duration::from_millis(250);
const TIMEOUT: Duration = Duration::from_secs(2);

/// Tells the replay servers of `clients` once that `who`, the learner, has finished the run after so many
/// updates, whatever comes of it.
pub fn say_finished(clients: &[RunClient], who: Participant, updates: u64) {
    let finished = Report {
        finished: Some(updates),
        ..report(who, "has finished", Duration::ZERO)
    };
    send(clients, &finished);
}

/// What `who` says of itself, and the last warning in the log of this process.
fn report(who: Participant, doing: &str, since: Duration) -> Report {
    let warning = last_warning::get();
    let warning = warning.map(|(text, age)| Warning::new(&text, age.as_secs_f64()));
    Report::new(who, doing, since.as_secs_f64(), warning)
}

fn send(clients: &[RunClient], report: &Report) {
    for client in clients {
        if let Err(e) = client.ask(report, TIMEOUT) {
            tracing::debug!("a report did not arrive: {e}");
        }
    }
}

/// Reports what `who` does to the replay servers of `clients`, until `shutdown` or the end of their sessions.
pub fn start(
    clients: Vec<RunClient>,
    who: Participant,
    activity: Activity,
    shutdown: Shutdown,
) -> std::io::Result<JoinHandle<()>> {
    let work = move || {
        let mut said: Option<(String, Instant)> = None;
        loop {
            fail_point::reach("reporter");
            let (doing, since) = activity.get();
            let is_old = |(said, at): &(String, Instant)| *said != doing || at.elapsed() > PERIOD;
            if said.as_ref().is_none_or(is_old) {
                send(&clients, &report(who, &doing, since));
                said = Some((doing, Instant::now()));
            }
            if shutdown.wait_timeout(TICK) || clients.iter().all(|it| it.session().is_closed()) {
                return;
            }
        }
    };
    std::thread::Builder::new()
        .name("reporter".into())
        .spawn(work)
}
