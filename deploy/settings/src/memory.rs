//! How large a replay fits into the memory that is free.
//! What actors and learner take beside it is in `driml_machine::resources`.

use driml_machine::{
    error::{Usage, usage},
    resources::{self, Machine},
    units::gib,
};
use driml_protocol::RunSpec;
use driml_replay_server::Compression;
use toml::Table;

use crate::{
    config::{RunConfig, parts_read},
    derived::{derive, put_number},
};

/// Makes the replay as small as the memory and says so, or refuses a size that was asked for and does not fit.
pub(crate) fn fit(
    table: &mut Table,
    capacity_set: bool,
    server_alone: bool,
    machine: &Machine,
) -> Result<Option<String>, Usage> {
    let mut derived = table.clone();
    derive(&mut derived)?;
    let RunConfig {
        run, replay, local, ..
    } = parts_read(&derived)?;
    let actors = resources::actors_bytes(local.actors, &run.world);
    let (beside, parts) = match server_alone {
        true => (0, u64::from(replay.shards)),
        false => (actors + resources::LEARNER_BYTES, 1),
    };
    if machine.memory_bytes <= beside {
        return Err(usage!(
            "{} actors of {} take about {}, and {} are free: use fewer --actors, with more --envs each",
            local.actors,
            run.world,
            gib(actors),
            gib(machine.memory_bytes)
        ));
    }
    let room = Room {
        free: gib(machine.memory_bytes),
        bytes: machine.replay_bytes(beside).saturating_mul(parts),
        bytes_max: machine.replay_bytes_max(beside).saturating_mul(parts),
    };
    if replay.compression != Compression::None {
        return fit_compressed(table, &run, &replay, &room);
    }
    let bytes_each = replay_bytes_each(&run) + sampling_bytes_each(&replay);
    let (free, bytes, bytes_max) = (&room.free, room.bytes, room.bytes_max);
    let asked = replay.capacity_transitions;
    let capacity = bytes / bytes_each;
    if capacity_set && asked > bytes_max / bytes_each {
        return Err(usage!(
            "replay.capacity_transitions = {asked} needs {}, and may take {}, as {free} are free: --set replay.capacity_transitions={capacity}",
            gib(asked.saturating_mul(bytes_each)),
            gib(bytes_max),
        ));
    }
    if capacity_set || asked <= capacity {
        return Ok(None);
    }
    put_number(table, "replay.capacity_transitions", capacity)?;
    // A replay that holds the whole run anyway is as good as a larger one.
    let frames = replay.transitions_max;
    let is_smaller_than_the_run = frames.is_none_or(|frames| frames > capacity);
    let note = format!(
        "the replay holds the newest {capacity} transitions instead of {asked}: {free} of memory are free, and it takes half, or what actors and learner leave"
    );
    Ok(is_smaller_than_the_run.then_some(note))
}

/// Bytes for the replay, all shards together.
struct Room {
    /// What is free on this machine, in words.
    free: String,
    /// For a replay that the machine sizes.
    bytes: u64,
    /// For one whose size was asked for.
    bytes_max: u64,
}

/// Bounds the bytes of a compressed replay, as it is not known beforehand how well its frames compress.
///
/// Half the free memory is taken, or what the settings allow; nothing is bounded where even frames that do not compress fit.
fn fit_compressed(
    table: &mut Table,
    run: &RunSpec,
    replay: &driml_replay_server::Config,
    room: &Room,
) -> Result<Option<String>, Usage> {
    let free = &room.free;
    let asked = replay.capacity_transitions;
    let fields_each = COMPRESSED_FIELDS_BYTES + sampling_bytes_each(replay);
    let fields = asked.saturating_mul(fields_each);
    let frames = asked.saturating_mul(run.frame_bytes() as u64);
    let bytes = room.bytes.saturating_sub(fields);
    if fields > room.bytes / 2 {
        return Err(usage!(
            "replay.capacity_transitions = {asked} needs {} beside the frames, and {free} are free: --set replay.capacity_transitions={}",
            gib(fields),
            room.bytes / 2 / fields_each
        ));
    }
    match replay.compressed_bytes_max {
        Some(max) if max.min(frames) > room.bytes_max => Err(usage!(
            "replay.compressed_bytes_max = {max} is {}, and {free} are free: --set replay.compressed_bytes_max={bytes}",
            gib(max)
        )),
        None if frames > bytes => {
            put_number(table, "replay.compressed_bytes_max", bytes)?;
            let frames = replay.transitions_max.unwrap_or(u64::MAX);
            let is_smaller_than_the_run = frames.saturating_mul(run.frame_bytes() as u64) > bytes;
            let note = format!(
                "compressed frames may take {}, as {free} of memory are free; if they compress badly, the replay holds fewer than {asked} transitions",
                gib(bytes)
            );
            Ok(is_smaller_than_the_run.then_some(note))
        }
        _ => Ok(None),
    }
}

/// Bytes that one transition takes in the replay: its frame and its small fields.
pub const fn replay_bytes_each(run: &RunSpec) -> u64 {
    run.frame_bytes() as u64 + 32
}

/// Bytes that the rule by which rows are drawn takes a transition: of a tree of sums, which is as wide as the next power of two, 32 at
/// most, and 16 at least.
const fn sampling_bytes_each(replay: &driml_replay_server::Config) -> u64 {
    match replay.sampling.is_prioritised() {
        true => 32,
        false => 0,
    }
}

/// Bytes that one transition takes at most in a compressed replay, beside its frame: its small fields, and its share of the
/// list of blocks if each holds one frame.
pub const COMPRESSED_FIELDS_BYTES: u64 = 128;
