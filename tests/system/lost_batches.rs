//! Batches that get lost between the replay server and the learner, which asks again: none counts twice.
//! The replay server is played by the test, around the real replay; the learner's side is the real one.

use std::{
    ops::Range,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use driml_learner::remote::batch_source::{BatchSource, Counters, Next, Requests, Served};
use driml_protocol::{
    BatchReply, BatchRequest, Buffer, Horizon, InsertReply, Keys, ReplayStatus, RunClient, RunSpec,
    Shutdown, codec, session,
};
use driml_replay_server::{Config, Replay};
use driml_tests::{connect, listen};
use zenoh::{
    Session, Wait,
    query::{Query, Queryable},
};

use crate::tiny_replay;

/// Rows of a batch.
const ROWS: u32 = 16;
/// Transitions of the run, sampled once each; whole chunks of 8 for one and for three shards.
const TRANSITIONS: u64 = 384;
/// Of each so many batches and parts of batches, one is lost.
const LOSES: u32 = 4;

fn spec() -> RunSpec {
    tiny_replay::spec("driml-randk", Horizon::Uniform { k_max: 2 })
}

fn config(shards: u32) -> Config {
    Config {
        shards,
        transitions_max: Some(TRANSITIONS),
        ..tiny_replay::config(1_000)
    }
}

/// A shard that holds its share of the run.
fn full(shard: u32, shards: u32) -> Replay {
    let mut replay = Replay::shard(&spec(), &config(shards), ROWS, shard).unwrap();
    tiny_replay::join(&mut replay, 0);
    fill(&mut replay, 0..TRANSITIONS / 8 / u64::from(shards));
    replay
}

/// Stores chunks of 8 transitions with these numbers.
fn fill(replay: &mut Replay, sequences: Range<u64>) {
    for sequence in sequences {
        let stored = replay.insert(&tiny_replay::chunk(&spec(), 0, sequence, 8));
        assert!(matches!(stored, InsertReply::Stored { .. }), "{stored:?}");
    }
}

/// Answers as a replay server does, but for some batches, which it draws and does not send.
fn answer(query: &Query, replay: &Mutex<Replay>, drawn: &AtomicU32) {
    let hash = spec().hash();
    let payload = query.payload().unwrap().to_bytes();
    let (request, _): (BatchRequest, _) = codec::decode(&payload, Some(hash)).unwrap();
    let mut replay = replay.lock().unwrap();
    if let Some(other_shards) = request.other_shards {
        replay.set_other_shards(other_shards).unwrap();
    }
    let message = match replay.draw_for(request.id, request.rows, Buffer::zeroed) {
        Ok(_) if drawn.fetch_add(1, Ordering::Relaxed).is_multiple_of(LOSES) => return,
        Ok(draft) => {
            let (header, payload) = draft.unpack().into_payload();
            codec::encode(hash, &BatchReply::Batch(header), &payload).unwrap()
        }
        Err(not_ready) => codec::encode(hash, &BatchReply::NotReady(not_ready), &[]).unwrap(),
    };
    session::answer(query, message.into());
}

fn declare(
    session: &Session,
    key: String,
    answer: impl Fn(&Query) + Send + Sync + 'static,
) -> Queryable<()> {
    let declared = session
        .declare_queryable(key)
        .callback(move |query| answer(&query));
    declared.wait().unwrap()
}

/// A session, and what it answers.
type Declared = (Session, [Queryable<()>; 2]);

/// Replay servers of these shards, of which some batches get lost, and a learner's end of them.
struct Shards {
    replays: Vec<Arc<Mutex<Replay>>>,
    drawn: Arc<AtomicU32>,
    source: BatchSource,
    _sessions: Vec<Declared>,
    _folder: tempfile::TempDir,
}

fn serve(shards: Vec<Replay>) -> Shards {
    let folder = tempfile::tempdir().unwrap();
    let keys = Keys::new("lossy").unwrap();
    let hash = spec().hash();
    let drawn = Arc::<AtomicU32>::default();
    let (mut replays, mut declared, mut clients) = (vec![], vec![], vec![]);
    for (shard, replay) in shards.into_iter().enumerate() {
        let endpoint = format!("unixsock-stream/{}/{shard}.sock", folder.path().display());
        let server = listen(&endpoint);
        let replay = Arc::new(Mutex::new(replay));
        let (asked, count) = (replay.clone(), drawn.clone());
        let batches = declare(&server, keys.of::<BatchRequest>(), move |query| {
            answer(query, &asked, &count)
        });
        let asked = replay.clone();
        let status = declare(&server, keys.of::<ReplayStatus>(), move |query| {
            let status = asked.lock().unwrap().status();
            let bytes = codec::encode(hash, &status, &[]).unwrap();
            session::answer(query, bytes.into());
        });
        clients.push(RunClient::new(connect(&endpoint), keys.clone(), hash));
        replays.push(replay);
        declared.push((server, [batches, status]));
    }
    let requests = Requests {
        learner: 1,
        rows: ROWS,
        in_flight: 2,
        shared_memory: false,
        unreachable_max: Duration::from_secs(60),
    };
    let stop = Shutdown::default();
    let counters = Counters::at_start(clients.len());
    let source = BatchSource::start(&clients, requests, &counters, &stop).unwrap();
    Shards {
        replays,
        drawn,
        source,
        _sessions: declared,
        _folder: folder,
    }
}

impl Shards {
    /// The next batch; none at the end of the run.
    fn next(&mut self) -> Option<Served> {
        match self.source.next(Duration::from_secs(60)).unwrap() {
            Next::Batch(served) => Some(*served),
            Next::Finished => None,
            Next::NotYet(waiting) => panic!("no batch in a minute: {waiting}"),
        }
    }
}

/// Fetches all batches of a run from `shards` shards, of which some get lost.
fn every_batch_comes_once(shards: u32) {
    let mut served = serve((0..shards).map(|shard| full(shard, shards)).collect());
    let mut batches = 0;
    while let Some(Served { batch, parts }) = served.next() {
        assert_eq!(batch.rows(), ROWS as usize);
        assert_eq!(parts.iter().map(|it| it.rows).sum::<u32>(), ROWS);
        batches += 1;
    }
    let Shards {
        replays,
        drawn,
        source,
        ..
    } = served;
    assert_eq!(batches * u64::from(ROWS), TRANSITIONS);
    let statuses: Vec<_> = replays
        .iter()
        .map(|replay| {
            let replay = replay.lock().unwrap();
            replay.check_valid();
            replay.status()
        })
        .collect();
    let sampled: u64 = statuses.iter().map(|status| status.rows_sampled).sum();
    let retried: u64 = statuses.iter().map(|status| status.batches_retried).sum();
    assert_eq!(sampled, TRANSITIONS);
    let lost = drawn.load(Ordering::Relaxed).div_ceil(LOSES);
    assert!(
        lost >= 5,
        "of so many batches as there are, some were to get lost: {lost}"
    );
    assert_eq!(retried, u64::from(lost));
    source.end();
}

#[test]
fn lost_batches_do_not_count() {
    every_batch_comes_once(1);
}

#[test]
fn lost_parts_of_batches_do_not_count() {
    every_batch_comes_once(3);
}

/// A shard that held nothing when batches began, as its actors started late, is drawn from once it holds something, although the others
/// never make the learner wait.
#[test]
fn a_shard_that_fills_late_is_asked() {
    let config = Config {
        transitions_max: None,
        ..config(2)
    };
    let mut shards: Vec<_> = (0..2)
        .map(|shard| Replay::shard(&spec(), &config, ROWS, shard).unwrap())
        .collect();
    shards
        .iter_mut()
        .for_each(|replay| tiny_replay::join(replay, 0));
    fill(&mut shards[0], 0..8);
    let mut served = serve(shards);
    for batches in 0..1_000 {
        let parts = served.next().unwrap().parts;
        if parts.iter().any(|part| part.shard == 1) {
            assert!(batches > 3, "it held nothing");
            served.source.end();
            return;
        }
        let replays: Vec<_> = served.replays.iter().map(|it| it.lock().unwrap()).collect();
        let [mut first, mut second] = <[_; 2]>::try_from(replays).ok().unwrap();
        fill(&mut first, 8 + 2 * batches..10 + 2 * batches);
        if batches == 3 {
            fill(&mut second, 0..8);
        }
    }
    panic!("a shard that holds something is never drawn from");
}
