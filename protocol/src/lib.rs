//! Everything that crosses a process boundary: the run spec, the messages, their bytes, and where they travel.
//! It holds no algorithm and no state; `README.md` beside this crate is the table of what is sent where.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod affinity;
pub mod answering;
pub mod batch;
pub mod codec;
pub mod config;
pub mod control;
pub mod end_signs;
pub mod fault;
pub mod join;
pub mod keys;
pub mod metric;
pub mod planes;
pub mod run_spec;
pub mod seldom;
pub mod session;
pub mod shared_memory;
pub mod shutdown;
pub mod transition;
pub mod weights;
pub mod whole_file;

pub use affinity::AffinityUpdate;
pub use batch::{Batch, BatchHeader, BatchReply, BatchRequest, NO_ACTION, RequestId, Tally};
pub use codec::{CodecError, Kind};
pub use control::{ActorJoin, Goodbye, Hello, JoinReply, LearnerJoin};
pub use keys::{Alive, Keys};
pub use metric::{LearnerStatus, Quantiles, ReplayStatus, Returns, Waiting};
pub use planes::{Planes, PlanesPool};
pub use run_spec::{Horizon, RunSpec, TimeoutRule};
pub use shutdown::Shutdown;
pub use transition::{Chunk, ChunkHeader, Claim, End, InsertReply};
pub use weights::{WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion};

/// The version of every message in this crate; parts of different versions refuse each other.
pub const PROTOCOL_VERSION: u16 = 3;
