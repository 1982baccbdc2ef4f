//! Where each message travels: a small fixed set of key expressions.
//! Identities of actors and versions are in the messages, never in a key.

/// The key expressions of one run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    namespace: String,
}

impl Keys {
    /// Keys under `namespace`; runs that share a router need different ones.
    ///
    /// # Errors
    /// A namespace with other characters than letters, digits, `-`, `_` and `/`.
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

    fn key(&self, name: &str) -> String {
        format!("{}/{name}", self.namespace)
    }

    /// Queries: a joining part to the replay server.
    pub fn hello(&self) -> String {
        self.key("hello")
    }

    /// Queries: an actor that starts, to the replay server.
    pub fn actor_join(&self) -> String {
        self.key("join/actor")
    }

    /// Queries: a learner that starts, to the replay server.
    pub fn learner_join(&self) -> String {
        self.key("join/learner")
    }

    /// Queries: chunks, actor to replay server.
    pub fn ingest(&self) -> String {
        self.key("ingest")
    }

    /// Queries: what became of a chunk that has to wait, actor to replay server.
    pub fn claim(&self) -> String {
        self.key("claim")
    }

    /// Queries: an actor's goodbye to the replay server.
    pub fn goodbye(&self) -> String {
        self.key("goodbye")
    }

    /// Queries: batches, learner to replay server.
    pub fn batch(&self) -> String {
        self.key("batch")
    }

    /// Queries: the affinity matrix, learner to replay server.
    pub fn affinity(&self) -> String {
        self.key("affinity")
    }

    /// Queries: new weights, learner to replay server.
    pub fn weights_upload(&self) -> String {
        self.key("weights-upload")
    }

    /// Queries: pieces of the newest weights, actor to replay server.
    pub fn weights(&self) -> String {
        self.key("weights")
    }

    /// Puts: "newer weights exist", replay server to actors.
    pub fn weights_version(&self) -> String {
        self.key("weights-version")
    }

    /// Queries: the replay server's status.
    pub fn replay_status(&self) -> String {
        self.key("status/replay")
    }

    /// Queries: the learner's status.
    pub fn learner_status(&self) -> String {
        self.key("status/learner")
    }

    /// Liveliness token of one life of an actor.
    pub fn actor_alive(&self, actor: u32, epoch: u64) -> String {
        self.key(&format!("alive/actor/{actor}/{epoch:016x}"))
    }

    /// Liveliness token of one learner.
    pub fn learner_alive(&self, learner: u64) -> String {
        self.key(&format!("alive/learner/{learner:016x}"))
    }

    /// Liveliness tokens of all actors and learners.
    pub fn all_alive(&self) -> String {
        self.key("alive/**")
    }

    /// Whose liveliness token has this key; none if it is no part's of this run.
    pub fn alive(&self, key: &str) -> Option<Alive> {
        let rest = key.strip_prefix(&self.namespace)?.strip_prefix("/alive/")?;
        let hex = |text| u64::from_str_radix(text, 16).ok();
        match rest.split('/').collect::<Vec<_>>()[..] {
            ["actor", actor, epoch] => Some(Alive::Actor {
                actor: actor.parse().ok()?,
                epoch: hex(epoch)?,
            }),
            ["learner", learner] => Some(Alive::Learner(hex(learner)?)),
            _ => None,
        }
    }
}

/// A part whose liveliness token was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Alive {
    /// One life of an actor.
    Actor {
        /// Which actor.
        actor: u32,
        /// Which life of it.
        epoch: u64,
    },
    /// A learner.
    Learner(u64),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn liveliness_tokens_say_whose_they_are() {
        let keys = Keys::new("a/b").unwrap();
        let actor = Alive::Actor {
            actor: 7,
            epoch: u64::MAX,
        };
        assert_eq!(keys.alive(&keys.actor_alive(7, u64::MAX)), Some(actor));
        assert_eq!(keys.alive(&keys.learner_alive(9)), Some(Alive::Learner(9)));
        for strange in [
            "a/b/alive/actor/7",
            "a/alive/learner/9",
            "a/b/alive/x/9",
            "a/b/alive/learner/x",
            "",
        ] {
            assert_eq!(keys.alive(strange), None, "{strange}");
        }
    }
}
