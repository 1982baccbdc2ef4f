//! The role of a process, which is the common name of its certificate.
//! What each may do is in `access`.

/// Actors that certificates can name: 0 to this many, less one. The access rules of all of them are made when a replay server
/// starts, and take memory.
pub const ACTORS_MAX: u32 = 1024;

/// The role of a process, and the common name of its certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The actor of this number.
    Actor(u32),
    /// The learner.
    Learner,
    /// A replay server: the side that listens.
    ReplayServer,
    /// A process that only watches.
    Observer,
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

    /// Reads what [`Role`] is displayed as, and nothing else.
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
    /// How `deploy/certs.sh` is told to make the certificate of this role in DIR.
    pub(super) fn how_to_make(self) -> String {
        match self {
            Self::Actor(number) => format!("--actors {}", number.saturating_add(1)),
            Self::ReplayServer => "--host NAME_OR_ADDRESS".into(),
            Self::Learner | Self::Observer => String::new(),
        }
    }
}
