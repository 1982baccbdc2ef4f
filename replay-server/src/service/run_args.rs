//! What a replay server is told at its start. It opens nothing.

use std::{path::PathBuf, sync::Arc};

use driml_protocol::{Shutdown, tls::Credentials};

/// What a replay server is told at its start.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// Endpoints to listen on.
    pub listen: Vec<String>,
    /// Routers to connect to, if any.
    pub connect: Vec<String>,
    /// With which certificate it takes part; none without TLS.
    pub credentials: Option<Arc<Credentials>>,
    /// Prefix of the run's keys.
    pub namespace: String,
    /// Which of the replay's shards this is, from 0.
    pub shard: u32,
    /// Bytes of a version of the weights, of which the replay server itself knows nothing; longer uploads are refused.
    pub weights_bytes_max: usize,
    /// The folder in which the replay is kept, if it is kept on disk; of several shards each has a folder of its own there.
    pub dir: Option<PathBuf>,
    /// Stay when the run is over, to be asked, until `ending` or `shutdown`.
    pub stay: bool,
    /// Raised when this process is to end, but not before its parts have delivered what they have and left: its launcher has died,
    /// which ends them too. It waits for them for at most 10 s. What is to end it at once raises this and `shutdown`.
    pub ending: Shutdown,
    /// The run's resolved settings, which it hands to whoever joins.
    pub config_toml: String,
}
