//! Numbered transitions and counted batches while the replay server is killed: each number is stored once, and each planned batch is
//! served. Actors and learner are synthetic, because those of the program show no such counts.

use std::{collections::BTreeSet, time::Duration};

use driml_actor::DeliveryLimits;
use driml_protocol::{RunSpec, config::Settings};
use driml_replay_server::{Config, PersistArgs, Replay};
use driml_tests::{Process, TestSystem, check_nothing_lost};

use crate::{
    ROWS, WARMUP,
    synthetic::{SyntheticLearner, deliver_numbered},
    system, tiny_replay,
};

/// The number of actors, of chunks per actor, of streams per chunk, and of steps per stream.
const ACTORS: u32 = 3;
const CHUNKS: u64 = 40;
const STREAMS: u32 = 4;
const STEPS: u32 = 8;
const TRANSITIONS: u64 = CHUNKS * (ACTORS * STREAMS * STEPS) as u64;
/// The replay ratio: rows per transition.
const RATIO: u64 = 16;
/// How often each transition is drawn at the end, on average. The probability that a given one is never drawn is exp(-64).
const DRAWS_PER_TRANSITION: u64 = 64;
/// How often the server is killed.
pub(crate) const KILLS: u64 = 6;

/// Returns the numbers of all transitions in the replay of a server that has ended. Draws rows until each number was seen.
fn stored_numbers(system: &TestSystem, spec: &RunSpec, config_toml: &str) -> BTreeSet<u64> {
    let settings = Settings::parse(config_toml).unwrap();
    let mut config: Config = settings.table("replay").unwrap();
    config.replay_ratio = 1e6;
    let args = PersistArgs {
        dir: system.path("replay"),
        ..PersistArgs::default()
    };
    let (mut replay, recovery) = Replay::open(&args, spec, &config, ROWS).unwrap();
    let is_whole = recovery.found && recovery.warnings.is_empty();
    assert!(is_whole, "{recovery:?}");
    replay.check_valid();
    let batches = TRANSITIONS * DRAWS_PER_TRANSITION / u64::from(ROWS);
    tiny_replay::drawn_returns(&mut replay, batches, ROWS)
}

/// The number of rows sampled from all transitions.
pub(crate) const ROWS_SAMPLED: u64 = (TRANSITIONS - WARMUP) * RATIO;

/// Kills the server each time it has served the next number of rows in `kill_points`. Checks that the numbers in the replay equal those
/// sent, and that each planned batch was served.
pub(crate) fn kill_after_rows(kill_points: impl IntoIterator<Item = u64>) {
    let system = system();
    let flags = format!(
        "--agent c51 --env chain --preset smoke --frames {TRANSITIONS} --set replay.replay_ratio={RATIO} --replay-dir replay"
    );
    let mut server = Some(system.start_replay_server(&flags));
    let client = system.connect();
    for actor in 0..ACTORS {
        client.join_as_actor(actor, 1);
    }
    client.join_as_learner(7);
    let run = || system.run_client(&client.spec);
    let limits = DeliveryLimits {
        chunks_in_flight_max: 4,
        ack_timeout: Duration::from_secs(2),
        unreachable_max: Duration::from_secs(60),
    };
    let batches = std::thread::scope(|scope| {
        for actor in 0..ACTORS {
            let first = tiny_replay::header(&client.spec, actor, STREAMS, STEPS);
            let run = run();
            scope.spawn(move || deliver_numbered(run, first, CHUNKS, limits, false));
        }
        let mut learner = SyntheticLearner::start(&[run()], 7, ROWS, 1);
        let learning = scope.spawn(move || {
            let batches = std::iter::from_fn(|| learner.next()).count();
            learner.end();
            batches as u64
        });
        for rows in kill_points {
            client.wait_for_replay("some more rows", |replay| replay.rows_sampled > rows);
            server.take().into_iter().for_each(Process::kill);
            server = Some(system.start_replay_server(&flags));
        }
        learning.join().unwrap()
    });
    assert_eq!(batches, ROWS_SAMPLED / u64::from(ROWS));
    // A server that has just started may not be reached at once.
    let replay = client.wait_for_replay("the counts in the end", |_| true);
    check_nothing_lost(&replay);
    // As many transitions are stored as there are numbers: if each number is present, none is stored twice.
    assert_eq!(replay.transitions_inserted, TRANSITIONS);
    let (spec, config_toml) = (client.spec.clone(), client.config_toml.clone());
    drop(client);
    server.into_iter().for_each(Process::kill);
    let numbers = stored_numbers(&system, &spec, &config_toml);
    let missing = (0..TRANSITIONS).find(|it| !numbers.contains(it));
    assert_eq!((missing, numbers.len() as u64), (None, TRANSITIONS));
}

#[test]
fn a_killed_server_loses_and_doubles_no_transition_and_no_batch() {
    kill_after_rows((1..=KILLS).map(|round| round * ROWS_SAMPLED / (KILLS + 1)));
}
