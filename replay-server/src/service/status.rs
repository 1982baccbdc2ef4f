//! The smaller messages: an actor's `Leave`, the learner's affinity and priorities, reports, episodes and the status.

use std::{
    collections::HashSet,
    time::{Duration, Instant},
};

use driml_protocol::{
    Ack, AffinityUpdate, EpisodesRequest, Incoming, Leave, PriorityUpdate, ProcessName,
    ProcessesStatus, ReplayStatus, Report, Request, Shutdown, Silence, Warning, fail_point,
    last_warning,
};

use super::server::{Service, State};
use crate::persist::journal::Journal;

/// Period between checks for missing processes and for the end of the run.
const CHECK_PERIOD: Duration = Duration::from_secs(1);
/// How long a replay server waits for the other processes to leave when the run is over.
const LEAVE_WAIT_MAX: Duration = Duration::from_secs(30);
/// The same if its launcher has died: the other processes notice that too and deliver their data, an actor within 20 s.
const ORPHANED_WAIT_MAX: Duration = Duration::from_secs(25);
/// How long a process may be missing before it is logged.
const MISSING_MAX: Duration = Duration::from_secs(10);

impl Service {
    pub(super) fn leave(&self, incoming: Incoming<Leave>) {
        self.answer(incoming, |state, leave| {
            if let Some(why) = state.replay.leave(&leave) {
                state.warn_limited("leave", &format!("a `Leave` was rejected: {why}"));
            }
            // A rejected `Leave` is acknowledged too, as the actor exits anyway.
            state.replay.write_pending().then_some(Ack)
        });
    }

    pub(super) fn affinity(&self, incoming: Incoming<AffinityUpdate>) {
        self.update_from_learner(incoming, |state, update| {
            state.check_learner(update.learner)?;
            state.replay.set_affinity(&update)
        });
    }

    pub(super) fn priorities(&self, incoming: Incoming<PriorityUpdate>) {
        let rows_max = self.limits.batch_rows_max as usize;
        self.update_from_learner(incoming, |state, update| {
            state.check_learner(update.learner)?;
            // One priority per row of a batch.
            if update.rows() > rows_max {
                return Err(format!(
                    "priorities of {} rows; a batch of this run has {rows_max} (learner.batch_size)",
                    update.rows()
                ));
            }
            state.replay.set_priorities(&update)
        });
    }

    /// Takes a message of the learner and acknowledges it, or counts and logs why it is rejected.
    fn update_from_learner<R: Request<Reply = Ack>>(
        &self,
        incoming: Incoming<R>,
        take: impl FnOnce(&mut State, R) -> Result<(), String>,
    ) {
        self.answer(incoming, |state, update| {
            let taken = take(state, update);
            if let Err(why) = &taken {
                state.reject(R::NAME, why);
            }
            taken.ok().map(|()| Ack)
        });
    }

    pub(super) fn report(&self, incoming: Incoming<Report>) {
        self.answer(incoming, |state, report| {
            let finished = report.finished;
            // If not, the process was replaced or is about to join. It repeats a report of the end of the run until it gets an `Ack`.
            let has_joined = state.participants.store_report(report, Instant::now());
            if state.participants.is_run_over() {
                state.replay.end_run(finished.unwrap_or(0));
                self.changed.notify_all();
            }
            (has_joined || finished.is_none()).then_some(Ack)
        });
    }

    pub(super) fn processes(&self, incoming: Incoming<ProcessesStatus>) {
        let weights_version = self.weights().newest_version();
        let (state, now) = (self.state(), Instant::now());
        let (waiting, waiting_s) = state.participants.waiting(now);
        let held_since = |who| match who {
            ProcessName::Actor(actor) => state.chunks.arrival(actor),
            ProcessName::Learner => state.requests.iter().map(|it| it.arrived).min(),
        };
        // An actor that has left in order is not missing.
        let mut processes = state.participants.processes(now, held_since);
        processes.retain(|it| it.connected || !state.replay.state.actors.has_left_in_order(it.who));
        let status = ProcessesStatus {
            up_s: state.participants.up_s(now),
            waiting,
            waiting_s,
            requests_waiting: state.requests.len() as u32,
            chunks_waiting: state.chunks.queue.len() as u32,
            chunk_bytes_waiting: state.chunks.bytes() as u64,
            weights_version,
            weights_age_s: state.timings.weights_age_s(now),
            log: state.replay.journal.as_ref().map(Journal::status),
            last_warning: last_warning::get()
                .map(|(text, age)| Warning::new(&text, age.as_secs_f64())),
            processes,
        };
        drop(state);
        incoming.into_responder().reply(&status);
    }

    /// Logs which missing process the run waits for, after `MISSING_MAX` and then at doubling intervals, until the shutdown.
    pub(super) fn log_missing_processes(&self) {
        // The missing process, since when, and after how long it is logged next.
        let mut missing: Option<(&str, Instant, Duration)> = None;
        while !self.shutdown.wait_timeout(CHECK_PERIOD) {
            fail_point::reach("missing");
            let state = self.state();
            let all_stored = state.replay.limiter.all_stored();
            let now = state.participants.missing_process(all_stored);
            let now = now.filter(|_| !state.participants.is_run_over());
            drop(state);
            if now != missing.map(|(before, ..)| before) {
                missing = now.map(|now| (now, Instant::now(), MISSING_MAX));
            }
            if let Some((missing, since, due)) = &mut missing
                && since.elapsed() > *due
            {
                let since = since.elapsed().as_secs();
                // A log does not tell whether the learner has finished.
                let hint = match all_stored {
                    true => ". If the learner has finished this run, stop this process",
                    false => "",
                };
                tracing::info!("{missing}; waiting for {since} s so far{hint}. See `driml status`");
                *due *= 2;
            }
        }
    }

    /// Waits for a shutdown, or until the run is over or `drain` is raised and the other processes have left, for a limited time. With
    /// `keep_alive` the end of the run does not count. A time in which this process was stopped hardly counts.
    pub(super) fn wait_until_over(&self, drain: &Shutdown, keep_alive: bool) {
        let mut waits: Option<(bool, Silence)> = None;
        while !self.shutdown.wait_timeout(CHECK_PERIOD) {
            // Read once, as it may be raised at any moment.
            let is_draining = drain.is_set();
            let state = self.state();
            let is_run_over = state.participants.is_run_over();
            let connected = state.participants.connected_count();
            drop(state);
            if !is_draining && (keep_alive || !is_run_over) {
                waits = None;
                continue;
            }
            let (why, wait_max) = match is_draining {
                true => ("this process was told to stop", ORPHANED_WAIT_MAX),
                false => ("the run is over", LEAVE_WAIT_MAX),
            };
            let waited = match waits {
                Some((before, waited)) if before == is_draining => waited,
                _ => Silence::with_gap_max(2 * CHECK_PERIOD),
            };
            let (_, waited) = waits.insert((is_draining, waited));
            if connected == 0 || waited.record_failure() > wait_max {
                return tracing::info!("{why}; processes still connected: {connected}");
            }
        }
    }

    pub(super) fn episodes(&self, incoming: Incoming<EpisodesRequest>) {
        self.answer(incoming, |state, request| {
            Some(state.replay.answer_episodes(request))
        });
    }

    pub(super) fn status(&self, incoming: Incoming<ReplayStatus>) {
        let state = self.state();
        let mut status = state.replay.status();
        status.learner_finished = state.participants.is_run_over();
        // Actors that have delivered a chunk, including those that have exited.
        let mut acting: HashSet<u32> = state.replay.state.actors.acting().collect();
        acting.extend(state.chunks.queue.iter().map(|it| it.header().actor));
        status.actors_acting = acting.len() as u32;
        status.actors_waiting = state.chunks.queue.len() as u32;
        state.timings.fill_status(&mut status);
        drop(state);
        incoming.into_responder().reply(&status);
    }
}
