//! A replay that is kept on disk, and replay servers that are killed: every transition once, every update of the plan, nothing said
//! twice. What comes back of a log, whole or damaged, is tested beside the code; here are real processes and real disks.

use std::collections::BTreeSet;

use driml_tests::{
    Outcome, Process, Survivor, TestSystem, check_has, check_nothing_lost, note, wait_until,
};
use nix::sys::signal::Signal;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    PRIORITISED, chain, launched_with,
    numbered::{KILLS, ROWS, SAMPLED, WARMUP, kill_after_rows},
    prioritised::{SET, said},
    system,
};

/// Kills a replay server of a launched run, and waits for its successor, or the end of the run.
fn kill_server(system: &TestSystem) {
    let dead = system.find_process("replay-server");
    let servers = |of: &[Survivor]| {
        let all = of.iter().filter(|it| it.args.first() == dead.args.first());
        all.count()
    };
    let before = servers(&system.survivors());
    dead.signal(Signal::SIGKILL);
    wait_until("another server, or the end", || {
        let left = system.survivors();
        left.is_empty() || !left.contains(&dead) && servers(&left) == before
    });
}

/// A server of numbered transitions, and servers of two shards in a launched run, killed at moments that follow from the seed.
#[test]
#[ignore = "an hour: cargo nextest run --workspace --run-ignored only -E 'test(fifty_seeds)'"]
fn fifty_seeds_of_random_kills_lose_and_double_nothing() {
    for seed in 0..50 {
        note(&format!("seed {seed}"));
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut moments =
            |max| -> BTreeSet<u64> { (0..KILLS).map(|_| rng.random_range(0..max)).collect() };
        kill_after_rows(moments(SAMPLED));
        kill_shards_after_updates(moments(SHARDS_HOLD - 100));
    }
}

/// Updates that the settings of `SHORT` and `LONG` plan for so many frames.
const fn planned(frames: u64) -> u64 {
    (frames - WARMUP) * 8 / ROWS as u64
}

/// Its rows are drawn by priority: transitions come back with the highest one each, and losses of rows that were drawn before are not
/// mistaken for those of others.
#[test]
fn a_launched_run_starts_its_dead_replay_server_again() {
    let system = system();
    let longer = chain(8_000);
    system.hold_at(3_500);
    let flags = format!("--durable --agent driml-ada {longer} --actors 2 {PRIORITISED}");
    let process = system.start(&system.local(&flags));
    let run = system.run_folder("run");
    for updates in [500, 1_500, 2_500] {
        run.wait_for_updates(updates);
        kill_server(&system);
    }
    system.let_go();
    process
        .wait_ok()
        .expect_said("replay-server was killed by signal 9 SIGKILL")
        .expect_said("replay-server is started again with what it has kept (3 of 8 times in a run)")
        .expect_printed("of disk, in the run folder");
    assert_eq!(run.check_finished().replay_servers_restarted, 3);
    let log = run.log("replay-server");
    check_has(&log, &["priorities are those of the last checkpoint"]);
    assert!(said::<3>(&log, SET)[0] > 0, "{log}");
    assert_eq!(system.survivors(), []);
}

#[test]
fn a_launched_run_gives_a_replay_server_up_that_dies_again_and_again() {
    let system = system();
    let process = launched_with(&system, "--durable --agent c51", 100);
    for _ in 0..=8 {
        kill_server(&system);
    }
    process.fails("(8 of 8 times in a run)");
    system.check_over(Outcome::Failed);
    assert!(
        !system.run_folder("run").checkpoints().is_empty(),
        "the learner saved"
    );
}

/// The processes were started by hand; the server is started again, with the same flags. An actor that starts then has weights although
/// the learner, which waits for transitions, publishes none.
#[test]
fn processes_by_hand_go_on_when_the_server_is_started_again() {
    let system = system();
    let longer = chain(3_200);
    let flags = format!("--agent driml-ada {longer} --replay-dir replay");
    system.hold_at(1_000);
    let server = system.start_replay_server(&flags);
    let learner = system.start_learner("run");
    let actors = || [0, 1].map(|id| system.start_actor(id));
    let first = actors();
    let client = system.connect();
    client.wait_for_updates(500);
    server.kill();
    first.into_iter().for_each(Process::kill);
    system.let_go();
    let server = system.start_replay_server(&flags);
    for actor in actors() {
        actor.wait_ok();
    }
    let status = client.wait_for_the_last_update();
    let replay = client.check_nothing_lost();
    assert_eq!(status.updates, planned(replay.transitions_inserted));
    learner.stop_ok();
    drop(client);
    server
        .stop_ok()
        .expect_said("continues with the replay in replay");
}

/// Updates at which the learner of two shards is held until all kills are done.
const SHARDS_HOLD: u64 = 2_000;

#[test]
fn shards_come_back_each_by_itself() {
    kill_shards_after_updates([500, 1_500]);
}

fn kill_shards_after_updates(moments: impl IntoIterator<Item = u64>) {
    let system = system();
    let longer = chain(6_400);
    system.hold_at(SHARDS_HOLD);
    let process = system.start(&format!(
        "local --durable --agent c51 {longer} --actors 2 --replay-shards 2 --run-dir run"
    ));
    let run = system.run_folder("run");
    let mut kills = 0;
    for updates in moments {
        run.wait_for_updates(updates);
        kill_server(&system);
        kills += 1;
    }
    system.let_go();
    process.wait_ok().expect_said(&format!(
        "is started again with what it has kept ({kills} of 8"
    ));
    let summary = run.summary();
    let said = format!("{summary:#?}");
    let replay = &summary.replay;
    check_nothing_lost(replay);
    let updates = planned(replay.transitions_inserted);
    assert_eq!(summary.updates, updates, "{said}");
    assert_eq!(replay.rows_sampled, updates * u64::from(ROWS), "{said}");
    for log in ["replay/shard-0/log.toml", "replay/shard-1/log.toml"] {
        assert!(run.path().join(log).exists());
    }
}

#[test]
fn a_resumed_run_continues_with_its_replay() {
    let system = system();
    let process = launched_with(&system, "--durable --agent driml-ada", 1_000);
    let client = system.connect();
    // All at once, as when the machine stops; but the actor first, so that nothing is made after the last look.
    system.find_process("actor").signal(Signal::SIGSTOP);
    let before = client.replay().unwrap();
    drop(client);
    system.kill_all();
    process.wait();

    let frames = before.transitions_inserted + 2_000;
    system.run_ok(&format!("local --resume run --frames {frames}"));
    let run = system.run_folder("run");
    let summary = run.check_finished();
    // It does not fill anew: no frame was made twice, no episode is counted twice.
    assert!(
        (frames..frames + 64).contains(&summary.frames),
        "{summary:#?}"
    );
    assert!(
        summary.episodes > before.episodes && summary.mean_return_of == 100,
        "{summary:#?}"
    );
    let episodes = run.episodes();
    assert!(
        episodes.is_sorted_by(|a, b| a.episode < b.episode),
        "each once"
    );
    assert_eq!(episodes.last().unwrap().episode, summary.episodes);
    let log = run.log("replay-server");
    check_has(&log, &["continues with the replay in run/replay"]);
    // The log may know of updates that no checkpoint holds.
    let warns = |line: &&str| line.contains("WARN") && !line.contains("to be learned again");
    assert_eq!(log.lines().find(warns), None, "{log}");
}

/// Its processes still end while the next launcher starts: the replay server, which waits for a frozen actor, holds replay and endpoint.
#[test]
fn a_run_whose_launcher_was_killed_continues() {
    let system = system();
    let process = launched_with(&system, "--durable --agent c51", 1_000);
    let client = system.connect();
    let actor = system.find_process("actor");
    actor.signal(Signal::SIGSTOP);
    let frames = client.replay().unwrap().transitions_inserted + 2_000;
    drop(client);
    process.kill();
    // Which of them is the last to end depends on how busy the machine is.
    let resume = system.listening(&format!("local --resume run --frames {frames}"));
    system.run_ok(&resume).expect_said(": waiting");
    actor.signal(Signal::SIGKILL);
    system.run_folder("run").check_finished();
}
