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

    /// Queries: chunks, actor to replay server.
    pub fn ingest(&self) -> String {
        self.key("ingest")
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

    /// Queries: weights, actor to learner.
    pub fn weights(&self) -> String {
        self.key("weights")
    }

    /// Puts: "newer weights exist", learner to actors.
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

    /// Liveliness token of one actor.
    pub fn actor_alive(&self, actor: u32) -> String {
        self.key(&format!("alive/actor/{actor}"))
    }

    /// Liveliness tokens of all actors.
    pub fn actors_alive(&self) -> String {
        self.key("alive/actor/*")
    }
}
