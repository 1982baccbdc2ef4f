//! Who waits for whom, and what it would take to go on, in sentences.
//! It knows no more than a snapshot.

use driml_protocol::{PartName, PartStatus, PartsStatus, Waiting, session};

use super::{
    numbers::seconds,
    snapshot::{ServerAnswer, Snapshot},
};

/// How long a part may be silent, or the limiter closed, before it is worth a sentence.
const SILENT: f64 = 30.0;

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
    for server in snapshot.servers.iter().filter(|_| !snapshot.is_over()) {
        if server.is_another_run {
            needed.push(format!(
                "a run with other settings has taken the place of this one on {}: ask anew",
                server.endpoint
            ));
        } else if let Some(progress) = server.recovering {
            needed.push(format!(
                "the replay server on {} reads its replay back from disk ({progress}): wait, all goes on by itself",
                server.endpoint
            ));
        } else if server.is_gone {
            needed.push(format!(
                "the replay server on {} has ended: if the run is complete, this is its regular end; if not, start it again",
                server.endpoint
            ));
        } else if let Some(error) = &server.error {
            needed.push(format!(
                "the replay server on {} does not answer ({error}): is its process frozen, or its machine cut off?",
                server.endpoint
            ));
        }
    }
    for (server, account) in accounts(snapshot) {
        if let Some(log) = &account.log
            && let Some((since, why)) = &log.refused
        {
            needed.push(format!(
                "the disk of the replay server on {} has refused its replay for {} ({why}): make room for {}, or make it writable, and all \
                 goes on by itself",
                server.endpoint,
                seconds(*since),
                log.folder
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
        if !actor.connected {
            needed.push(format!(
                "actor-{id} is gone since {}; the others go on. To have it again: `driml actor --connect {endpoint}{} --id {id}`",
                seconds(actor.since_s),
                certificates(endpoint)
            ));
        } else if let Some(silent) = silent_for(actor) {
            needed.push(format!(
                "actor-{id} is connected and has been silent for {}: is its process frozen?",
                seconds(silent)
            ));
        }
    }
    needed
}

/// Whether nobody plays the learner yet, and whether nobody acts yet; both false where no replay server says so.
pub(crate) fn not_joined(snapshot: &Snapshot) -> (bool, bool) {
    let said = accounts(snapshot).next().is_some();
    let has = |learner| parts(snapshot).any(|(_, part)| (part.who == PartName::Learner) == learner);
    (said && !has(true), said && !has(false))
}

/// For how many seconds a connected part has said nothing, where that is worth a sentence.
fn silent_for(part: &PartStatus) -> Option<f64> {
    let silent = part.heard_s.unwrap_or(part.since_s);
    let doing = part.doing.as_ref();
    let says = doing.map_or(f64::INFINITY, |(_, _, said)| *said);
    (part.connected && silent > SILENT && says > SILENT && part.held_s.is_none()).then_some(silent)
}

/// Actors of which nothing is heard, a few words each; the first `max` of them.
pub(crate) fn silent_actors(snapshot: &Snapshot, max: usize) -> Vec<String> {
    let words = |part: &PartStatus| match silent_for(part) {
        _ if part.who == PartName::Learner => None,
        _ if !part.connected && snapshot.replay.finished => None,
        _ if !part.connected => Some(format!("{}: gone for {}", part.who, seconds(part.since_s))),
        Some(silent) => Some(format!("{}: no answer for {}", part.who, seconds(silent))),
        None => None,
    };
    let mut words: Vec<_> = parts(snapshot)
        .filter_map(|(_, part)| words(part))
        .collect();
    let more = words.len().saturating_sub(max);
    if more > 0 {
        words.truncate(max);
        words.push(format!("and {more} more actors"));
    }
    words
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;
    use crate::status::Numbers;
    use driml_protocol::ReplayStatus;

    /// A run whose only replay server does not answer any more; `waiting` is what it said last.
    fn silent(is_gone: bool, waiting: Waiting) -> Snapshot {
        let replay = ReplayStatus {
            waiting,
            ..ReplayStatus::default()
        };
        Snapshot {
            world: "chain".into(),
            agent: "c51".into(),
            seed: 1,
            run_spec: String::new(),
            well: false,
            numbers: Numbers::of(&replay, None, (0.0, 0.0)),
            frames_planned: 2_000,
            updates_planned: 100,
            replay_ratio_planned: 8.0,
            actors_planned: 1,
            servers: vec![ServerAnswer {
                endpoint: "tcp/host:1".into(),
                replay: None,
                parts: None,
                recovering: None,
                error: Some("no answer".into()),
                is_gone,
                is_another_run: false,
            }],
            replay,
            learner: None,
            waits: Vec::new(),
            to_go_on: Vec::new(),
        }
    }

    #[test]
    fn a_server_that_ended_is_told_from_one_that_stands_still() {
        let said = [
            (false, Waiting::Nobody),
            (true, Waiting::Nobody),
            (true, Waiting::Finished),
        ]
        .map(|(is_gone, waiting)| to_go_on(&silent(is_gone, waiting)).join("; "));
        expect![[r#"
            the replay server on tcp/host:1 does not answer (no answer): is its process frozen, or its machine cut off?
            the replay server on tcp/host:1 has ended: if the run is complete, this is its regular end; if not, start it again
        "#]]
        .assert_eq(&said.join("\n"));
        assert!(silent(true, Waiting::Finished).is_over());
    }
}
