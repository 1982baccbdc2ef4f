//! Well-formed messages in any order and with any numbers, sent to the core of a replay server: none breaks its state.

use driml_protocol::{
    ActorJoin, AffinityUpdate, Chunk, ChunkHeader, ChunkPoll, End, Horizon, InsertReply,
    LearnerJoin, LearnerProgress, Leave, Origin, PriorityPart, PriorityUpdate, RequestId, RunSpec,
    Sampling, ShardCounts, TimeoutRule,
};
use driml_replay_server::{Config, Replay};

const PRIORITISED: Sampling = Sampling::Prioritised {
    alpha: 0.5,
    beta_start: 0.4,
    beta_end: 1.0,
    beta_updates: 1,
};

pub(crate) const ACTIONS: u32 = 3;
/// The most messages in one execution.
const MESSAGES_MAX: usize = 64;

/// Reads numbers from the remaining bytes.
struct NumberReader<'a>(&'a [u8]);

impl NumberReader<'_> {
    fn byte(&mut self) -> Option<u8> {
        let (&first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(first)
    }

    /// Returns a small number most of the time, else one at an edge or any number.
    fn count(&mut self) -> Option<u64> {
        Some(match self.byte()? {
            small @ 0..=199 => u64::from(small % 16),
            edge @ 200..=239 => {
                [1 << 31, 1 << 32, 1 << 48, 1 << 60, u64::MAX - 1, u64::MAX][usize::from(edge) % 6]
            }
            _ => {
                let (bytes, rest) = self.0.split_first_chunk()?;
                self.0 = rest;
                u64::from_le_bytes(*bytes)
            }
        })
    }

    fn actor(&mut self) -> Option<u32> {
        Some(match self.byte()? {
            255 => u32::MAX,
            byte => u32::from(byte % 3),
        })
    }
}

pub(crate) fn spec(frame_bytes: u32) -> RunSpec {
    RunSpec {
        agent: "driml-ada".into(),
        frame_channels: frame_bytes,
        frame_stack: 2,
        num_actions: ACTIONS,
        n_step: 2,
        horizon: Horizon::Nhg { k_max: 3 },
        timeout: TimeoutRule::Bootstrap,
        ..RunSpec::smallest()
    }
}

/// Sends the messages that the bytes encode, one after the other.
pub(crate) fn replay(bytes: &[u8]) {
    let mut numbers = NumberReader(bytes);
    let Some(byte) = numbers.byte() else {
        return;
    };
    let shards = 1 + u32::from(byte % 2);
    let sampling = match byte / 2 % 2 {
        0 => Sampling::Uniform {},
        _ => PRIORITISED,
    };
    let config = Config {
        shards,
        sampling,
        replay_ratio: 2.0,
        warmup_transitions: 8,
        slack_transitions: 16,
        transitions_max: (shards == 1).then_some(4096),
        ..Config::unlimited(64 * u64::from(shards))
    };
    let mut replay = Replay::new(&spec(2), &config, 4).unwrap();
    for _ in 0..MESSAGES_MAX {
        if send_message(&mut replay, &mut numbers).is_none() {
            break;
        }
    }
    replay.check_valid();
    let status = replay.status();
    let stored = status.transitions_inserted + status.transitions_refilled;
    assert!(status.transitions_held <= stored);
}

fn send_message(replay: &mut Replay, numbers: &mut NumberReader<'_>) -> Option<()> {
    match numbers.byte()? % 8 {
        0 => {
            let (actor, incarnation) = (numbers.actor()?, numbers.count()?);
            let _ = replay.join_actor(ActorJoin { actor, incarnation });
        }
        1 | 2 => {
            let stored = replay.inserted_total();
            let chunk = read_chunk(numbers)?;
            let reply = replay.insert(&chunk);
            if matches!(reply, InsertReply::Refused { .. }) {
                assert_eq!(replay.inserted_total(), stored);
            }
        }
        3 => {
            let leave = Leave::new(numbers.actor()?, numbers.count()?, numbers.count()?);
            replay.leave(&leave);
        }
        4 => {
            let poll = ChunkPoll {
                actor: numbers.actor()?,
                incarnation: numbers.count()?,
                sequence: numbers.count()?,
                leaving: numbers.byte()? % 2 == 0,
            };
            let _ = replay.answer_poll(&poll);
        }
        5 => {
            let id = RequestId {
                client_id: numbers.count()?,
                number: numbers.count()?,
                attempt: numbers.count()?,
            };
            // The service never serves more rows than the run's batches have.
            let rows = numbers.count()?.min(64) as u32;
            let drawn = replay.draw_for(id, rows, driml_protocol::Buffer::zeroed);
            if let Ok(batch) = drawn {
                assert_eq!(batch.unpack().rows(), rows as usize);
            }
        }
        6 => {
            let affinity = AffinityUpdate {
                learner: 1,
                version: numbers.count()?,
                matrix: (0..9)
                    .map(|_| numbers.byte().map(|byte| f32::from(byte) / 250.0))
                    .collect::<Option<_>>()?,
            };
            let _ = replay.set_affinity(&affinity);
        }
        _ => {
            let byte = numbers.byte()?;
            if byte % 2 == 0 {
                let _ = replay.join_learner(LearnerJoin {
                    learner: numbers.count()?,
                    run: numbers.byte()?.into(),
                    updates: numbers.count()?,
                    counts: ShardCounts::new(numbers.count()?, numbers.count()?),
                    other_shards: ShardCounts::new(numbers.count()?, numbers.count()?),
                    restart: byte % 8 == 0,
                });
                let _ = replay.set_progress(LearnerProgress {
                    updates: numbers.count()?,
                    saved_updates: numbers.count()?,
                    rows_received: numbers.count()?,
                });
            } else if byte % 4 == 1 {
                let origin = Origin {
                    shard: u32::from(byte / 4 % 2),
                    incarnation: u64::from(byte / 8 % 2),
                };
                let (transition, priority) = (numbers.count()?, numbers.byte()?);
                let update = PriorityUpdate {
                    learner: 1,
                    number: numbers.count()?,
                    parts: vec![PriorityPart {
                        origin,
                        transitions: vec![transition; 2],
                        priorities: vec![f32::from(priority), f32::MAX * f32::from(priority % 2)],
                    }],
                };
                let _ = replay.set_priorities(&update);
            } else {
                let counts = ShardCounts::new(numbers.count()?, numbers.count()?);
                let _ = replay.set_other_shards(counts);
            }
        }
    }
    Some(())
}

fn read_chunk(numbers: &mut NumberReader<'_>) -> Option<Chunk> {
    let header = ChunkHeader {
        actor: numbers.actor()?,
        incarnation: numbers.count()?,
        sequence: numbers.count()?,
        first_transition: numbers.count()?,
        weights_version: numbers.count()?,
        leaving: numbers.byte()? % 4 == 0,
        streams: u32::from(numbers.byte()? % 4),
        steps: u32::from(numbers.byte()? % 8),
        frame_bytes: 2,
    };
    let mut chunk = Chunk::zeroed(header);
    for row in 0..header.transitions() {
        let (action, end, reward) = (numbers.byte()?, numbers.byte()?, numbers.byte()?);
        let reward = if reward == 255 {
            f32::MAX
        } else {
            f32::from(reward)
        };
        chunk.set(row, action % 3, reward, End::from_byte(end % 4)?);
    }
    Some(chunk)
}
