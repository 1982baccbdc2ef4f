//! Sentences about a run: which side waits, which process does not respond, and what to do about it.
//! This module knows only what a view contains.

use std::time::Duration;

use driml_machine::units::duration;
use driml_protocol::{
    ProcessName, ProcessStatus, ProcessesStatus, RecoveryProgress, Silence, Waiting, session,
};

use crate::run_view::{RunView, ServerAnswer};

/// How long an actor may send nothing before it counts as unresponsive.
const UNRESPONSIVE_S: f64 = 30.0;
/// How long a replay server or the learner may leave requests unanswered before a note says so.
const SILENT_MAX: Duration = Duration::from_secs(10);
const NAMED_MAX: usize = 4;
/// Why a replay server may listen without an answer.
pub(super) const SILENT_SERVER: &str = "its process may be suspended, or its machine unreachable";

fn server_statuses(view: &RunView) -> impl Iterator<Item = (&ServerAnswer, &ProcessesStatus)> {
    let answered = view.servers.iter();
    answered.filter_map(|server| Some((server, server.processes.as_ref()?)))
}

/// The status of the learner and of all actors, each with the endpoint of the server that it is connected to.
fn processes(view: &RunView) -> impl Iterator<Item = (&str, &ProcessStatus)> {
    server_statuses(view)
        .flat_map(|(server, status)| status.processes.iter().map(|it| (&*server.endpoint, it)))
}

/// Which side waits at the rate limiter, and for how long.
pub(super) fn limiter_waits(view: &RunView) -> Vec<String> {
    let limiter = |(_, status): (_, &ProcessesStatus)| match status.waiting {
        Waiting::Neither => None,
        Waiting::Finished => Some(status.waiting.to_string()),
        waiting => Some(format!("{waiting} ({})", format_s(status.waiting_s))),
    };
    let mut waits: Vec<_> = server_statuses(view).filter_map(limiter).collect();
    waits.dedup();
    waits
}

/// What is missing and what to do about it, the most important first. A server that reads its replay back needs nothing.
pub(crate) fn actions_needed(view: &RunView) -> Vec<String> {
    let servers = view.servers.iter().filter(|_| !view.is_over());
    let mut needed: Vec<_> = servers.filter_map(server_action).collect();
    needed.extend(missing_shards(view).filter(|_| !view.is_over()));
    needed.extend(server_statuses(view).filter_map(disk_action));
    if !view.is_over() && server_statuses(view).next().is_some() {
        needed.extend(learner_action(view));
        if !view.replay.finished {
            needed.extend(actor_actions(view));
        }
    }
    needed
}

/// A message if the view is not that of the whole replay.
pub(crate) fn missing_shards(view: &RunView) -> Option<String> {
    let (given, shards) = (view.servers.len(), view.plan.shards as usize);
    (0 < given && given < shards).then(|| {
        format!("the run's replay has {shards} shards, and these are the numbers of {given}: give --connect once for each shard")
    })
}

fn server_action(server: &ServerAnswer) -> Option<String> {
    let endpoint = &server.endpoint;
    Some(if server.is_another_run {
        format!("{endpoint} now serves a run with other settings: connect again")
    } else if server.is_gone {
        format!("the replay server on {endpoint} has exited: restart it unless the run is complete")
    } else {
        let error = server.error.as_ref()?;
        format!("the replay server on {endpoint} does not answer ({error}): {SILENT_SERVER}")
    })
}

fn disk_action((server, status): (&ServerAnswer, &ProcessesStatus)) -> Option<String> {
    let log = status.log.as_ref()?;
    let (since, why) = log.refused.as_ref()?;
    Some(format!(
        "the replay server on {} has not been able to write its replay for {} ({why}): free disk space for {}, or make it writable; \
         the run then continues",
        server.endpoint,
        format_s(*since),
        log.folder
    ))
}

fn learner_action(view: &RunView) -> Option<String> {
    let connect = |it: &ServerAnswer| format!(" --connect {}", it.endpoint);
    let connects: String = view.servers.iter().map(connect).collect();
    let tls = tls_flag(&view.servers[0].endpoint);
    let command = format!("`driml learner{connects}{tls} --run-dir DIR`");
    match processes(view).find(|(_, process)| process.who == ProcessName::Learner) {
        None => Some(format!("no learner has joined: start {command}")),
        Some((_, learner)) if !learner.connected => Some(format!(
            "the learner disconnected {} ago: restart it with the same --run-dir, and it resumes from its newest checkpoint: {command}",
            format_s(learner.since_s)
        )),
        // The learner is asked through the first server.
        Some(_) if view.learner_status().is_none() && view.servers[0].replay.is_some() => Some(
            "the learner is connected but does not respond: its process may be suspended, or the machine overloaded".into(),
        ),
        Some(_) => None,
    }
}

fn actor_actions(view: &RunView) -> Vec<String> {
    let is_actor = |(_, process): &(_, &ProcessStatus)| process.who != ProcessName::Learner;
    let actors: Vec<_> = processes(view).filter(is_actor).collect();
    if !actors.iter().any(|(_, process)| process.connected) {
        let endpoint = &view.servers[0].endpoint;
        let what = match actors.is_empty() && view.replay.actors_acting == 0 {
            true => "no actor has joined",
            false => "all actors have disconnected",
        };
        let flags = tls_flag(endpoint);
        return vec![format!(
            "{what}: start `driml actor --connect {endpoint}{flags} --id N`, each with its own id"
        )];
    }
    let actor_action = |(endpoint, process): &(&str, &ProcessStatus)| {
        let ProcessName::Actor(id) = process.who else {
            return None;
        };
        if !process.connected {
            let (since, tls) = (format_s(process.since_s), tls_flag(endpoint));
            return Some(format!(
                "actor-{id} disconnected {since} ago; the run continues without it. Restart it with `driml actor --connect {endpoint}{tls} --id {id}`"
            ));
        }
        let silent = format_s(silent_s(process)?);
        Some(format!(
            "actor-{id} is connected but has sent nothing for {silent}: its process may be suspended"
        ))
    };
    actors.iter().filter_map(actor_action).collect()
}

fn tls_flag(endpoint: &str) -> &'static str {
    match session::is_quic(endpoint) {
        true => " --tls-dir DIR",
        false => "",
    }
}

/// The notes below the live lines: which processes do not respond, and for how long.
pub(super) fn notes(view: &RunView) -> Vec<String> {
    if view.is_all_learned() {
        return vec!["all frames and updates are done: the processes exit".into()];
    }
    let describe = |(it, how): (&ServerAnswer, _)| describe_recovery(&it.name, how);
    let recovering: Vec<_> = view.recovering().map(describe).collect();
    if !recovering.is_empty() {
        return recovering;
    }
    // No other process can be asked while the replay server does not answer.
    if let Some(replay) = silence_note("replay server", view.replay_silence) {
        return vec![replay];
    }
    let is_known = server_statuses(view).next().is_some();
    let has_joined =
        |learner| processes(view).any(|it| (it.1.who == ProcessName::Learner) == learner);
    let learner = match view.learner.finished {
        true => None,
        false if is_known && !has_joined(true) => Some("no learner has joined yet".to_owned()),
        false => silence_note("learner", view.learner_silence),
    };
    let no_actor = is_known && !has_joined(false) && view.replay.actors_acting == 0;
    let actor = no_actor.then(|| "no actor has joined yet".to_owned());
    let mut notes: Vec<_> = learner.into_iter().chain(actor).collect();
    notes.extend(unresponsive_actors(view));
    notes
}

pub(crate) fn describe_recovery(server: &str, progress: RecoveryProgress) -> String {
    format!("{server}: reads its replay back from disk, {progress}")
}

/// A note on a process that has not answered for `SILENT_MAX`; none before that.
fn silence_note(process: &str, silence: Silence) -> Option<String> {
    let silent = silence.length();
    (silent >= SILENT_MAX).then(|| format!("{process}: no answer for {}", duration(silent)))
}

/// For how many seconds a connected process has been silent; none up to `UNRESPONSIVE_S`, or while it is held at the rate limiter.
fn silent_s(process: &ProcessStatus) -> Option<f64> {
    let silent = process.last_seen_s.unwrap_or(process.since_s);
    let doing = process.doing.as_ref();
    let says = doing.map_or(f64::INFINITY, |(_, _, said)| *said);
    let is_silent = process.connected && silent > UNRESPONSIVE_S && says > UNRESPONSIVE_S;
    (is_silent && process.held_s.is_none()).then_some(silent)
}

/// Notes on the actors that are disconnected or unresponsive: the first ones by name, the others as a count.
fn unresponsive_actors(view: &RunView) -> Vec<String> {
    let words = |process: &ProcessStatus| {
        let (how, since_s) = match process.connected {
            _ if process.who == ProcessName::Learner => return None,
            true => ("no answer", silent_s(process)?),
            false if view.replay.finished => return None,
            false => ("disconnected", process.since_s),
        };
        Some(format!("{}: {how} for {}", process.who, format_s(since_s)))
    };
    let mut words: Vec<_> = processes(view).filter_map(|it| words(it.1)).collect();
    if let more @ 1.. = words.len().saturating_sub(NAMED_MAX) {
        words.truncate(NAMED_MAX);
        words.push(format!("and {more} more actors"));
    }
    words
}

pub(super) fn format_s(seconds: f64) -> String {
    duration(Duration::try_from_secs_f64(seconds).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use driml_protocol::ReplayStatus;
    use expect_test::expect;

    use super::*;
    use crate::{run_view::Plan, testing::make};

    /// A run whose only replay server does not answer any more; `waiting` is the state in its last answer.
    fn silent(is_gone: bool, waiting: Waiting) -> RunView {
        let mut view = RunView::new(Plan::default());
        view.set_replay(vec![make(|it: &mut ReplayStatus| it.waiting = waiting)]);
        view.servers = vec![make(|it: &mut ServerAnswer| {
            it.endpoint = "tcp/host:1".into();
            (it.error, it.is_gone) = (Some("no answer".into()), is_gone);
        })];
        view
    }

    #[test]
    fn a_server_that_ended_is_told_from_one_that_stands_still() {
        let said = [
            (false, Waiting::Neither),
            (true, Waiting::Neither),
            (true, Waiting::Finished),
        ]
        .map(|(is_gone, waiting)| actions_needed(&silent(is_gone, waiting)).join("; "));
        expect![[r#"
            the replay server on tcp/host:1 does not answer (no answer): its process may be suspended, or its machine unreachable
            the replay server on tcp/host:1 has exited: restart it unless the run is complete
        "#]]
        .assert_eq(&said.join("\n"));
        assert!(silent(true, Waiting::Finished).is_over());
    }
}
