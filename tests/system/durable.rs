//! A replay that is kept on disk, and replay servers that are killed: every transition once, every update of the plan, nothing said
//! twice. What comes back of a log, whole or damaged, is tested beside the code; here are real processes and real disks.

use std::{collections::BTreeSet, fs, process::Command, time::Duration};

use driml_actor::{Delivery, DeliveryLimits};
use driml_protocol::{
    Batch, BatchReply, BatchRequest, Buffer, BufferPool, Chunk, ChunkHeader, End, Keys, Learned,
    RequestId, RunClient, RunSpec, Shutdown,
    config::Settings,
    session::{self, Endpoints},
};
use driml_replay_server::{Config, PersistArgs, Replay};
use driml_tests::{Process, RunFolder, Survivor, TestSystem, note, skip, wait_for};
use nix::sys::signal::Signal;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{LONG, SHORT, disk_full::Disk, system};

/// Batches that may have been on their way to a learner that ended.
const IN_FLIGHT: u64 = 8;
/// Actors that number their transitions, chunks of each, and transitions of a chunk.
const ACTORS: u32 = 3;
const CHUNKS: u64 = 40;
const STREAMS: u32 = 4;
const STEPS: u32 = 8;
const OF_AN_ACTOR: u64 = CHUNKS * (STREAMS * STEPS) as u64;
const TRANSITIONS: u64 = ACTORS as u64 * OF_AN_ACTOR;
/// What the preset `smoke` says.
const WARMUP: u64 = 200;
const ROWS: u32 = 16;
/// Rows for each transition.
const RATIO: u64 = 64;
/// How often each transition is drawn at the end, on average: that one is never drawn has a probability of exp(-64).
const DRAWN: u64 = 64;
/// How often the server is killed.
const KILLS: u64 = 6;

/// Kills a replay server.
fn kill(server: Process) {
    server.signal(Signal::SIGKILL);
    assert_eq!(server.wait().signal, Some(Signal::SIGKILL as i32));
}

/// Kills a replay server of a launched run, and waits for its successor, or the end of the run.
fn kill_server(system: &TestSystem) {
    let dead = system.find_part("replay-server");
    let servers = |of: &[Survivor]| {
        let all = of.iter().filter(|it| it.args.first() == dead.args.first());
        all.count()
    };
    let before = servers(&system.survivors());
    dead.signal(Signal::SIGKILL);
    wait_for("another server, or the end", || {
        let left = system.survivors();
        let is_back = !left.contains(&dead) && servers(&left) == before;
        (is_back || left.is_empty()).then_some(())
    });
}

fn session_with(system: &TestSystem) -> zenoh::Session {
    session::open(&Endpoints {
        listen: Vec::new(),
        connect: vec![system.endpoint()],
    })
    .unwrap()
}

/// Delivers all of one actor's chunks; each transition is one episode whose return is its number.
fn deliver(run: RunClient, actor: u32, frame_bytes: u32) {
    let limits = DeliveryLimits {
        chunks_in_flight_max: 4,
        ack_timeout: Duration::from_secs(2),
        unreachable_max: Duration::from_secs(60),
    };
    let stop = Shutdown::default();
    let delivery = Delivery::start(run, 0, limits, BufferPool::new(8), stop).unwrap();
    let mut header = ChunkHeader {
        actor,
        incarnation: 1,
        sequence: 0,
        first_transition: 0,
        weights_version: 0,
        leaving: false,
        streams: STREAMS,
        steps: STEPS,
        frame_bytes,
    };
    while header.sequence < CHUNKS {
        let mut chunk = Chunk::zeroed(header);
        for row in 0..header.transitions() {
            let number = u64::from(actor) * OF_AN_ACTOR + header.first_transition + row as u64;
            chunk.set(row, 0, number as f32, End::Terminal);
        }
        header.sequence += 1;
        header.first_transition += header.transitions() as u64;
        assert!(delivery.send(chunk));
    }
    assert_eq!(delivery.finish().unwrap(), 0);
}

/// Asks for all batches there are, as a learner that asks again; gives their number.
fn learn(run: &RunClient, learner: u64) -> u64 {
    let pool = BufferPool::new(2);
    let mut batches = 0;
    let mut id = RequestId::first(learner);
    let ask = |id, batches: u64| {
        let request = BatchRequest {
            learner,
            id,
            rows: ROWS,
            shared_memory: false,
            learned: Learned {
                rows_received: batches * u64::from(ROWS),
                ..Learned::default()
            },
            other_shards: None,
        };
        let asked = run.send(run.seal(&request)?, Duration::from_secs(2))?;
        asked.receive(&pool)
    };
    loop {
        id = id.again();
        match ask(id, batches) {
            Ok((
                reply @ (BatchReply::Batch(_)
                | BatchReply::Prioritised(..)
                | BatchReply::Stacked(..)),
                payload,
            )) => {
                let header = reply.header().unwrap();
                Batch::from_payload(header, payload).unwrap();
                batches += 1;
                id = id.next();
            }
            Ok((BatchReply::Wait(_), _)) => id = id.next(),
            Ok((BatchReply::Finished, _)) => return batches,
            Ok((BatchReply::Refused { why }, _)) => panic!("{why}"),
            // The server is away; it is asked again, as the same request.
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// The numbers of all transitions in a replay that is no longer in use: of rows that are drawn from it as often as need be.
fn numbers_in(system: &TestSystem, spec: &RunSpec, config_toml: &str) -> BTreeSet<u64> {
    let mut config: Config = Settings::parse(config_toml)
        .unwrap()
        .table("replay")
        .unwrap();
    config.replay_ratio = 1e6;
    let args = PersistArgs {
        dir: system.path("replay"),
        shard: 0,
        segment_bytes: None,
        mark: None,
    };
    let (mut replay, recovery) = Replay::open(&args, spec, &config, ROWS).unwrap();
    assert!(
        recovery.found && recovery.warnings.is_empty(),
        "{recovery:?}"
    );
    replay.check_valid();
    let mut numbers = BTreeSet::new();
    for number in 0..TRANSITIONS * DRAWN / u64::from(ROWS) {
        let id = RequestId {
            client_id: 1,
            number,
            attempt: 0,
        };
        let batch = replay.draw_for(id, ROWS, Buffer::zeroed).unwrap().unpack();
        let returns = batch.n_step_returns();
        numbers.extend(returns.into_iter().map(|it| it as u64));
    }
    numbers
}

/// Rows that are sampled of all transitions.
const SAMPLED: u64 = (TRANSITIONS - WARMUP) * RATIO;

/// Numbered transitions and counted batches through deaths of the server, after so many rows each: the sets are equal, and so are the
/// counts.
fn kill_after_rows(moments: impl IntoIterator<Item = u64>) {
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
    let (spec_hash, frame_bytes) = (client.spec.hash(), client.spec.frame_bytes() as u32);
    let run = || {
        RunClient::new(
            session_with(&system),
            Keys::new("driml").unwrap(),
            spec_hash,
        )
    };
    let batches = std::thread::scope(|scope| {
        for actor in 0..ACTORS {
            let run = run();
            scope.spawn(move || deliver(run, actor, frame_bytes));
        }
        let learner = run();
        let learning = scope.spawn(move || learn(&learner, 7));
        for rows in moments {
            client.wait_for_replay("some more rows", |replay| replay.rows_sampled > rows);
            server.take().into_iter().for_each(kill);
            server = Some(system.start_replay_server(&flags));
        }
        learning.join().unwrap()
    });
    assert_eq!(batches, SAMPLED / u64::from(ROWS));
    // A server that has just started is not reached at once.
    let replay = client.wait_for_replay("the counts in the end", |_| true);
    assert_eq!(
        (replay.transitions_lost, replay.transitions_duplicated),
        (0, 0)
    );
    // As many are stored as there are numbers: if each number is there, none is there twice.
    assert_eq!(replay.transitions_inserted, TRANSITIONS);
    let (spec, config_toml) = (client.spec.clone(), client.config_toml.clone());
    drop(client);
    server.into_iter().for_each(kill);
    let numbers = numbers_in(&system, &spec, &config_toml);
    let missing: Vec<_> = (0..TRANSITIONS)
        .filter(|it| !numbers.contains(it))
        .collect();
    assert_eq!(missing, [0; 0]);
    assert_eq!(numbers.len() as u64, TRANSITIONS);
}

#[test]
fn a_killed_server_loses_and_doubles_no_transition_and_no_batch() {
    kill_after_rows((1..=KILLS).map(|round| round * SAMPLED / (KILLS + 1)));
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

fn check_exactly_once(run: &RunFolder) {
    let summary = run.summary();
    assert_eq!(
        (summary.transitions_lost, summary.transitions_duplicated),
        (0, 0),
        "{summary:#?}"
    );
    assert_eq!(
        summary.updates,
        planned(summary.transitions_inserted),
        "{summary:#?}"
    );
    assert_eq!(
        summary.rows_sampled,
        summary.updates * u64::from(ROWS),
        "{summary:#?}"
    );
}

#[test]
fn a_launched_run_starts_its_dead_replay_server_again() {
    let system = system();
    let longer = SHORT.replace("--frames 1280", "--frames 20000");
    assert_ne!(longer, SHORT);
    system.hold_at(5_500);
    let process = system.start(&format!(
        "local --durable --agent driml-ada {longer} --actors 2 --listen {} --run-dir run",
        system.endpoint()
    ));
    let run = system.run_folder("run");
    for updates in [900, 2_900, 4_900] {
        wait_for("some more updates", || {
            run.updates_recorded().filter(|it| *it > updates)
        });
        kill_server(&system);
    }
    system.let_go();
    let ended = process
        .wait()
        .expect_code(0)
        .expect_said("replay-server was killed by signal 9 SIGKILL")
        .expect_said(
            "replay-server is started again with what it has kept (3 of 8 times in a run)",
        );
    assert!(
        ended.stdout.contains("of disk, in the run folder"),
        "{}",
        ended.stdout
    );
    check_exactly_once(&run);
    assert_eq!(run.check_finished().replay_servers_restarted, 3);
    assert_eq!(system.survivors(), []);
}

#[test]
fn a_launched_run_gives_a_replay_server_up_that_dies_again_and_again() {
    let system = system();
    let process = system.start(&format!(
        "local --durable --agent c51 {LONG} --listen {} --run-dir run",
        system.endpoint()
    ));
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 100);
    drop(client);
    for _ in 0..=8 {
        kill_server(&system);
    }
    process
        .wait()
        .expect_code(1)
        .expect_said("(8 of 8 times in a run)");
    assert_eq!(system.run_folder("run").summary().outcome, "failed");
    assert!(
        !system.run_folder("run").checkpoints().is_empty(),
        "the learner saved"
    );
    assert_eq!(system.survivors(), []);
}

/// The processes were started by hand; the server is started again, with the same flags. An actor that starts then has weights although
/// the learner, which waits for transitions, publishes none.
#[test]
fn parts_by_hand_go_on_when_the_server_is_started_again() {
    let system = system();
    let longer = SHORT.replace("--frames 1280", "--frames 12800");
    let flags = format!("--agent driml-ada {longer} --replay-dir replay");
    system.hold_at(1_000);
    let server = system.start_replay_server(&flags);
    let learner = system.start_learner("run");
    let actors = [system.start_actor(0), system.start_actor(1)];
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 500);
    kill(server);
    let [first, second] = actors;
    kill(first);
    kill(second);
    system.let_go();
    let server = system.start_replay_server(&flags);
    let actors = [system.start_actor(0), system.start_actor(1)];
    for actor in actors {
        actor.wait().expect_code(0);
    }
    let status = client.wait_for_learner("the learner's last update", |learner| learner.finished);
    let replay = client.replay().unwrap();
    assert_eq!(status.updates, planned(replay.transitions_inserted));
    assert_eq!(
        (replay.transitions_lost, replay.transitions_duplicated),
        (0, 0)
    );
    learner.stop().expect_code(0);
    drop(client);
    server
        .stop()
        .expect_code(0)
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
    let longer = SHORT.replace("--frames 1280", "--frames 6400");
    system.hold_at(SHARDS_HOLD);
    let process = system.start(&format!(
        "local --durable --agent c51 {longer} --actors 2 --replay-shards 2 --run-dir run"
    ));
    let run = system.run_folder("run");
    let mut kills = 0;
    for updates in moments {
        wait_for("some more updates", || {
            run.updates_recorded().filter(|it| *it > updates)
        });
        kill_server(&system);
        kills += 1;
    }
    system.let_go();
    process.wait().expect_code(0).expect_said(&format!(
        "is started again with what it has kept ({kills} of 8"
    ));
    check_exactly_once(&run);
    for shard in ["shard-0", "shard-1"] {
        assert!(
            run.path()
                .join("replay")
                .join(shard)
                .join("log.toml")
                .exists()
        );
    }
}

#[test]
fn a_resumed_run_continues_with_its_replay() {
    let system = system();
    let process = system.start(&format!(
        "local --durable --agent driml-ada {LONG} --listen {} --run-dir run",
        system.endpoint()
    ));
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 1_000);
    // All at once, as when the machine stops; but the actor first, so that nothing is made after the last look.
    let parts = ["replay-server", "learner", "actor"].map(|part| system.find_part(part));
    parts[2].signal(Signal::SIGSTOP);
    let before = client.replay().unwrap();
    drop(client);
    process.signal(Signal::SIGKILL);
    parts.iter().for_each(|part| part.signal(Signal::SIGKILL));
    process.wait();

    let frames = before.transitions_inserted + 2_000;
    system
        .run(&format!("local --resume run --frames {frames}"))
        .expect_code(0);
    let run = system.run_folder("run");
    let summary = run.check_finished();
    check_exactly_once(&run);
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
    assert!(
        log.contains("continues with the replay in run/replay"),
        "{log}"
    );
    // The log may know of updates that no checkpoint holds.
    let warns = |line: &&str| line.contains("WARN") && !line.contains("to be learned again");
    assert_eq!(log.lines().find(warns), None, "{log}");
}

/// Its processes still end while the next launcher starts: the replay server, which waits for a frozen actor, holds replay and endpoint.
#[test]
fn a_run_whose_launcher_was_killed_continues() {
    let system = system();
    let listen = format!("--listen {}", system.endpoint());
    let process = system.start(&format!(
        "local --durable --agent c51 {LONG} {listen} --run-dir run"
    ));
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 1_000);
    let actor = system.find_part("actor");
    actor.signal(Signal::SIGSTOP);
    let frames = client.replay().unwrap().transitions_inserted + 20_000;
    drop(client);
    process.signal(Signal::SIGKILL);
    process.wait();
    system
        .run(&format!("local --resume run --frames {frames} {listen}"))
        .expect_code(0)
        .expect_said("processes of the run in run still end: waiting");
    actor.signal(Signal::SIGKILL);
    let run = system.run_folder("run");
    run.check_finished();
    check_exactly_once(&run);
}

/// While there is no room nothing is stored and nothing served; then everything continues, and nothing was lost.
#[test]
fn a_full_disk_makes_all_processes_wait_until_there_is_room() {
    let system = system();
    let name = "a_full_disk_makes_all_processes_wait_until_there_is_room";
    let Some(disk) = Disk::mount(name, system.path("disk"), 20_000) else {
        return;
    };
    let flags = format!("--agent c51 {LONG} --replay-dir disk/replay");
    let mut server = system.start_replay_server(&flags);
    let (learner, actor) = (system.start_learner("run"), system.start_actor(0));
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 100);
    let filler = disk.fill();
    server.wait_for_stderr("cannot be written: No space left on device (os error 28); nothing more is stored until it can");
    let stopped = client.replay().unwrap();
    let ask = format!("status --connect {}", system.endpoint());
    wait_for("a status that says it", || {
        let said = system.run(&ask).stdout;
        let words = [
            "replay on disk: ",
            "REFUSED for",
            "No space left on device",
            "If the replay server dies now",
            "to do: the disk of the replay server on",
        ];
        words.iter().all(|it| said.contains(it)).then_some(())
    });
    filler.remove();
    client.wait_for_replay("more frames", |replay| {
        replay.transitions_inserted > stopped.transitions_inserted + 1_000
    });
    server.wait_for_stderr("can be written again; nothing was lost");
    let said = system.run(&ask).stdout;
    assert!(
        said.contains("replay on disk: ") && !said.contains("REFUSED"),
        "{said}"
    );
    actor.stop().expect_code(0);
    learner.stop().expect_code(0);
    let before = client.replay().unwrap();
    assert_eq!(
        (before.transitions_lost, before.transitions_duplicated),
        (0, 0)
    );
    kill(server);
    let server = system.start_replay_server(&flags);
    let after = wait_for("the server", || client.replay());
    assert_eq!(after.transitions_inserted, before.transitions_inserted);
    // Whatever was served while the disk was full was learned.
    let learner = system.start_learner("run");
    let rows = "rows that the learner's checkpoint has";
    let after = client.wait_for_replay(rows, |replay| {
        replay.rows_sampled >= before.rows_sampled - 16 * IN_FLIGHT
    });
    assert_eq!(after.updates_relearned, 0, "{after:#?}");
    client.wait_for_learner("the learner", |_| true);
    learner.stop().expect_code(0);
    drop(client);
    server.stop().expect_code(0);
}

#[test]
fn a_folder_that_cannot_be_used_is_said() {
    let system = system();
    let flags = format!("--agent c51 {SHORT} --replay-dir replay");
    let server = system.start_replay_server(&flags);
    drop(system.connect());
    let other = |flags: &str| {
        let socket = system.path("other").display().to_string();
        system.start_part(&format!(
            "replay-server --listen unixsock-stream/{socket} {flags}"
        ))
    };
    other(&flags)
        .wait()
        .expect_code(1)
        .expect_said("another replay server keeps its replay in replay: end it first, or choose another --replay-dir");
    server.stop().expect_code(0);
    other(&flags.replace("c51", "driml-ada"))
        .wait()
        .expect_code(1)
        .expect_said("replay holds the replay of another run (its run spec has the hash");

    let name = "a_folder_that_cannot_be_used_is_said";
    let Some(disk) = Disk::mount(name, system.path("disk"), 3_000) else {
        return;
    };
    let mut remount = Command::new("mount");
    remount.args(["-o", "remount,ro"]).arg(system.path("disk"));
    match remount.status() {
        Ok(status) if status.success() => {}
        _ => return skip(name, "no read-only file system"),
    }
    other(&flags.replace("--replay-dir replay", "--replay-dir disk/replay"))
        .wait()
        .expect_code(1)
        .expect_said("Read-only file system (os error 30); --replay-dir needs a folder with room that this process may write");
    drop(disk);
    assert!(fs::read_dir(system.path("replay")).unwrap().count() > 2);
}
