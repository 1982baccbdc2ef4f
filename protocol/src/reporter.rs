//! The thread by which an actor or the learner reports to the replay server what it does. No process waits for a report, and a lost one is
//! not sent again, because the next one follows. Only the learner's last report, that the run is finished, is retried until it arrives.

use std::{
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crate::{
    client::RunClient,
    messages::{
        report::{Participant, Report, Warning},
        table::Ack,
    },
    process::{
        activity::Activity, fail_point, last_warning, shutdown::Shutdown, silence::Silence, spawn,
    },
    session::SessionError,
};

/// How often a process reports if nothing has changed.
const PERIOD: Duration = Duration::from_secs(2);
/// How often a process checks whether its activity has changed.
const TICK: Duration = Duration::from_millis(250);
const REPORT_TIMEOUT: Duration = Duration::from_secs(2);
/// How long the learner retries its last report at a replay server that does not answer: the server may be restarting.
const FINISHED_RETRY_MAX: Duration = Duration::from_secs(30);

/// Reports to each replay server of `clients` that the learner `who` has finished the run after `updates` updates. Retries until the server
/// answers or `shutdown` is set, at least once: for 30 s, plus all the time in which the server reads its replay back.
pub fn report_finished(clients: &[RunClient], who: Participant, updates: u64, shutdown: &Shutdown) {
    let finished = Report {
        finished: Some(updates),
        ..new_report(who, "has finished", Duration::ZERO)
    };
    for client in clients {
        send_until_acked(|| client.ask(&finished, REPORT_TIMEOUT), shutdown);
    }
}

fn send_until_acked(mut send: impl FnMut() -> Result<Ack, SessionError>, shutdown: &Shutdown) {
    let mut silence = Silence::default();
    while let Err(e) = send() {
        if matches!(e, SessionError::Recovering(_)) {
            silence.record_answer();
        }
        if silence.record_failure() > FINISHED_RETRY_MAX {
            tracing::warn!("a replay server was not told that the run is over: {e}; stop it");
            return;
        }
        if shutdown.wait_timeout(TICK) {
            return;
        }
    }
}

/// Returns a report that `who` does `doing`, with the last warning in the log of this process.
fn new_report(who: Participant, doing: &str, since: Duration) -> Report {
    let warning = last_warning::get();
    let warning = warning.map(|(text, age)| Warning::new(&text, age.as_secs_f64()));
    Report::new(who, doing, since.as_secs_f64(), warning)
}

/// Starts a thread that reports what `who` does to the replay servers of `clients`, until `shutdown` is set or all sessions are closed.
pub fn start(
    clients: Vec<RunClient>,
    who: Participant,
    activity: Activity,
    shutdown: Shutdown,
) -> std::io::Result<JoinHandle<()>> {
    let work = move || {
        let mut last: Option<(String, Instant)> = None;
        loop {
            fail_point::reach("reporter");
            let (doing, since) = activity.get();
            let is_old = |(sent, at): &(String, Instant)| *sent != doing || at.elapsed() > PERIOD;
            if last.as_ref().is_none_or(is_old) {
                let report = new_report(who, &doing, since);
                for client in &clients {
                    if let Err(e) = client.ask(&report, REPORT_TIMEOUT) {
                        tracing::debug!("a report did not arrive: {e}");
                    }
                }
                last = Some((doing, Instant::now()));
            }
            if shutdown.wait_timeout(TICK) || clients.iter().all(|it| it.session().is_closed()) {
                return;
            }
        }
    };
    spawn("reporter", work)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::recovering::Recovering;

    #[test]
    fn that_the_run_is_finished_is_sent_until_a_server_that_comes_back_hears_it() {
        let key = String::new();
        let mut answers = [
            Err(SessionError::NoResponder { key }),
            Err(SessionError::Recovering(Recovering::default())),
            Ok(Ack),
        ]
        .into_iter();
        send_until_acked(|| answers.next().unwrap(), &Shutdown::default());
        assert_eq!(answers.count(), 0);
    }
}
