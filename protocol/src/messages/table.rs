//! All messages: number, type, key, priority and reply of each. What each is made of is in its own file.
//! `wire` turns them into bytes; each process decides what it answers.

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

/// "Understood".
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack;

/// `NUMBER NAME: TYPE [checked], at KEY of its actor (PRIORITY) -> REPLY;`
///
/// `[checked]`: its method of this name is called for every one that is received. `of its actor`: each actor has its own key. The priority is
/// `Data` unless it is named. Replies have no key, they travel back; a message that is its own reply is
/// fetched, with a query that carries nothing.
macro_rules! messages {
    ($(
        #[doc = $doc:literal]
        $number:literal $name:ident: $message:ident $([$checked:ident])?
        $(, at $key:literal $(of its $actor:ident)? $(of an $who:ident or the learner)? $(($priority:ident))?)?
        $(-> $reply:ident)?;
    )+) => {
        /// The numbers of all messages, so that none is given twice.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u16)]
        pub enum Kind {
            $(#[doc = $doc] $name = $number,)+
        }

        $(
            impl Message for $message {
                const KIND: u16 = Kind::$name as u16;
                const NAME: &'static str = stringify!($name);

                $(fn validate(&self, payload: &[u8]) -> Result<(), CodecError> {
                    self.$checked(payload)
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
                // True where the row names an actor: a macro repeats only what uses a name.
                $(const BY_ACTOR: bool = !stringify!($actor).is_empty();)?
                $(const BY_ACTOR: bool = !stringify!($who).is_empty();)?
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
    1 Chunk: ChunkHeader [checked], at "ingest" of its actor -> InsertReply;
    /// The answer to a chunk.
    2 InsertReply: InsertReply;
    /// A request for a batch, learner to replay server.
    3 BatchRequest: BatchRequest, at "batch" -> BatchReply;
    /// A batch, or why there is none yet.
    4 BatchReply: BatchReply [checked];
    /// The action-affinity matrix, learner to replay server.
    5 Affinity: AffinityUpdate, at "affinity" (DataHigh) -> Ack;
    /// A piece of the newest weights, replay server to actors.
    6 Weights: WeightsReply [checked];
    /// "Newer weights exist", replay server to actors.
    7 WeightsVersion: WeightsVersion, at "weights-version" (InteractiveHigh);
    /// An actor's last word.
    8 Leave: Leave, at "leave" of its actor -> Ack;
    /// The replay server's account of itself.
    9 ReplayStatus: ReplayStatus, at "status/replay" (InteractiveHigh) -> ReplayStatus;
    /// The learner's account of itself.
    10 LearnerStatus: LearnerStatus, at "status/learner" (InteractiveHigh) -> LearnerStatus;
    /// What a joining process needs to know.
    11 RunInfo: RunInfo, at "run-info" -> RunInfo;
    /// "Understood"; carries nothing.
    12 Ack: Ack;
    /// An actor that starts.
    13 ActorJoin: ActorJoin, at "join/actor" of its actor -> JoinReply;
    /// A learner that starts.
    14 LearnerJoin: LearnerJoin, at "join/learner" -> JoinReply;
    /// The answer to a process that starts.
    15 JoinReply: JoinReply;
    /// What became of a chunk, actor to replay server.
    16 ChunkPoll: ChunkPoll, at "poll" of its actor -> InsertReply;
    /// New weights, learner to replay server.
    17 WeightsUpload: WeightsUpload [checked], at "weights-upload" (DataHigh) -> Ack;
    /// A request for a piece of the newest weights, actor to replay server.
    18 WeightsRequest: WeightsRequest, at "weights" (DataLow) -> WeightsReply;
    /// The state of an actor or the learner, to the replay server.
    19 Report: Report [checked], at "report" of an actor or the learner -> Ack;
    /// The replay server's account of who takes part.
    20 ProcessesStatus: ProcessesStatus, at "status/processes" (InteractiveHigh) -> ProcessesStatus;
    /// Priorities of the rows of a batch, learner to replay server.
    21 Priorities: PriorityUpdate [checked], at "priorities" (DataHigh) -> Ack;
    /// A request for the episodes that ended.
    22 EpisodesRequest: EpisodesRequest, at "episodes" (InteractiveHigh) -> EpisodesReply;
    /// Episodes that ended.
    23 EpisodesReply: EpisodesReply [checked];
    /// "Not yet: the replay is being read back from disk", replay server in answer to any query.
    24 Recovering: Recovering [checked];
}
