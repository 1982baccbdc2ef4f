//! Fits the size of the replay to the free memory.
//! `driml_machine::resources` has the memory that actors and learner take.

use driml_machine::{
    error::{Usage, usage},
    resources::{self, Machine},
    units::{count, gib},
};
use driml_protocol::RunSpec;
use driml_replay_server::Compression;

use crate::config::RunConfig;

/// Memory for the replay, all shards together.
struct ReplayMemory {
    free: String,
    /// Bytes for a replay whose size the machine decides.
    bytes: u64,
    /// Bytes for a replay whose size the user asked for.
    bytes_max: u64,
}

/// Shrinks the replay to the memory and adds a note, or rejects a size that the user asked for and that does not fit.
pub(crate) fn fit(
    config: &mut RunConfig,
    is_capacity_set: bool,
    server_alone: bool,
    machine: &Machine,
) -> Result<(), Usage> {
    let (world, actors) = (&config.run.world, config.local.actors);
    let actors_bytes = resources::actors_bytes(actors, world);
    let (other_bytes, parts) = match server_alone {
        true => (0, u64::from(config.replay.shards)),
        false => (actors_bytes + resources::LEARNER_BYTES, 1),
    };
    let free = gib(machine.memory_bytes);
    if machine.memory_bytes <= other_bytes {
        return Err(usage!(
            "{} of {world} and a learner take about {}, and {free} are free: use fewer --actors, with more --envs each; in a sweep fewer --jobs",
            count(actors, "actor"),
            gib(other_bytes)
        ));
    }
    let memory = ReplayMemory {
        free,
        bytes: machine.replay_bytes(other_bytes).saturating_mul(parts),
        bytes_max: machine.replay_bytes_max(other_bytes).saturating_mul(parts),
    };
    if config.replay.compression != Compression::None {
        return fit_compressed(config, &memory);
    }
    let (replay, free) = (&mut config.replay, &memory.free);
    let bytes_each = replay_bytes_each(&config.run) + sampling_bytes_each(replay);
    let requested = replay.capacity_transitions;
    let capacity = memory.bytes / bytes_each;
    if is_capacity_set && requested > memory.bytes_max / bytes_each {
        return Err(usage!(
            "replay.capacity_transitions = {requested} needs {}, and may take {}, as {free} are free: --set replay.capacity_transitions={capacity}",
            gib(requested.saturating_mul(bytes_each)),
            gib(memory.bytes_max),
        ));
    }
    if is_capacity_set || requested <= capacity {
        return Ok(());
    }
    replay.capacity_transitions = capacity;
    // A replay that holds the whole run needs no note: a larger one would not be better.
    let run_transitions = replay.transitions_max;
    if run_transitions.is_none_or(|frames| frames > capacity) {
        config.notes.push(format!(
            "the replay holds the newest {capacity} transitions instead of {requested}: {free} of memory are free, and it takes half, or what actors and learner leave"
        ));
    }
    Ok(())
}

/// Limits the bytes of a compressed replay, because it is not known beforehand how well its frames compress.
///
/// The limit is half the free memory, or the one in the settings. There is none if even incompressible frames fit.
fn fit_compressed(config: &mut RunConfig, memory: &ReplayMemory) -> Result<(), Usage> {
    let (replay, free) = (&mut config.replay, &memory.free);
    let requested = replay.capacity_transitions;
    let fields_each = COMPRESSED_FIELDS_BYTES + sampling_bytes_each(replay);
    let fields = requested.saturating_mul(fields_each);
    let frame_bytes = config.run.frame_bytes() as u64;
    let frames = requested.saturating_mul(frame_bytes);
    let bytes = memory.bytes.saturating_sub(fields);
    if fields > memory.bytes / 2 {
        return Err(usage!(
            "replay.capacity_transitions = {requested} needs {} beside the frames, and {free} are free: --set replay.capacity_transitions={}",
            gib(fields),
            memory.bytes / 2 / fields_each
        ));
    }
    match replay.compressed_bytes_max {
        Some(max) if max.min(frames) > memory.bytes_max => Err(usage!(
            "replay.compressed_bytes_max = {max} is {}, and {free} are free: --set replay.compressed_bytes_max={bytes}",
            gib(max)
        )),
        None if frames > bytes => {
            replay.compressed_bytes_max = Some(bytes);
            let run_transitions = replay.transitions_max.unwrap_or(u64::MAX);
            if run_transitions.saturating_mul(frame_bytes) > bytes {
                config.notes.push(format!(
                    "compressed frames may take {}, as {free} of memory are free; if they compress badly, the replay holds fewer than {requested} transitions",
                    gib(bytes)
                ));
            }
            Ok(())
        }
        _ => Ok(()),
    }
}

/// Bytes that one transition takes in the replay: its frame and its small fields.
pub const fn replay_bytes_each(run: &RunSpec) -> u64 {
    run.frame_bytes() as u64 + 32
}

/// Bytes per transition for the sampling rule: for priorities 16 to 32, as a sum tree is as wide as the next power of two.
const fn sampling_bytes_each(replay: &driml_replay_server::Config) -> u64 {
    match replay.sampling.is_prioritised() {
        true => 32,
        false => 0,
    }
}

/// Most bytes that one transition takes in a compressed replay, beside its frame: its small fields, and its share of the list of blocks if
/// each block holds one frame.
pub const COMPRESSED_FIELDS_BYTES: u64 = 128;
