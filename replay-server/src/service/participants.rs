//! The state of each process beyond its counts: whether it is connected, since when, when it was last seen, what it reports.
//! It decides nothing. The replay holds all counts and knows which processes have joined.

use std::{
    collections::{BTreeMap, HashSet},
    mem::discriminant,
    time::Instant,
};

use driml_protocol::{Peer, ProcessName, ProcessStatus, Report, WARNINGS_MAX, Waiting, Warning};

use crate::ledger::actors::ACTORS_MAX;

/// Maximum processes that count as connected at a time, far more than a run has. Further ones count as absent.
const CONNECTED_MAX: usize = 4 * ACTORS_MAX;

/// All processes that have joined, and the connections.
pub(super) struct Participants {
    started: Instant,
    waiting: (Waiting, Instant),
    /// All connected incarnations, including those that have not joined.
    connected: HashSet<Peer>,
    processes: BTreeMap<ProcessName, ProcessState>,
}

/// A participant, over all its incarnations.
struct ProcessState {
    alive: Peer,
    incarnations: u32,
    /// When the process last joined, connected or disconnected.
    changed_at: Instant,
    last_seen: Option<Instant>,
    weights_version: Option<u64>,
    report: Option<(Report, Instant)>,
}

impl Participants {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            started: now,
            waiting: (Waiting::Neither, now),
            connected: HashSet::new(),
            processes: BTreeMap::new(),
        }
    }

    pub(super) fn add_joined(&mut self, who: Peer, now: Instant) {
        let earlier = self.processes.get(&who.process);
        if earlier.is_some_and(|process| process.alive == who) {
            return;
        }
        let process = ProcessState {
            alive: who,
            incarnations: earlier.map_or(0, |process| process.incarnations) + 1,
            changed_at: now,
            last_seen: None,
            weights_version: None,
            report: None,
        };
        self.processes.insert(who.process, process);
    }

    /// Forgets actors that no longer take part.
    pub(super) fn forget(&mut self, actors: &[u32]) {
        for &actor in actors {
            self.processes.remove(&ProcessName::Actor(actor));
        }
    }

    /// Returns the state of this incarnation, if it has joined and was not replaced.
    fn current_mut(&mut self, who: Peer) -> Option<&mut ProcessState> {
        let process = self.processes.get_mut(&who.process)?;
        (process.alive == who).then_some(process)
    }

    fn by_role(&self, is_learner: bool) -> impl Iterator<Item = &ProcessState> {
        let processes = self.processes.values();
        processes.filter(move |it| (it.alive.process == ProcessName::Learner) == is_learner)
    }

    pub(super) fn actor_incarnations(&self) -> u32 {
        self.by_role(false).map(|it| it.incarnations).sum()
    }

    /// Whether this incarnation of a process is connected, even if it has not joined.
    pub(super) fn is_connected(&self, who: Peer) -> bool {
        self.connected.contains(&who)
    }

    pub(super) fn set_connected(&mut self, who: Peer, is_connected: bool, now: Instant) {
        let has_changed = match is_connected {
            true => self.connected.len() < CONNECTED_MAX && self.connected.insert(who),
            false => self.connected.remove(&who),
        };
        if let Some(process) = self.current_mut(who).filter(|_| has_changed) {
            process.changed_at = now;
        }
    }

    pub(super) fn actors_connected(&self) -> u32 {
        let connected = self.by_role(false).filter(|it| self.is_connected(it.alive));
        connected.count() as u32
    }

    pub(super) fn connected_count(&self) -> usize {
        let processes = self.processes.values();
        processes.filter(|it| self.is_connected(it.alive)).count()
    }

    /// Notes that a chunk came from an actor, in which weights of this version acted, or a request from the learner.
    pub(super) fn mark_seen(&mut self, who: Peer, weights_version: Option<u64>, now: Instant) {
        if let Some(process) = self.current_mut(who) {
            process.last_seen = Some(now);
            process.weights_version = weights_version.or(process.weights_version);
        }
    }

    /// Stores the report of a process; `false` if the process has not joined.
    pub(super) fn store_report(&mut self, mut report: Report, now: Instant) -> bool {
        let Some(process) = self.current_mut(report.who.peer()) else {
            return false;
        };
        // A late report from before the end of the run does not undo `finished`.
        let earlier = process.report.as_ref().and_then(|(it, _)| it.finished);
        report.finished = report.finished.or(earlier);
        process.report = Some((report, now));
        true
    }

    pub(super) fn set_waiting(&mut self, waiting: Waiting, now: Instant) {
        if discriminant(&self.waiting.0) != discriminant(&waiting) {
            self.waiting.1 = now;
        }
        self.waiting.0 = waiting;
    }

    /// Returns which side waits at the limiter, and for how many seconds.
    pub(super) fn waiting(&self, now: Instant) -> (Waiting, f64) {
        (self.waiting.0, elapsed_s(now, self.waiting.1))
    }

    pub(super) fn up_s(&self, now: Instant) -> f64 {
        elapsed_s(now, self.started)
    }

    /// Whether the learner has reported that it has learned from every batch and saved a checkpoint.
    pub(super) fn is_run_over(&self) -> bool {
        let mut reports = self.by_role(true).filter_map(|it| it.report.as_ref());
        reports.any(|(report, _)| report.finished.is_some())
    }

    /// Returns the missing process that the run needs, as a text for a person; `all_stored` tells whether all transitions are stored.
    pub(super) fn missing_process(&self, all_stored: bool) -> Option<&'static str> {
        let missing_in = |learner, gone, not_yet| {
            let mut processes = self.by_role(learner).peekable();
            let missing = processes.peek().map_or(not_yet, |_| gone);
            let is_connected = processes.any(|it| self.is_connected(it.alive));
            (!is_connected).then_some(missing)
        };
        let learner = missing_in(true, "the learner is gone", "no learner has joined yet");
        let actors = missing_in(false, "all actors are gone", "no actor has joined yet");
        learner.or(actors.filter(|_| !all_stored))
    }

    /// Returns the status of all processes. `held_since` gives the time since which a process's chunk or request waits. Only the newest
    /// `WARNINGS_MAX` warnings are included.
    pub(super) fn processes(
        &self,
        now: Instant,
        held_since: impl Fn(ProcessName) -> Option<Instant>,
    ) -> Vec<ProcessStatus> {
        let process = |(&who, process): (&ProcessName, &ProcessState)| {
            let report = process.report.as_ref();
            let report = report.map(|(report, at)| (report, elapsed_s(now, *at)));
            ProcessStatus {
                who,
                connected: self.is_connected(process.alive),
                since_s: elapsed_s(now, process.changed_at),
                lives: process.incarnations,
                last_seen_s: process.last_seen.map(|at| elapsed_s(now, at)),
                held_s: held_since(who).map(|at| elapsed_s(now, at)),
                weights_version: process.weights_version,
                doing: report.map(|(it, age_s)| (it.doing.clone(), it.since_s + age_s, age_s)),
                last_warning: report.and_then(|(report, age_s)| {
                    let warning = report.last_warning.as_ref()?;
                    Some(Warning::new(&warning.text, warning.age_s + age_s))
                }),
            }
        };
        let mut processes: Vec<_> = self.processes.iter().map(process).collect();
        let age = |process: &ProcessStatus| {
            let warning = process.last_warning.as_ref();
            warning.map_or(f64::INFINITY, |warning| warning.age_s)
        };
        let mut by_age: Vec<_> = processes.iter_mut().collect();
        by_age.sort_by(|one, other| age(one).total_cmp(&age(other)));
        let older = by_age.into_iter().skip(WARNINGS_MAX);
        older.for_each(|process| process.last_warning = None);
        processes
    }
}

fn elapsed_s(now: Instant, since: Instant) -> f64 {
    now.saturating_duration_since(since).as_secs_f64()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use driml_protocol::{ActorJoin, Participant};

    use super::*;

    fn actor(incarnation: u64) -> Peer {
        Peer::actor(3, incarnation)
    }

    #[test]
    fn an_account_is_of_the_newest_life() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let mut participants = Participants::new(start);
        participants.set_connected(actor(1), true, at(1));
        let processes = participants.processes(at(1), |_| None);
        assert_eq!(processes, [], "only who has joined takes part");
        participants.add_joined(actor(1), at(2));
        participants.add_joined(actor(1), at(5));
        participants.mark_seen(actor(1), Some(7), at(6));
        participants.mark_seen(actor(9), Some(8), at(7));
        let report = |incarnation| {
            let who = Participant::Actor(ActorJoin::new(3, incarnation));
            Report::new(who, "plays", 2.0, Some(Warning::new("late", 1.0)))
        };
        assert!(participants.store_report(report(1), at(8)));
        assert!(!participants.store_report(report(9), at(8)));
        participants.set_connected(actor(1), false, at(10));
        participants.set_connected(actor(1), false, at(11));
        let expected = ProcessStatus {
            who: ProcessName::Actor(3),
            connected: false,
            since_s: 2.0,
            lives: 1,
            last_seen_s: Some(6.0),
            held_s: Some(1.0),
            weights_version: Some(7),
            doing: Some(("plays".into(), 6.0, 4.0)),
            last_warning: Some(Warning::new("late", 5.0)),
        };
        assert_eq!(participants.processes(at(12), |_| Some(at(11))), [expected]);

        assert_eq!(participants.actors_connected(), 0);
        participants.set_connected(actor(2), true, at(20));
        participants.add_joined(actor(2), at(20));
        participants.add_joined(Peer::learner(1), at(20));
        assert_eq!(participants.actors_connected(), 1);
        assert_eq!(participants.actor_incarnations(), 2);
        let again = &participants.processes(at(21), |_| None)[1];
        assert!(again.lives == 2 && again.connected && again.last_seen_s.is_none());
        participants.forget(&[3, 4]);
        assert_eq!(participants.actor_incarnations(), 0);
    }

    #[test]
    fn what_is_missing_is_named() {
        let now = Instant::now();
        let mut participants = Participants::new(now);
        let mut check = |who, joins, connected, all_stored, missing| {
            participants.set_connected(who, connected, now);
            if joins {
                participants.add_joined(who, now);
            }
            assert_eq!(participants.missing_process(all_stored), missing);
        };
        let (learner, actor) = (Peer::learner(5), actor(1));
        let no_learner = Some("no learner has joined yet");
        check(learner, false, true, false, no_learner);
        check(actor, false, true, false, no_learner);
        check(learner, true, true, false, Some("no actor has joined yet"));
        check(learner, true, true, true, None);
        check(actor, true, true, false, None);
        check(actor, true, false, false, Some("all actors are gone"));
        check(learner, true, false, true, Some("the learner is gone"));
    }

    #[test]
    fn waiting_has_a_beginning() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let warm_up = |have| Waiting::WarmUp { have, need: 100 };
        let mut participants = Participants::new(start);
        let actors = Waiting::ActorsWaitForLearner;
        for (now, waiting, since) in [(1, warm_up(1), 1), (4, warm_up(50), 1), (6, actors, 6)] {
            participants.set_waiting(waiting, at(now));
            let seconds = (8 - since) as f64;
            assert_eq!(participants.waiting(at(8)), (waiting, seconds));
        }
    }

    #[test]
    fn of_very_many_processes_only_the_newest_warnings_are_passed_on() {
        let now = Instant::now();
        let mut participants = Participants::new(now);
        for actor in 0..200 {
            let who = Participant::Actor(ActorJoin::new(actor, 1));
            participants.add_joined(who.peer(), now);
            // Warnings of actors with higher numbers are newer, and many have the same age.
            let age = f64::from((200 - actor) / 50);
            let report = Report::new(who, "plays", 0.0, Some(Warning::new("w", age)));
            assert!(participants.store_report(report, now));
        }
        let processes = participants.processes(now, |_| None);
        let passed = processes
            .iter()
            .filter(|process| process.last_warning.is_some());
        assert_eq!(passed.count(), WARNINGS_MAX);
        assert!(processes[199].last_warning.is_some() && processes[0].last_warning.is_none());
    }
}
