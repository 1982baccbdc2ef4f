//! The interface between the processes of a run: the run spec, the messages, their encoding, and the connections that carry them.
//! This crate has no algorithm and no state of a run; `deploy/docs/src/reference/protocol.md` has the table of messages.
//!
//! Start at [`RunClient`], which queries, fetches, publishes and subscribes, and at [`answer_queries`], which replies. A [`Message`] is a
//! header and perhaps a payload; [`codec`] encodes and decodes both, and rejects damaged, foreign and unexpected messages. All processes of
//! a run must agree on the [`RunSpec`], whose hash is in every message.
//!
//! ```
//! use driml_protocol::{Leave, codec};
//!
//! let run = 0x0c6c_6069_564f_3984; // RunSpec::hash
//! let leave = Leave::new(3, 7, 4096);
//! let bytes = codec::encode(run, &leave, &[])?;
//!
//! let (back, payload) = codec::decode::<Leave>(&bytes, Some(run))?;
//! assert_eq!(back, leave);
//! assert!(payload.is_empty());
//!
//! let another = codec::decode::<Leave>(&bytes, Some(run + 1)).unwrap_err();
//! assert!(another.to_string().starts_with("the message belongs to run spec 0c6c6069564f3984"));
//! # Ok::<(), driml_protocol::CodecError>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod client;
pub mod config;
pub mod join;
pub mod session;
pub mod tls;

mod messages;
mod process;
mod query_workers;
pub mod reach;
pub mod reporter;
mod run_spec;
mod sampling;
mod wire;

pub use client::{EncodedMessage, RunClient};
pub use messages::{
    affinity::AffinityUpdate,
    batch::{Batch, NO_ACTION, RowScalars},
    batch_frames::StackedFrames,
    batch_header::{BatchHeader, BatchReply, NotReady, POOL_BATCHES},
    batch_request::{BatchRequest, LearnerProgress, RequestId, ShardCounts},
    chunk::{Chunk, ChunkHeader, ChunkPoll, End, InsertReply, TRANSITION_BYTES, transitions_max},
    episodes::{EPISODES_MAX, EndedEpisode, EpisodesReply, EpisodesRequest, Totals},
    join::{ActorJoin, JoinReply, LearnerJoin, Leave, RunInfo, Welcome},
    priorities::{Origin, PriorityPart, PriorityUpdate},
    recovering::{Recovering, RecoveryProgress},
    report::{
        LogStatus, Participant, ProcessStatus, ProcessesStatus, Report, WARNINGS_MAX, Warning,
    },
    status::{LearnerStatus, Quantiles, RETURNS_MAX, ReplayStatus, Returns, Waiting},
    table::{Ack, Kind},
    weights::{
        PIECE_BYTES, Weights, WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload,
        WeightsVersion,
    },
};
pub use process::{
    activity::Activity,
    atomic_write, fail_point, last_warning, lock, lock_file,
    log_limiter::LogLimiter,
    shutdown::{GracefulShutdown, Shutdown, join_within},
    silence::Silence,
    spawn,
};
pub use query_workers::{Incoming, Responder, answer_queries};
pub use run_spec::{FRAME_STACK_MAX, Horizon, RunSpec, TimeoutRule};
pub use sampling::Sampling;
pub use session::PendingReply;
pub use wire::{
    buffers::{Buffer, BufferPool, is_readable},
    codec::{self, PROTOCOL_VERSION},
    error::CodecError,
    keys::{Keys, Peer, ProcessName},
    message::{Keyed, Message, Request},
    shared_memory,
};
