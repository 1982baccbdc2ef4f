//! A long run at a closed limiter, with actors that join, leave and die all the time: memory, files and threads do not grow.
//! Run by hand; it lasts `DRIML_SOAK_MINUTES` minutes, by default an hour.

use std::{
    fs,
    thread::sleep,
    time::{Duration, Instant},
};

use driml_tests::{Process, TestSystem, print_line};
use rand::{Rng, SeedableRng, rngs::StdRng};

use crate::system;

const ACTORS: usize = 32;
/// The time before the first measurement: buffers fill, and as many actors come and go as may send through shared memory.
const WARMUP: Duration = Duration::from_secs(300);

/// The resources that a process holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Resources {
    rss_kib: u64,
    descriptors: usize,
    threads: u64,
}

fn held_resources(system: &TestSystem, process: &str) -> Resources {
    let process = system.find_process(process);
    let descriptors = fs::read_dir(format!("/proc/{}/fd", process.pid));
    Resources {
        rss_kib: process.status("VmRSS"),
        descriptors: descriptors.unwrap().count(),
        threads: process.status("Threads"),
    }
}

#[test]
#[ignore = "an hour: cargo nextest run --workspace --run-ignored only -E 'test(soak)' --no-capture"]
fn nothing_grows() {
    let minutes = std::env::var("DRIML_SOAK_MINUTES");
    let minutes: u64 = minutes.map_or(60, |text| text.parse().expect("a number of minutes"));
    assert!(minutes >= 7, "the first measurement is after 5");
    let end = Instant::now() + Duration::from_secs(60 * minutes);
    let system = system();
    let flags = "--env chain --preset smoke --agent driml-ada --frames 100000000 --set replay.replay_ratio=512";
    let server = system.start_replay_server(flags);
    let learner = system.start_learner("run");
    let client = system.connect();
    let mut actors: Vec<Option<Process>> = Vec::new();
    actors.resize_with(ACTORS, || None);
    let mut rng = StdRng::seed_from_u64(1);
    let (mut deaths, mut ends, mut samples) = (0, 0, Vec::new());
    let (mut next_sample_at, started) = (Instant::now() + WARMUP, Instant::now());
    while Instant::now() < end {
        let id = rng.random_range(0..ACTORS);
        match actors[id].take() {
            None => actors[id] = Some(system.start_actor(id as u32)),
            Some(actor) if rng.random_bool(0.5) => {
                actor.kill();
                deaths += 1;
            }
            Some(actor) => {
                actor.stop(130);
                ends += 1;
            }
        }
        sleep(Duration::from_millis(rng.random_range(50..1_000)));
        if Instant::now() > next_sample_at {
            next_sample_at += Duration::from_secs(60);
            let sample = (
                held_resources(&system, "replay-server"),
                held_resources(&system, "learner"),
                // Segments of shared memory on this machine, including those of other runs.
                fs::read_dir("/dev/shm").unwrap().count(),
            );
            print_line(&format!("after {:?}: {sample:?}", started.elapsed()));
            samples.push(sample);
        }
    }
    let replay = client.check_nothing_lost();
    print_line(&format!(
        "{} transitions, {} rows, {deaths} actors killed, {ends} ended",
        replay.transitions_inserted, replay.rows_sampled
    ));
    assert!(samples.len() > 1, "nothing to compare");
    let (first, last) = (samples[0], samples[samples.len() - 1]);
    for (before, after) in [(first.0, last.0), (first.1, last.1)] {
        // Allow a tenth and 8 MiB, because the allocator's pools fill unevenly.
        let most = before.rss_kib * 11 / 10 + 8 * 1024;
        assert!(after.rss_kib < most, "{before:?}, then {after:?}");
        assert!(
            after.descriptors <= before.descriptors + 2 * ACTORS
                && after.threads <= before.threads + 4,
            "{before:?}, then {after:?}"
        );
    }
    assert!(last.2 <= first.2 + 3 * ACTORS, "{first:?}, then {last:?}");
    drop(client);
    let left = actors.into_iter().flatten();
    left.for_each(|actor| drop(actor.stop(130)));
    learner.stop(130);
    server.stop(130);
    assert_eq!(system.running_processes(), []);
}
