//! The key of each message under the run's namespace, and the key of each connected process's liveliness token.
//! Keys of an actor's messages end in its number, so that access can be granted by key. Versions are in the messages.

use std::fmt;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::message::Keyed;

/// The key expressions of one run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    namespace: String,
}

impl Keys {
    /// Keys under `namespace`; runs that share a router need different ones.
    pub fn new(namespace: &str) -> Result<Self, String> {
        let good = |c: char| c.is_ascii_alphanumeric() || "-_/".contains(c);
        let chunks_filled = !namespace.split('/').any(str::is_empty);
        if chunks_filled && namespace.chars().all(good) {
            Ok(Self {
                namespace: namespace.into(),
            })
        } else {
            Err(format!(
                "namespace {namespace:?} cannot be used: take letters, digits, '-' and '_', in parts separated by single '/'"
            ))
        }
    }

    /// The prefix of all keys.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    fn prefixed(&self, name: &str) -> String {
        format!("{}/{name}", self.namespace)
    }

    /// The key at which messages of type `M` are answered, fetched or announced. If each actor has its own key, this one matches all.
    pub fn key<M: Keyed>(&self) -> String {
        self.key_for::<M>('*')
    }

    /// The key at which `actor` sends messages of type `M`.
    pub fn actor_key<M: Keyed>(&self, actor: u32) -> String {
        self.key_for::<M>(actor)
    }

    /// The key at which the learner sends messages of type `M`, whether or not each actor has its own.
    pub fn learner_key<M: Keyed>(&self) -> String {
        self.key_for::<M>("learner")
    }

    fn key_for<M: Keyed>(&self, who: impl fmt::Display) -> String {
        match M::KEY_PER_ACTOR {
            true => self.prefixed(&format!("{}/{who}", M::KEY)),
            false => self.prefixed(M::KEY),
        }
    }

    /// The actor's number at the end of `key`; `None` if `key` does not end in a number.
    pub(crate) fn parse_actor(key: &str) -> Option<u32> {
        key.rsplit('/').next()?.parse().ok()
    }

    /// The key of the liveliness token of one incarnation of an actor or a learner.
    pub fn liveliness_key(&self, Peer { process, hash }: Peer) -> String {
        self.liveliness_key_for(process, format_args!("{hash:016x}"))
    }

    pub(crate) fn liveliness_keys_of(&self, process: ProcessName) -> String {
        self.liveliness_key_for(process, '*')
    }

    fn liveliness_key_for(&self, process: ProcessName, hash: impl fmt::Display) -> String {
        self.prefixed(&match process {
            ProcessName::Actor(actor) => format!("alive/actor/{actor}/{hash}"),
            ProcessName::Learner => format!("alive/learner/{hash}"),
        })
    }

    /// The key that matches the liveliness tokens of all actors and learners.
    pub fn all_liveliness_keys(&self) -> String {
        self.prefixed("alive/**")
    }

    /// The process and incarnation whose liveliness token has this key; `None` if it is not a token of this run.
    pub fn peer(&self, key: &str) -> Option<Peer> {
        let rest = key.strip_prefix(&self.namespace)?.strip_prefix("/alive/")?;
        let (process, hash) = match rest.split('/').collect::<Vec<_>>()[..] {
            ["actor", actor, hash] => (ProcessName::Actor(actor.parse().ok()?), hash),
            ["learner", hash] => (ProcessName::Learner, hash),
            _ => return None,
        };
        let hash = u64::from_str_radix(hash, 16).ok()?;
        Some(Peer { process, hash })
    }
}

/// A process of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum ProcessName {
    /// The run's only learner.
    Learner,
    /// The actor with this number.
    Actor(u32),
}

impl fmt::Display for ProcessName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Learner => f.write_str("learner"),
            Self::Actor(actor) => write!(f, "actor-{actor}"),
        }
    }
}

/// An incarnation of a process, as its liveliness token shows it. Every client can see tokens, so a token hides the number by which the
/// replay server knows the incarnation: with this number, a client could send in its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Peer {
    /// The process, in any incarnation.
    pub process: ProcessName,
    /// The first 8 bytes of the SHA-256 of this incarnation's number.
    pub hash: u64,
}

impl Peer {
    /// The incarnation of `process` with this number.
    pub fn new(process: ProcessName, number: u64) -> Self {
        let digest = Sha256::digest(number.to_le_bytes());
        let hash = u64::from_le_bytes(digest[..8].try_into().expect("SHA-256 has 32 bytes"));
        Self { process, hash }
    }

    /// This incarnation of an actor.
    pub fn actor(actor: u32, incarnation: u64) -> Self {
        Self::new(ProcessName::Actor(actor), incarnation)
    }

    /// The learner with this number.
    pub fn learner(learner: u64) -> Self {
        Self::new(ProcessName::Learner, learner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `tls::access` tests which keys the messages of each role have.
    #[test]
    fn an_actor_s_number_stands_at_the_end_of_its_key() {
        assert_eq!(Keys::parse_actor("a/7/leave/7"), Some(7));
        for other in [
            "a/7/report/learner",
            "a/7/leave/*",
            "",
            "a/4294967296",
            "a/-1",
        ] {
            assert_eq!(Keys::parse_actor(other), None, "{other}");
        }
    }

    #[test]
    fn liveliness_tokens_say_whose_they_are() {
        let keys = Keys::new("a/b").unwrap();
        let actor = Peer::actor(7, u64::MAX);
        assert_eq!(keys.peer(&keys.liveliness_key(actor)), Some(actor));
        let learner = Peer::learner(9);
        assert_eq!(keys.peer(&keys.liveliness_key(learner)), Some(learner));
        let seen = keys.liveliness_key(learner);
        assert!(seen.starts_with("a/b/alive/learner/"), "{seen}");
        assert!(
            !seen.ends_with("0000000000000009"),
            "the number is not shown"
        );
        assert_ne!(Peer::actor(7, 1), Peer::actor(7, 2));
        for strange in [
            "a/b/alive/actor/7",
            "a/alive/learner/9",
            "a/b/alive/x/9",
            "a/b/alive/learner/x",
            "",
        ] {
            assert_eq!(keys.peer(strange), None, "{strange}");
        }
    }
}
