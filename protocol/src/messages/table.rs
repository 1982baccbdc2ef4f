//! The table of all messages: number, type, key, priority and reply of each. Other files of this folder define the types.
//! `wire` turns messages into bytes; each process decides what it replies.

use serde::{Deserialize, Serialize};
use zenoh::qos::Priority;

use super::{
    affinity::AffinityUpdate,
    batch_header::BatchReply,
    batch_request::BatchRequest,
    chunk::{ChunkHeader, ChunkPoll, InsertReply},
    episodes::{EpisodesReply, EpisodesRequest},
    join::{ActorJoin, JoinReply, LearnerJoin, Leave, RunInfo},
    priorities::PriorityUpdate,
    recovering::Recovering,
    report::{ProcessesStatus, Report},
    status::{LearnerStatus, ReplayStatus},
    weights::{WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion},
};
use crate::wire::{
    error::CodecError,
    message::{Keyed, Message, Request},
};

/// Acknowledges a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack;

/// `NUMBER NAME: TYPE [check_payload], at KEY of its actor (PRIORITY) -> REPLY;`
///
/// `[check_payload]` names the method that checks each received message. `of its actor`: each actor has its own key. The default priority is
/// `Data`. Replies have no key; a message that is its own reply is fetched by an empty query.
macro_rules! messages {
    ($(
        #[doc = $doc:literal]
        $number:literal $name:ident: $message:ident $([$check:ident])?
        $(, at $key:literal $(of its $actor:ident)? $(of an $who:ident or the learner)? $(($priority:ident))?)?
        $(-> $reply:ident)?;
    )+) => {
        /// The numbers of all messages; as variants of one enum they are unique.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u16)]
        pub enum Kind {
            $(#[doc = $doc] $name = $number,)+
        }

        impl Kind {
            /// All kinds, in the order of the table.
            pub const ALL: &'static [Self] = &[$(Self::$name),+];
        }

        $(
            impl Message for $message {
                const KIND: u16 = Kind::$name as u16;
                const NAME: &'static str = stringify!($name);

                $(fn validate(&self, payload: &[u8]) -> Result<(), CodecError> {
                    self.$check(payload)
                })?

                $(
                    $(fn actor(&self) -> Option<u32> {
                        Some(self.$actor)
                    })?
                    $(fn actor(&self) -> Option<u32> {
                        self.$who()
                    })?
                )?
            }

            $(impl Keyed for $message {
                const KEY: &'static str = $key;
                // Always true: a macro repetition must use the name that it repeats.
                $(const KEY_PER_ACTOR: bool = !stringify!($actor).is_empty();)?
                $(const KEY_PER_ACTOR: bool = !stringify!($who).is_empty();)?
                $(const PRIORITY: Priority = Priority::$priority;)?
            })?

            $(impl Request for $message {
                type Reply = $reply;
            })?
        )+
    };
}

messages! {
    /// Transitions, actor to replay server.
    1 Chunk: ChunkHeader [check_payload], at "ingest" of its actor -> InsertReply;
    /// The reply to a chunk or to a question about one.
    2 InsertReply: InsertReply;
    /// A request for a batch, learner to replay server.
    3 BatchRequest: BatchRequest, at "batch" -> BatchReply;
    /// A batch, or why there is none yet.
    4 BatchReply: BatchReply [check_payload];
    /// The action-affinity matrix, learner to replay server.
    5 Affinity: AffinityUpdate, at "affinity" (DataHigh) -> Ack;
    /// A piece of the newest weights, replay server to actors.
    6 Weights: WeightsReply [check_payload];
    /// "Newer weights exist", replay server to actors.
    7 WeightsVersion: WeightsVersion, at "weights-version" (InteractiveHigh);
    /// An actor leaves, with the count of its transitions.
    8 Leave: Leave, at "leave" of its actor -> Ack;
    /// Counters and means of the replay server.
    9 ReplayStatus: ReplayStatus, at "status/replay" (InteractiveHigh) -> ReplayStatus;
    /// Counters and means of the learner.
    10 LearnerStatus: LearnerStatus, at "status/learner" (InteractiveHigh) -> LearnerStatus;
    /// The run's settings and state, for a joining process.
    11 RunInfo: RunInfo, at "run-info" -> RunInfo;
    /// An acknowledgement without content.
    12 Ack: Ack;
    /// An actor joins the run.
    13 ActorJoin: ActorJoin, at "join/actor" of its actor -> JoinReply;
    /// A learner joins the run.
    14 LearnerJoin: LearnerJoin, at "join/learner" -> JoinReply;
    /// The reply to an actor or a learner that joins.
    15 JoinReply: JoinReply;
    /// A question about a chunk that may have been stored by now, actor to replay server.
    16 ChunkPoll: ChunkPoll, at "poll" of its actor -> InsertReply;
    /// New weights, learner to replay server.
    17 WeightsUpload: WeightsUpload [check_payload], at "weights-upload" (DataHigh) -> Ack;
    /// A request for a piece of the newest weights, actor to replay server.
    18 WeightsRequest: WeightsRequest, at "weights" (DataLow) -> WeightsReply;
    /// The state of an actor or the learner, to the replay server.
    19 Report: Report [check_payload], at "report" of an actor or the learner -> Ack;
    /// The state of all processes of the run, as the replay server knows it.
    20 ProcessesStatus: ProcessesStatus, at "status/processes" (InteractiveHigh) -> ProcessesStatus;
    /// Priorities of the rows of a batch, learner to replay server.
    21 Priorities: PriorityUpdate [check_payload], at "priorities" (DataHigh) -> Ack;
    /// A request for the episodes that have ended.
    22 EpisodesRequest: EpisodesRequest, at "episodes" (InteractiveHigh) -> EpisodesReply;
    /// Episodes that have ended.
    23 EpisodesReply: EpisodesReply [check_payload];
    /// "Not yet: the replay is being read back from disk", replay server in answer to any query.
    24 Recovering: Recovering [check_payload];
}
