//! Logs whose disk refuses for a while, and actors that are forgotten: what comes back is what was there.

use std::{
    fs::{self, File},
    path::Path,
    sync::Arc,
};

use driml_protocol::{
    ActorJoin, Horizon, Learned, LearnerJoin, Leave, RunSpec, ShardCounts, TimeoutRule,
};

use super::{PersistArgs, PersistError};
use crate::{Config, Replay, ledger::actors::ACTORS_MAX};

fn open(dir: &Path) -> Result<(Replay, Vec<String>), PersistError> {
    let spec = RunSpec {
        world: "counter".into(),
        agent: "c51".into(),
        seed: 1,
        frame_height: 1,
        frame_width: 1,
        frame_channels: 1,
        frame_stack: 1,
        num_actions: 2,
        n_step: 1,
        gamma: 0.99,
        horizon: Horizon::None {},
        timeout: TimeoutRule::Terminal,
    };
    let config: Config = toml::from_str(
        "capacity_transitions = 1000
         shards = 1
         replay_ratio = 8.0
         warmup_transitions = 10
         slack_transitions = 100",
    )
    .unwrap();
    let args = PersistArgs {
        dir: dir.to_owned(),
        shard: 0,
        segment_bytes: Some(1 << 20),
        mark: None,
    };
    let (replay, recovery) = Replay::open(&args, &spec, &config, 4)?;
    Ok((replay, recovery.warnings))
}

/// What an actor says at its end, before it has sent a chunk.
const fn leave(actor: u32) -> Leave {
    Leave {
        actor,
        incarnation: 1,
        produced: 0,
    }
}

const fn join(actor: u32, incarnation: u64) -> ActorJoin {
    ActorJoin { actor, incarnation }
}

/// The segment that is written refuses, as on a full disk; gives what to put back.
fn refuse(replay: &mut Replay) -> Arc<File> {
    let log = replay.log.as_mut().unwrap();
    let full = Arc::new(File::open("/dev/null").unwrap());
    std::mem::replace(&mut log.file, full)
}

#[test]
fn a_segment_that_begins_after_the_disk_refused_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (mut replay, _) = open(folder.path()).unwrap();
    replay.join_actor(join(0, 1)).unwrap();
    let learner = LearnerJoin {
        learner: 7,
        run: 0,
        updates: 0,
        counts: ShardCounts::default(),
        other_shards: ShardCounts::default(),
        restart: false,
    };
    replay.join_learner(learner).unwrap();
    let file = refuse(&mut replay);
    replay.leave(&leave(0));
    assert!(replay.is_refused_by_disk());
    replay.log.as_mut().unwrap().file = file;
    // The learner's checkpoint is the first that there is room for.
    let learned = Learned {
        updates: 1,
        saved_updates: 1,
        ..Learned::default()
    };
    replay.note_learned(learned).unwrap();
    replay.join_actor(join(1, 1)).unwrap();
    let stored = replay.stored_bytes().unwrap();
    drop(replay);
    let (replay, warnings) = open(folder.path()).unwrap();
    assert_eq!(warnings, [""; 0]);
    assert!(replay.stored_bytes().unwrap() == stored);
}

#[test]
fn an_actor_that_took_the_place_of_a_forgotten_one_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let (mut replay, _) = open(folder.path()).unwrap();
    for actor in 0..ACTORS_MAX as u32 {
        replay.join_actor(join(actor, 1)).unwrap();
    }
    replay.forget_absent(|actor, _| actor > 0);
    replay.join_actor(join(9_999, 1)).unwrap();
    let stored = replay.stored_bytes().unwrap();
    drop(replay);
    let (replay, warnings) = open(folder.path()).unwrap();
    assert_eq!(warnings, [""; 0]);
    assert!(replay.stored_bytes().unwrap() == stored);
}

#[test]
fn what_cannot_be_read_is_refused_until_it_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    let (mut replay, _) = open(folder.path()).unwrap();
    replay.join_actor(join(0, 1)).unwrap();
    drop(replay);
    let segment = folder.path().join("segment-000000000000.log");
    let mut bytes = fs::read(&segment).unwrap();
    bytes[40] ^= 1;
    fs::write(&segment, &bytes).unwrap();
    for _ in 0..2 {
        let refused = open(folder.path());
        assert!(matches!(refused, Err(PersistError::Unusable(..))));
        assert_eq!(fs::read(&segment).unwrap(), bytes);
    }
}
