//! The thread with which an actor or the learner tells the replay server what it does.
//! Nobody waits for it, and a report that does not arrive is not sent again: the next one follows.

use std::{
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crate::{
    client::RunClient,
    messages::report::{Life, Report, Warning},
    process::{activity::Activity, last_warning, shutdown::Shutdown},
};

/// How often a part reports although nothing has changed.
const PERIOD: Duration = Duration::from_secs(2);
/// How often it looks whether something has.
const TICK: Duration = Duration::from_millis(250);
/// How long one report may take.
const TIMEOUT: Duration = Duration::from_secs(2);

/// Reports what `who` does to the replay servers of `clients`, until `shutdown` or the end of their sessions.
///
/// # Errors
/// The operating system gave no thread.
pub fn start(
    clients: Vec<RunClient>,
    who: Life,
    activity: Activity,
    shutdown: Shutdown,
) -> std::io::Result<JoinHandle<()>> {
    let work = move || {
        let mut said: Option<(String, Instant)> = None;
        loop {
            let (doing, since) = activity.get();
            let is_old = |(said, at): &(String, Instant)| *said != doing || at.elapsed() > PERIOD;
            if said.as_ref().is_none_or(is_old) {
                let warning = last_warning::get();
                let warning = warning.map(|(text, age)| Warning::new(&text, age.as_secs_f64()));
                let report = Report::new(who, &doing, since.as_secs_f64(), warning);
                for client in &clients {
                    if let Err(e) = client.ask(&report, TIMEOUT) {
                        tracing::debug!("a report did not arrive: {e}");
                    }
                }
                said = Some((doing, Instant::now()));
            }
            if shutdown.wait_timeout(TICK) || clients.iter().all(|it| it.session().is_closed()) {
                return;
            }
        }
    };
    std::thread::Builder::new()
        .name("report".into())
        .spawn(work)
}
