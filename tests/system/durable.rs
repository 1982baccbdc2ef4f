//! A replay that is kept on disk, and processes that are killed and restarted: every transition is stored once, every planned update made,
//! nothing reported twice. Reading of logs, intact or damaged, is tested beside the code; these tests use real processes and disks.

use std::{collections::BTreeSet, fs};

use driml_tests::{Exit, Outcome, RunningProcess, TestSystem, check_has, print_line, wait_until};
use nix::sys::signal::Signal;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    PRIORITISED, chain,
    numbered::{KILLS, ROWS_SAMPLED, kill_after_rows},
    prioritised::{ROWS_WERE_SET, logged_counts},
    start_run_with, system,
};

/// Sends a signal to a process of a launched run, then waits for its successor or the end of the run.
fn signal_and_wait(system: &TestSystem, role: &str, signal: Signal) {
    let old = system.find_process(role);
    let count_of_role = |all: &[RunningProcess]| {
        let all = all.iter().filter(|it| it.args.first() == old.args.first());
        all.count()
    };
    let before = count_of_role(&system.running_processes());
    old.signal(signal);
    wait_until("another one, or the end", || {
        let left = system.running_processes();
        left.is_empty() || !left.contains(&old) && count_of_role(&left) == before
    });
}

/// A process to end in a launched run: the number of updates to wait for, the role, and the signal.
type Fault = (u64, &'static str, Signal);

const fn kill_server_at(updates: u64) -> Fault {
    (updates, "replay-server", Signal::SIGKILL)
}

/// Makes a run of `frames` frames with two actors and ends the processes in `ends`, which the launcher restarts. Checks that every
/// transition is stored once and every planned update is made. The learner is paused at `pause_at` updates until all have ended.
fn ends_as_planned(frames: u64, flags: &str, pause_at: u64, ends: &[Fault]) -> (TestSystem, Exit) {
    let system = system();
    system.pause_learners_at(pause_at);
    let flags = format!("{flags} {} --actors 2", chain(frames));
    let process = system.start(&system.local_args(&flags));
    let run = system.run_folder("run");
    for (updates, role, signal) in ends {
        run.wait_for_updates(*updates);
        if *role == "actor" {
            // Wait until the actors that started before have joined.
            let client = system.connect();
            client.wait_for_replay("both actors", |replay| replay.actors == 2);
        }
        signal_and_wait(&system, role, *signal);
    }
    system.release_learners();
    let ended = process.wait_ok();
    assert_eq!(system.running_processes(), []);
    let summary = run.check_finished();
    let servers = ends.iter().filter(|it| it.1 == "replay-server").count() as u32;
    let restarted = (summary.replay_servers_restarted, summary.actors_restarted);
    let planned = (servers, ends.len() as u32 - servers);
    assert_eq!(restarted, planned, "{summary:#?}");
    (system, ended)
}

/// Kills a server of numbered transitions, and the servers of two shards in a launched run, at points drawn from the seed.
#[test]
#[ignore = "an hour: cargo nextest run --workspace --run-ignored only -E 'test(fifty_seeds)'"]
fn fifty_seeds_of_random_kills_lose_and_double_nothing() {
    for seed in 0..50 {
        print_line(&format!("seed {seed}"));
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut kill_points =
            |max| -> BTreeSet<u64> { (0..KILLS).map(|_| rng.random_range(0..max)).collect() };
        kill_after_rows(kill_points(ROWS_SAMPLED));
        kill_shards_after_updates(kill_points(SHARDS_PAUSE_AT - 100));
    }
}

/// The run draws rows by priority. After a restart, transitions since the newest snapshot have the highest priority, and losses of rows
/// that were drawn before the restart are not applied to other rows.
#[test]
fn a_launched_run_starts_its_dead_replay_server_again() {
    let flags = format!("--durable --agent driml-ada {PRIORITISED}");
    let kills = [500, 1_500, 2_500].map(kill_server_at);
    let (system, ended) = ends_as_planned(8_000, &flags, 3_500, &kills);
    ended
        .expect_stderr("replay-server was killed by signal 9 SIGKILL")
        .expect_stderr("restarting replay-server with its replay (restart 3 of at most 8)")
        .expect_stdout("of disk, in the run folder");
    let run = system.run_folder("run");
    let replay = run.summary().replay;
    // Each checkpoint begins with a snapshot of the counts, so that three kills lose few.
    let known: u64 = replay.k_histogram.iter().sum();
    assert!(4 * known > 3 * replay.rows_sampled, "{replay:#?}");
    let log = run.log("replay-server");
    check_has(&log, &["priorities are those of the newest snapshot"]);
    assert!(logged_counts::<3>(&log, ROWS_WERE_SET)[0] > 0, "{log}");
}

/// The transitions that a dead actor had not delivered are lost and appear in no count. Everything else is as planned.
#[test]
fn a_dead_actor_is_started_again() {
    // Paused at 600 updates, the run has room for 1,400 transitions and the slack; then the limiter is closed.
    let ends = [
        (150, "actor", Signal::SIGKILL),
        (400, "actor", Signal::SIGTERM),
    ];
    let (system, ended) = ends_as_planned(2_560, "--agent c51", 600, &ends);
    ended
        .expect_stderr("was killed by signal 9 SIGKILL (log: ")
        .expect_stderr("(restart 1 of at most 16)")
        .expect_stderr("(restart 2 of at most 16)");
    system.run_ok("local --resume run --frames 3000");
    let summary = system.run_folder("run").summary();
    assert_eq!(summary.actors_restarted, 2, "of the whole run");
}

/// The number of updates at which the learner of two shards is paused until all kills are done.
const SHARDS_PAUSE_AT: u64 = 2_000;

#[test]
fn shards_come_back_each_by_itself() {
    kill_shards_after_updates([500, 1_500]);
}

fn kill_shards_after_updates(kill_points: impl IntoIterator<Item = u64>) {
    let kills: Vec<_> = kill_points.into_iter().map(kill_server_at).collect();
    let flags = "--durable --agent c51 --replay-shards 2";
    let (system, ended) = ends_as_planned(6_400, flags, SHARDS_PAUSE_AT, &kills);
    let kills = kills.len();
    ended.expect_stderr(&format!("with its replay (restart {kills} of at most 8"));
    for log in ["shard-0/log.toml", "shard-1/log.toml"] {
        assert!(system.path("run/replay").join(log).exists());
    }
    let shard = "--agent c51 --replay-dir run/replay --shard 1 --set replay.shards=2";
    let server = format!("{shard} {} --actors 2", chain(6_400));
    let mut server = system.start_process(&system.replay_server_args(&server));
    server.wait_for_stderr("the replay in run/replay holds up to ");
    server.kill();
}

#[test]
fn a_launched_run_gives_a_replay_server_up_that_dies_again_and_again() {
    let system = system();
    let process = start_run_with(&system, "--durable --agent c51", 100);
    for _ in 0..=8 {
        signal_and_wait(&system, "replay-server", Signal::SIGKILL);
    }
    process.fails("(restart 8 of at most 8)");
    system.check_outcome(Outcome::Failed);
    let saved = system.run_folder("run").checkpoints();
    assert!(!saved.is_empty(), "the learner saved");
}

#[test]
fn a_replay_server_that_rejects_its_log_is_not_started_again() {
    let system = system();
    let process = start_run_with(&system, "--durable --agent c51", 100);
    fs::write(system.path("run/replay/log.toml"), "no log").unwrap();
    system.find_process("replay-server").signal(Signal::SIGKILL);
    let ended = process.fails("error: replay-server exited with code 64 (log: ");
    assert!(!ended.stderr.contains("(restart 2 of"), "{}", ended.stderr);
}

#[test]
fn a_resumed_run_continues_with_its_replay() {
    let system = system();
    let process = start_run_with(&system, "--durable --agent driml-ada", 1_000);
    let client = system.connect();
    // Kill all at once, as when the machine stops. Suspend the actor first, so that it adds nothing after the status is read.
    system.find_process("actor").signal(Signal::SIGSTOP);
    let before = client.replay_status().unwrap();
    drop(client);
    system.kill_all();
    process.wait();

    let frames = before.transitions_inserted + 2_000;
    system.run_ok(&format!("local --resume run --frames {frames}"));
    let run = system.run_folder("run");
    // Among others, this checks that each episode is recorded once.
    let summary = run.check_finished();
    // The replay is not filled again: no frame is made twice, and no episode is counted twice.
    let planned = frames..frames + 64;
    assert!(planned.contains(&summary.frames), "{summary:#?}");
    assert!(summary.episodes > before.episodes, "{summary:#?}");
    assert_eq!(summary.mean_return_of, 100, "{summary:#?}");
    let log = run.log("replay-server");
    check_has(&log, &["continues with the replay in run/replay"]);
    // The replay's log may contain updates that no checkpoint holds.
    let warns = |line: &&str| line.contains("WARN") && !line.contains("repeats the later ones");
    assert_eq!(log.lines().find(warns), None, "{log}");

    // Without its log, the replay counts as lost, and the episodes before stay in their table.
    for name in system.file_names("run/replay") {
        if name.starts_with("segment-") {
            fs::remove_file(system.path("run/replay").join(name)).unwrap();
        }
    }
    let frames = summary.frames + 500;
    system.run_ok(&format!("local --resume run --frames {frames}"));
    assert!(run.check_finished().episodes > summary.episodes);
    assert!(!system.path("run/episodes.aside-1.csv").exists());
}

/// Nothing is learned in a warm-up, but its frames are kept, and so are their rows of metrics.
#[test]
fn a_run_that_is_interrupted_in_its_warm_up_continues_there() {
    let system = system();
    let long = "--set replay.capacity_transitions=1000000 --set replay.warmup_transitions=1000000";
    let flags = format!("--durable --agent c51 {} {long}", chain(2_000_000));
    let process = system.start(&system.local_args(&flags));
    drop(system.connect());
    let run = system.run_folder("run");
    let recorded = || run.table("metrics.csv").last::<u64>("frames");
    wait_until("a row", || recorded() > Some(500));
    process.interrupt().expect_code(130);
    let warmup = run.summary().frames;
    let frames = warmup + 500;
    let flags = format!("--frames {frames} --set replay.warmup_transitions={warmup}");
    system.run_ok(&format!("local --resume run {flags}"));
    let summary = run.check(Outcome::Finished);
    assert!(summary.updates >= 250, "{summary:#?}");
    assert!(!system.path("run/metrics.aside-1.csv").exists());
}

/// The old processes still exit while the next launcher starts: the replay server waits for a frozen actor, and holds replay and endpoint.
#[test]
fn a_run_whose_launcher_was_killed_continues() {
    let system = system();
    let process = start_run_with(&system, "--durable --agent c51", 1_000);
    let client = system.connect();
    let actor = system.find_process("actor");
    actor.signal(Signal::SIGSTOP);
    let frames = client.replay_status().unwrap().transitions_inserted + 2_000;
    drop(client);
    process.kill();
    // Which process exits last depends on how busy the machine is.
    let resume = system.listen_args(&format!("local --resume run --frames {frames}"));
    system.run_ok(&resume).expect_stderr(": waiting");
    actor.signal(Signal::SIGKILL);
    system.run_folder("run").check_finished();
}
