//! Processes of a launcher, and how some of them end.
//! It does not know what they do.

use std::{
    os::unix::process::ExitStatusExt,
    time::{Duration, Instant},
};

use driml_machine::units::duration;
use nix::sys::signal::Signal;

use crate::managed_process::{KILLED_MAX, ManagedProcess};

#[derive(Default)]
pub(crate) struct Processes {
    pub(crate) replay_servers: Vec<ManagedProcess>,
    pub(crate) learner: Option<ManagedProcess>,
    pub(crate) actors: Vec<ManagedProcess>,
}

impl Processes {
    /// Replay servers, learner, actors, in the order of their names.
    pub(crate) fn all(&mut self) -> impl Iterator<Item = &mut ManagedProcess> {
        let first = self.replay_servers.iter_mut().chain(&mut self.learner);
        first.chain(&mut self.actors)
    }
}

/// Waits for some processes to end, asking them first if `ask`; says which did not end well in time. None is left. A process that is
/// asked before it listens for signals dies of the request, and has nothing to save.
pub(crate) fn stop(
    processes: &mut [ManagedProcess],
    ask: bool,
    drain_max: Duration,
    abort: &impl Fn() -> bool,
) -> Vec<String> {
    if ask {
        processes.iter_mut().for_each(ManagedProcess::ask_to_stop);
    }
    let deadline = Instant::now() + drain_max;
    let mut late = Vec::new();
    for process in processes {
        match process.wait_until(deadline, abort) {
            Some(status) if status.success() => {}
            Some(status) if ask && status.signal() == Some(Signal::SIGTERM as i32) => {}
            Some(_) => late.push(process.exit_report()),
            None => {
                if !abort() {
                    late.push(format!(
                        "{} did not end within {} and was killed",
                        process.name,
                        duration(drain_max)
                    ));
                }
                process.kill();
                process.wait_until(Instant::now() + KILLED_MAX, || false);
            }
        }
    }
    late
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_that_dies_of_the_request_to_stop_has_stopped() {
        let logs = tempfile::tempdir().unwrap();
        let stopped = |script: &str, ask| {
            let process = ManagedProcess::of_script(script, logs.path());
            stop(&mut [process], ask, Duration::from_secs(60), &|| false)
        };
        assert_eq!(stopped("exec sleep 600", true), [] as [String; 0]);
        let killed = stopped("kill -TERM $$", false);
        assert!(killed[0].contains("signal 15 SIGTERM"), "{killed:?}");
        let failed = stopped("echo 'error: no room' >&2; exit 3", false);
        let said = "script exited with code 3";
        assert!(
            failed[0].starts_with(said) && failed[0].ends_with(".log): no room"),
            "{failed:?}"
        );
    }
}
