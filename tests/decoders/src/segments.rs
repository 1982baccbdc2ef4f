//! The replay's segments on disk, in any state: the server starts or reports why not, serves only what was stored, and starts again.
//! The replay server's own tests check every field of a row. Here the bytes decide what was stored.

use std::{collections::HashSet, fs, ops::Range, path::Path};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Buffer, Chunk, ChunkHeader, End, InsertReply, LearnerJoin, Leave,
    RequestId, RunSpec, codec,
};
use driml_replay_server::{Config, PersistArgs, Replay};

use crate::replay::{self, ACTIONS};

/// The size of a frame in bytes. A frame is its number, which is never 0.
const FRAME_BYTES: usize = 4;
const ROWS: u32 = 4;
/// The number of batches drawn from a recovered replay.
const BATCHES: u64 = 8;
/// The most segments in one execution.
const SEGMENTS_MAX: usize = 8;
/// The capacity of the replay, in transitions.
const CAPACITY: u64 = 64;
/// The size from which a segment is followed by another, in bytes.
const SEGMENT_BYTES: u64 = 700;

/// The positions of the fields in a record's head, and the length of the head.
const KIND: Range<usize> = 4..8;
const BODY_BYTES: Range<usize> = 16..24;
const CHECKED_BYTES: Range<usize> = 24..28;
const RECORD_SUM: Range<usize> = 28..32;
const HEAD_BYTES: usize = 32;
/// The kind of a record that holds a chunk.
const CHUNK: u32 = 3;
/// The positions in a message's prefix of the length of the header, the length of the payload, and the checksum.
const HEADER_BYTES: Range<usize> = 16..20;
const PAYLOAD_BYTES: Range<usize> = 20..28;
const MESSAGE_SUM: Range<usize> = 28..32;

/// A frame, and the action that followed.
type Step = ([u8; FRAME_BYTES], u8);

fn spec() -> RunSpec {
    replay::spec(FRAME_BYTES as u32)
}

fn open_replay(dir: &Path) -> Result<Replay, String> {
    let args = PersistArgs {
        dir: dir.to_owned(),
        segment_bytes: Some(SEGMENT_BYTES),
        ..PersistArgs::default()
    };
    let config = Config {
        // 0 starts no thread that flushes.
        fsync_ms: Some(0),
        ..Config::unlimited(CAPACITY)
    };
    Replay::open(&args, &spec(), &config, ROWS)
        .map(|(replay, _)| replay)
        .map_err(|e| e.to_string())
}

/// Creates a folder, in memory if possible, because these tests do not check that a real disk keeps its data.
fn temp_folder() -> tempfile::TempDir {
    let memory = tempfile::tempdir_in("/dev/shm");
    memory.or_else(|_| tempfile::tempdir()).unwrap()
}

/// Writes segments into a new folder, numbered from `first`.
fn write_segments(first: u8, segments: &[Vec<u8>]) -> tempfile::TempDir {
    let dir = temp_folder();
    for (number, segment) in (usize::from(first)..).zip(segments) {
        let name = format!("segment-{number:012}.log");
        fs::write(dir.path().join(name), segment).unwrap();
    }
    dir
}

/// Opens a replay from the segments in `bytes`, as they are and with repaired checksums. The first byte is the number of the first segment.
/// Then comes each segment, after its length in two bytes.
pub(crate) fn segments(bytes: &[u8]) {
    let Some((&first, rest)) = bytes.split_first() else {
        return;
    };
    let mut segments = split_segments(rest);
    check_log(first, &segments);
    segments.iter_mut().for_each(|it| repair_segment(it));
    check_log(first, &segments);
}

fn check_log(first: u8, segments: &[Vec<u8>]) {
    let dir = write_segments(first, segments);
    let mut stored = HashSet::new();
    segments.iter().for_each(|it| add_stored(it, &mut stored));
    let Ok(mut replay) = open_replay(dir.path()) else {
        return;
    };
    replay.check_valid();
    let status = replay.status();
    assert!(status.transitions_held <= status.transitions_inserted.min(CAPACITY));
    check_draws(&mut replay, &stored);
    let before = replay.stored_bytes().unwrap();
    drop(replay);
    let mut replay = open_replay(dir.path()).unwrap();
    assert_eq!(replay.stored_bytes().unwrap(), before);
    // The reopened replay still works.
    let actor = 1000;
    if replay.join_actor(ActorJoin::new(actor, 1)).is_ok() {
        let mut chunk = Chunk::zeroed(header(actor, 0, 0));
        fill_chunk(&mut chunk, &mut 1);
        let reply = replay.insert(&chunk);
        if matches!(reply, InsertReply::Stored { .. }) {
            add_chunk(&chunk, &mut stored);
        }
        check_draws(&mut replay, &stored);
    }
    replay.check_valid();
}

fn check_draws(replay: &mut Replay, stored: &HashSet<Step>) {
    for client in 0..BATCHES {
        let id = RequestId::first(1_000 + client);
        let Ok(batch) = replay.draw_for(id, ROWS, Buffer::zeroed) else {
            return;
        };
        let batch = batch.unpack();
        let states = batch.states_t();
        let states = states.chunks_exact(2 * FRAME_BYTES);
        for (state, &action) in states.zip(batch.actions()) {
            let newest = *state.last_chunk().unwrap();
            assert!(
                stored.contains(&(newest, action)),
                "a row with {newest:?} and action {action}: no chunk whose checksum is right has it"
            );
        }
    }
}

fn split_segments(mut bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut all = Vec::new();
    while let Some((length, rest)) = bytes.split_first_chunk()
        && all.len() < SEGMENTS_MAX
    {
        let length = usize::from(u16::from_le_bytes(*length)).min(rest.len());
        let (segment, after) = rest.split_at(length);
        all.push(segment.to_vec());
        bytes = after;
    }
    all
}

/// Adds the transitions of all chunks in `bytes` whose own checksum is right.
fn add_stored(bytes: &[u8], stored: &mut HashSet<Step>) {
    for at in 0..bytes.len() {
        let rest = &bytes[at..];
        if rest.starts_with(b"DRML")
            && let Some(length) = message_bytes(rest)
            && let Ok(chunk) = Chunk::decode(&rest[..length], spec().hash())
        {
            add_chunk(&chunk, stored);
        }
    }
}

fn add_chunk(chunk: &Chunk, stored: &mut HashSet<Step>) {
    // The frames may not fit if the chunk is of another world.
    let frames = chunk.frames().chunks_exact(FRAME_BYTES);
    for (frame, &action) in frames.zip(chunk.actions()) {
        stored.insert((*frame.first_chunk().unwrap(), action));
    }
}

/// Returns the length of the message that begins here, if it is complete.
fn message_bytes(bytes: &[u8]) -> Option<usize> {
    let prefix = bytes.get(..codec::PREFIX_BYTES)?;
    let header = read_number(&prefix[HEADER_BYTES]);
    let length = header
        .checked_add(read_number(&prefix[PAYLOAD_BYTES]))?
        .checked_add(codec::PREFIX_BYTES)?;
    (length <= bytes.len()).then_some(length)
}

/// Reads a little-endian number of up to 8 bytes.
fn read_number(bytes: &[u8]) -> usize {
    let number = |sum: u64, &byte: &u8| sum << 8 | u64::from(byte);
    usize::try_from(bytes.iter().rev().fold(0, number)).unwrap_or(usize::MAX)
}

/// Repairs the lengths and checksums of all records and of the chunks in them, so that the code behind these checks is reached.
fn repair_segment(segment: &mut [u8]) {
    let mut at = 0;
    while segment.len() - at >= HEAD_BYTES {
        let (head, rest) = segment[at..].split_at_mut(HEAD_BYTES);
        head[..4].copy_from_slice(b"DRL1");
        let length = read_number(&head[BODY_BYTES]).min(rest.len());
        let body = &mut rest[..length];
        let is_chunk = read_number(&head[KIND]) == CHUNK as usize;
        let mut checked = length;
        if is_chunk {
            checked = read_number(&head[CHECKED_BYTES]).min(length);
            repair_message(body);
        }
        head[BODY_BYTES].copy_from_slice(&(length as u64).to_le_bytes());
        head[CHECKED_BYTES].copy_from_slice(&(checked as u32).to_le_bytes());
        let sum = crc32fast::hash(&[&head[..RECORD_SUM.start], &body[..checked]].concat());
        head[RECORD_SUM].copy_from_slice(&sum.to_le_bytes());
        at += HEAD_BYTES + length;
    }
}

/// Repairs the lengths and the checksum of a message.
pub(crate) fn repair_message(body: &mut [u8]) {
    if body.len() < codec::PREFIX_BYTES {
        return;
    }
    let after = body.len() - codec::PREFIX_BYTES;
    let header = read_number(&body[HEADER_BYTES]).min(after);
    body[HEADER_BYTES].copy_from_slice(&(header as u32).to_le_bytes());
    body[PAYLOAD_BYTES].copy_from_slice(&((after - header) as u64).to_le_bytes());
    let sum = crc32fast::hash(&[&body[..MESSAGE_SUM.start], &body[MESSAGE_SUM.end..]].concat());
    body[MESSAGE_SUM].copy_from_slice(&sum.to_le_bytes());
}

fn header(actor: u32, sequence: u64, first_transition: u64) -> ChunkHeader {
    ChunkHeader {
        actor,
        incarnation: 1,
        sequence,
        first_transition,
        weights_version: 1,
        leaving: false,
        streams: 2,
        steps: 4,
        frame_bytes: FRAME_BYTES as u32,
    }
}

/// Fills a chunk with frames numbered from `frame`.
fn fill_chunk(chunk: &mut Chunk, frame: &mut u32) {
    for row in 0..chunk.header.transitions() {
        chunk.frame_mut(row).copy_from_slice(&frame.to_le_bytes());
        let end = match *frame % 13 {
            0 => End::Terminal,
            5 => End::TimedOut,
            9 => End::LevelChange,
            _ => End::Running,
        };
        chunk.set(row, (*frame % ACTIONS) as u8, 0.5, end);
        *frame += 1;
    }
}

/// Returns input of the decoder `segments`: a log of a single segment and one of several.
pub fn logs() -> [(&'static str, Vec<u8>); 2] {
    [("short", 2), ("long", 12)].map(|(name, chunks)| (name, write_log(chunks)))
}

/// Returns the segments of a replay in which every kind of record was written, after the number of the first.
fn write_log(chunks: u64) -> Vec<u8> {
    let dir = temp_folder();
    let mut replay = open_replay(dir.path()).unwrap();
    for actor in 0..2 {
        replay.join_actor(ActorJoin::new(actor, 1)).unwrap();
    }
    let join = LearnerJoin {
        learner: 7,
        run: 7,
        ..LearnerJoin::default()
    };
    replay.join_learner(join).unwrap();
    let mut affinity = AffinityUpdate {
        learner: 7,
        version: 1,
        matrix: vec![0.5; (ACTIONS * ACTIONS) as usize],
    };
    let (mut frame, mut id) = (1, RequestId::first(5));
    for sequence in 0..chunks {
        let mut chunk = Chunk::zeroed(header(0, sequence, 8 * sequence));
        fill_chunk(&mut chunk, &mut frame);
        let reply = replay.insert(&chunk);
        assert!(matches!(reply, InsertReply::Stored { .. }), "{reply:?}");
        let _ = replay.draw_for(id, ROWS, Buffer::zeroed);
        id = id.next();
        if sequence % 4 == 1 {
            replay.set_affinity(&affinity).unwrap();
            affinity.version += 1;
        }
    }
    assert_eq!(replay.leave(&Leave::new(1, 1, 0)), None);
    drop(replay);
    let mut files: Vec<_> = fs::read_dir(dir.path())
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|it| it == "log"))
        .collect();
    files.sort();
    let first = files[0].to_str().unwrap().strip_suffix(".log").unwrap();
    let mut bytes = vec![first[first.len() - 3..].parse().unwrap()];
    for file in files {
        let segment = fs::read(file).unwrap();
        bytes.extend_from_slice(&u16::try_from(segment.len()).unwrap().to_le_bytes());
        bytes.extend_from_slice(&segment);
    }
    bytes
}

/// Returns the first of [`logs`] with a number in its first record that no replay reaches.
pub fn log_with_highest_ordinal() -> Vec<u8> {
    let [(_, mut log), _] = logs();
    let segment = &mut log[3..];
    segment[8..16].copy_from_slice(&(1u64 << 60).to_le_bytes());
    repair_segment(segment);
    log
}

/// Returns the number of transitions held in a log from [`logs`], or why the log is rejected.
pub fn transitions_held(log: &[u8]) -> Result<u64, String> {
    let dir = write_segments(log[0], &split_segments(&log[1..]));
    open_replay(dir.path()).map(|replay| replay.status().transitions_held)
}
