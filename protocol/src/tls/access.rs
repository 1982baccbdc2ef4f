//! The roles of processes, each a certificate's common name, and their rights as rules for zenoh's access control, which denies all else.
//! The rules see only a message's key and its sender's common name; the process that answers checks the content.

use serde_json::{Value, json};

use crate::{
    messages::{
        affinity::AffinityUpdate,
        batch_request::BatchRequest,
        chunk::{ChunkHeader, ChunkPoll},
        episodes::EpisodesRequest,
        join::{ActorJoin, LearnerJoin, Leave, RunInfo},
        priorities::PriorityUpdate,
        report::{ProcessesStatus, Report},
        status::{LearnerStatus, ReplayStatus},
        weights::{WeightsRequest, WeightsUpload, WeightsVersion},
    },
    wire::keys::{Keys, ProcessName},
};

/// Number of actors that certificates can name, from 0. A replay server makes the rules of all at its start, which takes memory.
pub const ACTORS_MAX: u32 = 1024;

/// The role of a process, and the common name of its certificate. `driml doctor` lists the roles in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// A replay server: the side that listens.
    ReplayServer,
    /// The one learner of a run.
    Learner,
    /// A process that only watches the run.
    Observer,
    /// The actor with this number.
    Actor(u32),
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Actor(number) => write!(f, "actor-{number}"),
            Self::Learner => f.write_str("learner"),
            Self::ReplayServer => f.write_str("replay-server"),
            Self::Observer => f.write_str("observer"),
        }
    }
}

impl std::str::FromStr for Role {
    type Err = String;

    /// Parses exactly the text that `Display` writes.
    fn from_str(name: &str) -> Result<Self, String> {
        let number = name.strip_prefix("actor-").and_then(|it| it.parse().ok());
        let others = [Self::Learner, Self::ReplayServer, Self::Observer];
        let mut all = others.into_iter().chain(number.map(Self::Actor));
        all.find(|role| role.to_string() == name).ok_or_else(|| {
            format!("{name:?} is not a role: use replay-server, learner, observer or actor-N")
        })
    }
}

impl Role {
    /// The arguments after DIR with which `deploy/certs.sh` makes the certificate of this role.
    pub(super) fn certs_args(self) -> String {
        match self {
            Self::Actor(number) => format!("--actors {}", number.saturating_add(1)),
            Self::ReplayServer => "--host NAME_OR_ADDRESS".into(),
            Self::Learner | Self::Observer => String::new(),
        }
    }
}

/// The keys at which a role may ask, answer, subscribe and declare liveliness. Everything else is denied.
#[derive(Default)]
struct Grant {
    query: Vec<String>,
    reply: Vec<String>,
    subscribe: Vec<String>,
    liveliness: Vec<String>,
}

/// Returns the rights of `role` in the run with these keys; none for a replay server, which does not connect.
fn grant(keys: &Keys, role: Role) -> Grant {
    match role {
        Role::Actor(actor) => Grant {
            query: vec![
                keys.key::<RunInfo>(),
                keys.actor_key::<ActorJoin>(actor),
                keys.actor_key::<ChunkHeader>(actor),
                keys.actor_key::<ChunkPoll>(actor),
                keys.actor_key::<Leave>(actor),
                keys.actor_key::<Report>(actor),
                keys.key::<WeightsRequest>(),
            ],
            subscribe: vec![keys.key::<WeightsVersion>()],
            liveliness: vec![keys.liveliness_keys_of(ProcessName::Actor(actor))],
            ..Grant::default()
        },
        Role::Learner => Grant {
            query: vec![
                keys.key::<RunInfo>(),
                keys.key::<LearnerJoin>(),
                keys.key::<BatchRequest>(),
                keys.key::<AffinityUpdate>(),
                keys.key::<PriorityUpdate>(),
                keys.key::<WeightsUpload>(),
                keys.key::<ReplayStatus>(),
                keys.learner_key::<Report>(),
            ],
            reply: vec![keys.key::<LearnerStatus>()],
            liveliness: vec![keys.liveliness_keys_of(ProcessName::Learner)],
            ..Grant::default()
        },
        Role::Observer => Grant {
            query: vec![
                keys.key::<RunInfo>(),
                keys.key::<ReplayStatus>(),
                keys.key::<ProcessesStatus>(),
                keys.key::<LearnerStatus>(),
                keys.key::<EpisodesRequest>(),
            ],
            ..Grant::default()
        },
        Role::ReplayServer => Grant::default(),
    }
}

/// A rule of zenoh's access control, which allows `messages` at `keys`. `flows` and `messages` are lists of words.
fn allow(id: &str, flows: &str, messages: &str, keys: &[String]) -> Value {
    let words = |text: &str| text.split(' ').map(Value::from).collect::<Vec<_>>();
    let (flows, messages) = (words(flows), words(messages));
    json!({ "id": id, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys })
}

/// The rules that give `role` its rights.
fn role_rules(role: Role, grant: &Grant) -> Vec<Value> {
    let rule = |(what, flow, messages, keys): (&str, &str, &str, &Vec<String>)| {
        let id = format!("{role}-{what}");
        (!keys.is_empty()).then(|| allow(&id, flow, messages, keys))
    };
    let all = [
        ("asks", "ingress", "query", &grant.query),
        ("is-answered", "egress", "reply", &grant.query),
        (
            "answers",
            "ingress",
            "declare_queryable reply",
            &grant.reply,
        ),
        ("is-asked", "egress", "query", &grant.reply),
        ("listens", "ingress", "declare_subscriber", &grant.subscribe),
        ("receives", "egress", "put", &grant.subscribe),
        ("lives", "ingress", "liveliness_token", &grant.liveliness),
    ];
    all.into_iter().filter_map(rule).collect()
}

/// Returns zenoh's whole `access_control`, JSON, for the replay server of the run with these keys.
pub(crate) fn access_rules(keys: &Keys) -> String {
    let actors = (0..ACTORS_MAX).map(Role::Actor);
    let roles = actors.chain([Role::Learner, Role::Observer]).map(|role| {
        let name = role.to_string();
        let subject =
            json!({ "id": name, "cert_common_names": [name], "link_protocols": ["quic"] });
        (subject, role_rules(role, &grant(keys, role)))
    });
    // Everything is allowed through a unix socket: the permissions of its folder guard it.
    let local = json!({ "id": "this-machine", "link_protocols": ["unixsock-stream"] });
    let all = "put delete declare_subscriber query reply declare_queryable liveliness_token liveliness_query \
               declare_liveliness_subscriber";
    let everything = allow("all", "ingress egress", all, &["**".into()]);
    let (mut rules, mut subjects, mut policies) = (Vec::new(), Vec::new(), Vec::new());
    for (subject, own) in roles.chain([(local, vec![everything])]) {
        let ids: Vec<_> = own.iter().map(|rule| &rule["id"]).collect();
        policies.push(json!({ "rules": ids, "subjects": [subject["id"]] }));
        rules.extend(own);
        subjects.push(subject);
    }
    let control = json!({
        "enabled": true, "default_permission": "deny",
        "rules": rules, "subjects": subjects, "policies": policies,
    });
    control.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_role_has_the_least_it_needs() {
        let keys = Keys::new("d").unwrap();
        for (role, expected) in [
            (
                Role::Actor(3),
                "d/run-info d/join/actor/3 d/ingest/3 d/poll/3 d/leave/3 d/report/3 d/weights d/weights-version d/alive/actor/3/*",
            ),
            (
                Role::Learner,
                "d/run-info d/join/learner d/batch d/affinity d/priorities d/weights-upload d/status/replay d/report/learner \
                 d/status/learner d/alive/learner/*",
            ),
            (
                Role::Observer,
                "d/run-info d/status/replay d/status/processes d/status/learner d/episodes",
            ),
            (Role::ReplayServer, ""),
        ] {
            let grant = grant(&keys, role);
            let lists = [grant.query, grant.reply, grant.subscribe, grant.liveliness];
            assert_eq!(lists.concat().join(" "), expected);
        }
    }

    #[test]
    fn zenoh_takes_the_rules() {
        let mut config = zenoh::Config::default();
        let rules = access_rules(&Keys::new("a/b").unwrap());
        config.insert_json5("access_control", &rules).unwrap();
    }
}
