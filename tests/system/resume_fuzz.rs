//! Random resumes: a run is stopped at any moment in any way and resumed with other settings. Its counts must equal those computed from
//! the actors' logs, the checkpoint and the settings.
//! Messages for runs that cannot be resumed are tested in `resume`.

use std::{fmt::Write as _, fs, time::Duration};

use driml_tests::{Outcome, RunFolder, TestSystem, check_nothing_lost, wait_until};
use nix::sys::signal::Signal;
use rand::{Rng, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use crate::system;

/// The frames, warm-up, batch size and replay ratio of the first life, which is the run until it is stopped.
const FRAMES: u64 = 2_400;
const WARMUP: u64 = 200;
const ROWS: u64 = 16;
const RATIO: u64 = 8;

/// How the first life ends.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Stop {
    End,
    Interrupt,
    /// The launcher is killed; its processes end by themselves.
    KillLauncher,
    KillAll,
    /// A process is killed, and the run fails. A replay server with its replay on disk is restarted instead.
    Kill(&'static str),
}

/// The settings of the second life, which is the resumed run.
#[derive(Clone, Copy, Debug)]
struct ResumeSettings {
    frames: u64,
    rows: u64,
    ratio: u64,
    actors: u32,
}

/// The counts of the run in a checkpoint.
#[derive(Clone, Copy, Debug)]
struct SavedCounts {
    updates: u64,
    frames: u64,
    rows: u64,
}

/// Reads the newest checkpoint; `None` before the first.
fn saved_counts(run: &RunFolder) -> Option<SavedCounts> {
    let (_, newest) = run.checkpoints().pop()?;
    let state: Value =
        serde_json::from_slice(&fs::read(newest.join("state.json")).unwrap()).unwrap();
    let shards = state["progress"]["shards"].as_array().unwrap().clone();
    let sum = |key: &str| shards.iter().map(|it| it[key].as_u64().unwrap()).sum();
    Some(SavedCounts {
        updates: state["updates"].as_u64().unwrap(),
        frames: sum("inserted"),
        rows: sum("rows_sampled"),
    })
}

/// Returns the transitions that actors have delivered in all lives so far, according to their logs.
fn delivered_transitions(run: &RunFolder) -> u64 {
    // A run in lockstep has no logs.
    let logs = fs::read_dir(run.path().join("logs")).into_iter().flatten();
    let logs = logs.map(|entry| entry.unwrap().path());
    let actors = logs.filter(|path| path.to_str().unwrap().contains("/actor"));
    let texts = actors.map(|path| fs::read_to_string(path).unwrap());
    let of_log = |log: String| {
        let lines = log.lines();
        let counts = lines.filter_map(|line| line.strip_suffix(" transitions delivered"));
        let last = counts.map(|line| line.rsplit(' ').next().unwrap().parse::<u64>().unwrap());
        last.sum::<u64>()
    };
    texts.map(of_log).sum()
}

/// Starts a run, stops it, resumes it, and checks the counts.
fn resume_once(seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let system = system();
    let store = *["", "--durable", "--lockstep"].choose(&mut rng).unwrap();
    let stops = [
        Stop::End,
        Stop::Interrupt,
        Stop::Interrupt,
        Stop::KillLauncher,
        Stop::KillAll,
        Stop::Kill("learner"),
        Stop::Kill("replay-server"),
    ];
    // A run in lockstep has one process.
    let is_lockstep = store == "--lockstep";
    let kinds = if is_lockstep { 5 } else { stops.len() };
    let stop = *stops[..kinds].choose(&mut rng).unwrap();
    let shards = if is_lockstep {
        1
    } else {
        rng.random_range(1..3)
    };
    let mut one_of = |all: &[u64]| *all.choose(&mut rng).unwrap();
    let mut change = ResumeSettings {
        frames: one_of(&[FRAMES, FRAMES, FRAMES / 2, FRAMES + 1_000]),
        rows: one_of(&[ROWS, ROWS, 8, 24]),
        ratio: one_of(&[RATIO, RATIO, 4]),
        actors: 2,
    };
    if !is_lockstep {
        change.actors = rng.random_range(2..4);
    }
    let about = format!("seed {seed}: {store} {shards} shards, {stop:?}, {change:?}");
    let first = format!(
        "local --agent c51 --env chain --preset smoke --frames {FRAMES} --set replay.replay_ratio={RATIO} \
         --set learner.batch_size={ROWS} --set learner.checkpoint_period_updates=50 --actors 2 --replay-shards {shards} {store} --run-dir run"
    );
    let run = system.run_folder("run");
    let delay = Duration::from_millis(rng.random_range(0..1_500));
    run_and_stop(&system, &run, &first, stop, delay);
    let Some(before) = saved_counts(&run) else {
        // Nothing was saved yet.
        system.rejects("local --resume run", "there is no checkpoint");
        return;
    };
    let delivered_before = delivered_transitions(&run);
    let is_graceful = matches!(stop, Stop::End | Stop::Interrupt);
    if is_graceful && !is_lockstep {
        assert_eq!(before.frames, delivered_before, "{about}: {before:?}");
    }

    let mut flags = format!("local --resume run --frames {}", change.frames);
    for (key, value, first) in [
        ("learner.batch_size", change.rows, ROWS),
        ("replay.replay_ratio", change.ratio, RATIO),
    ] {
        if value != first {
            write!(flags, " --set {key}={value}").unwrap();
        }
    }
    if change.actors != 2 {
        write!(flags, " --set local.actors={}", change.actors).unwrap();
    }
    let ended = system.run_ok(&flags);
    let has_other_pace = change.rows != ROWS || change.ratio != RATIO;
    // Without an update before the resume, the run begins again.
    let is_fresh = before.updates == 0;
    let planned = |frames: u64| match has_other_pace && !is_fresh {
        true => before.updates + frames.saturating_sub(before.frames) * change.ratio / change.rows,
        false => (frames - WARMUP) * change.ratio / change.rows,
    };
    if ended.stdout.contains("nothing is left to do") {
        let is_done = planned(change.frames) <= before.updates;
        assert!(is_done, "{about}: {before:?}\n{}", ended.stdout);
        return;
    }
    let after = run.summary();
    let details = format!("{about}\n{before:?}\n{after:#?}");
    assert_eq!(after.outcome, Outcome::Finished, "{details}");
    let replay = &after.replay;
    check_nothing_lost(replay);
    let frames_min = change.frames.max(before.frames);
    assert!(is_fresh || after.frames >= frames_min, "{details}");
    assert_eq!(after.updates, planned(after.frames), "{details}");
    let learned = (after.updates - before.updates) * change.rows;
    let rows = before.rows * u64::from(!is_fresh) + learned;
    assert_eq!(replay.rows_sampled, rows, "{details}");
    if !is_lockstep && !is_fresh {
        let delivered = delivered_transitions(&run) - delivered_before;
        let counted = after.frames + replay.transitions_refilled;
        match (is_graceful, store) {
            (true, _) | (false, "") => assert_eq!(counted, before.frames + delivered, "{details}"),
            // The replay's log also contains what came after the checkpoint.
            (false, _) => assert!(counted >= before.frames + delivered, "{details}"),
        }
        let is_refilled = replay.transitions_refilled > 0;
        assert!(store.is_empty() || !is_refilled, "{details}");
    }
    let [numbers, frames] = ["episode", "frames"].map(|name| run.episode_column::<u64>(name));
    let is_sorted = numbers.is_sorted_by(|a, b| a < b) && frames.is_sorted();
    let is_past = frames.iter().all(|it| it.unwrap() <= after.frames);
    assert!(is_sorted && is_past, "{details}");
    for count in ["frames", "updates"] {
        let column = run.numeric_column(count);
        assert!(column.is_sorted(), "{count}: {column:?}, {details}");
    }
}

fn run_and_stop(system: &TestSystem, run: &RunFolder, flags: &str, stop: Stop, delay: Duration) {
    if stop == Stop::End {
        system.run_ok(flags);
        return;
    }
    let process = system.start(flags);
    let settings = run.path().join("config.toml");
    wait_until("the run's settings", || settings.exists());
    std::thread::sleep(delay);
    match stop {
        Stop::End => {}
        Stop::Interrupt => process.signal(Signal::SIGINT),
        Stop::KillLauncher => process.signal(Signal::SIGKILL),
        Stop::KillAll => system.kill_all(),
        Stop::Kill(role) => {
            // The launcher may not have started the process yet, or the run may be over.
            let found = system.find_process_now(role);
            found.iter().for_each(|it| it.signal(Signal::SIGKILL));
        }
    }
    let ended = process.wait();
    let in_order = matches!(ended.code, Some(0 | 130));
    assert!(in_order || stop != Stop::Interrupt, "{ended:?}");
    system.wait_until_all_have_ended();
}

/// The last 32 of 1,280 frames are too few for another update, and the last update has a checkpoint already.
#[test]
fn the_last_checkpoint_counts_frames_that_came_after_its_last_update() {
    let system = system();
    for store in ["", "--durable", "--lockstep"] {
        let dir = format!("run{store}");
        let flags = "--agent c51 --env chain --preset smoke --frames 1280 --set replay.replay_ratio=0.25 \
             --set replay.slack_transitions=64 --set learner.checkpoint_period_updates=1";
        let call = format!("local {flags} {store} --run-dir {dir}");
        system.run_ok(&call);
        let last = saved_counts(&system.run_folder(&dir)).unwrap();
        assert_eq!((last.updates, last.frames), (16, 1_280), "{store}");
    }
}

#[test]
fn runs_stopped_anywhere_count_on_right() {
    (0..8).for_each(resume_once);
}

#[test]
#[ignore = "takes a quarter of an hour"]
fn two_hundred_runs_stopped_anywhere_count_on_right() {
    (1_000..1_200).for_each(resume_once);
}
