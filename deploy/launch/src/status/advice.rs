//! Who waits for whom, and what it would take to go on, in sentences.
//! It knows no more than a snapshot.

use std::time::Duration;

use driml_machine::units::duration;
use driml_protocol::{PartName, PartStatus, PartsStatus, Waiting, session};

use super::snapshot::{ServerAnswer, Snapshot};

/// How long a part may be silent, or the limiter closed, before it is worth a sentence.
const SILENT: f64 = 30.0;

/// A time for a person.
pub(super) fn seconds(seconds: f64) -> String {
    duration(Duration::try_from_secs_f64(seconds).unwrap_or_default())
}

/// The endpoint and the account of each replay server that answered.
fn accounts(snapshot: &Snapshot) -> impl Iterator<Item = (&ServerAnswer, &PartsStatus)> {
    let answered = snapshot.servers.iter();
    answered.filter_map(|server| Some((server, server.parts.as_ref()?)))
}

/// The learner's account, and all actors', each with the server that they are connected to.
fn parts(snapshot: &Snapshot) -> impl Iterator<Item = (&str, &PartStatus)> {
    accounts(snapshot)
        .flat_map(|(server, account)| account.parts.iter().map(|part| (&*server.endpoint, part)))
}

/// Who waits for whom and since when.
pub(super) fn waits(snapshot: &Snapshot) -> Vec<String> {
    let limiter = |(_, account): (&ServerAnswer, &PartsStatus)| {
        let waiting = match account.waiting {
            Waiting::Nobody => return None,
            Waiting::Finished => return Some(account.waiting.to_string()),
            waiting @ (Waiting::WarmUp { .. }
            | Waiting::LearnerWaitsForActors
            | Waiting::ActorsWaitForLearner) => waiting,
        };
        Some(format!("{waiting} since {}", seconds(account.waiting_s)))
    };
    let mut said: Vec<_> = accounts(snapshot).filter_map(limiter).collect();
    said.dedup();
    said
}

/// What is missing, the most important first.
pub(super) fn to_go_on(snapshot: &Snapshot) -> Vec<String> {
    let mut needed = Vec::new();
    for server in &snapshot.servers {
        if let Some(error) = &server.error {
            needed.push(format!(
                "the replay server on {} does not answer ({error}): is its process frozen, or its machine cut off?",
                server.endpoint
            ));
        }
    }
    if snapshot.is_over() || accounts(snapshot).next().is_none() {
        return needed;
    }
    let endpoint = &snapshot.servers[0].endpoint;
    let certificates = |endpoint: &str| match session::is_quic(endpoint) {
        true => " --tls-dir DIR",
        false => "",
    };
    let connects = snapshot.servers.iter();
    let mut connects: String = connects
        .map(|it| format!(" --connect {}", it.endpoint))
        .collect();
    connects.push_str(certificates(endpoint));
    match parts(snapshot).find(|(_, part)| part.who == PartName::Learner) {
        None => needed.push(format!(
            "no learner has joined: start `driml learner{connects} --run-dir DIR`"
        )),
        Some((_, learner)) if !learner.connected => needed.push(format!(
            "the learner is gone since {}: start it again with the same --run-dir, and it goes on from its newest checkpoint: `driml \
             learner{connects} --run-dir DIR`",
            seconds(learner.since_s)
        )),
        Some(_) if snapshot.learner.is_none() => needed.push(
            "the learner is connected and does not answer: is its process frozen, or the machine overloaded?".into(),
        ),
        Some(_) => {}
    }
    if snapshot.replay.finished {
        return needed;
    }
    let actors = || parts(snapshot).filter(|(_, part)| part.who != PartName::Learner);
    if !actors().any(|(_, part)| part.connected) {
        let first = match actors().next() {
            None => "no actor has joined".to_owned(),
            Some(_) => "all actors are gone".to_owned(),
        };
        needed.push(format!(
            "{first}: start `driml actor --connect {endpoint}{} --id N`, each with a number of its own",
            certificates(endpoint)
        ));
        return needed;
    }
    for (endpoint, actor) in actors() {
        let PartName::Actor(id) = actor.who else {
            continue;
        };
        let silent = actor.heard_s.unwrap_or(actor.since_s);
        let says = actor
            .doing
            .as_ref()
            .map_or(f64::INFINITY, |(_, _, said)| *said);
        if !actor.connected {
            needed.push(format!(
                "actor-{id} is gone since {}; the others go on. To have it again: `driml actor --connect {endpoint}{} --id {id}`",
                seconds(actor.since_s),
                certificates(endpoint)
            ));
        } else if silent > SILENT && says > SILENT && actor.held_s.is_none() {
            needed.push(format!(
                "actor-{id} is connected and has been silent for {}: is its process frozen?",
                seconds(silent)
            ));
        }
    }
    needed
}
