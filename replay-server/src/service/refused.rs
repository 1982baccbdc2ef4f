//! Who was not let in at all, by certificate or role: counted, and logged at a bounded rate.
//! It refuses nobody: zenoh has done so.

use std::{
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError},
    },
    thread::JoinHandle,
    time::Duration,
};

use driml_protocol::{fault, tls::Report};

use super::server::Service;

/// How often the thread looks whether it should end.
const TICK: Duration = Duration::from_millis(200);

impl Service {
    /// Starts the thread that hears of them; it ends after the shutdown.
    pub(super) fn start_hearing(
        self: Arc<Self>,
        reports: Receiver<Report>,
    ) -> std::io::Result<JoinHandle<()>> {
        let thread = std::thread::Builder::new().name("refused".into());
        thread.spawn(move || {
            while !self.shutdown.is_set() {
                fault::point("refused");
                match reports.recv_timeout(TICK) {
                    Ok(report) => self.hear(report),
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
        })
    }

    fn hear(&self, report: Report) {
        let mut state = self.state();
        match report {
            Report::Connection(why) => {
                state.connections_refused += 1;
                state.say(&why, &format!("a connection was refused: {why}"));
            }
            Report::Message(why) => {
                state.replay.note_refused_message();
                state.say(&why, &format!("a message was refused: {why}"));
            }
        }
    }
}
