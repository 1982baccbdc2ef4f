//! A run whose processes are on separate machines, joined by a router: machines that are disconnected, links that are slow.
//! The machines are network namespaces; without the privileges to make them, the tests are skipped by name.

use std::{thread::sleep, time::Duration};

use driml_tests::{Network, Process, TestSystem, print_line, skip, wait_for, wait_until};
use nix::sys::signal::Signal;
use rand::{Rng, SeedableRng, rngs::StdRng};
use serde_json::Value;

use crate::{ROWS, WARMUP, system};

/// A run of processes that were started by hand, each on its own machine. Its replay is kept on disk.
struct Run {
    system: TestSystem,
    network: Network,
    flags: String,
    ratio: u64,
    /// The processes on the first of the [`MACHINES`], in the same order.
    processes: Vec<Process>,
}

const MACHINES: [&str; 5] = ["server", "learner", "actor0", "actor1", "actor2"];

impl Run {
    /// Starts a run. If the network cannot be made, returns `None` and reports the test as skipped.
    fn start(system: TestSystem, actors: usize, frames: u64, ratio: u64) -> Option<Self> {
        let network = Network::new(&MACHINES[..2 + actors])?;
        let system = system.with_endpoint(format!("tcp/{}:7447", network.address("server")));
        // Without shared memory, which namespaces share, everything goes through the links.
        let flags = format!(
            "--env chain --preset smoke --agent driml-ada --frames {frames} --set replay.replay_ratio={ratio} \
             --set transport.shared_memory=false --allow-insecure --replay-dir replay"
        );
        let mut run = Self {
            system,
            network,
            flags,
            ratio,
            processes: Vec::new(),
        };
        for machine in 0..2 + actors {
            run.processes.push(run.start_process_on(machine));
        }
        Some(run)
    }

    fn start_process_on(&self, machine: usize) -> Process {
        let system = &self.system;
        let args = match machine {
            0 => system.replay_server_args(&self.flags),
            1 => system.connect_args("learner --keep-alive --run-dir run"),
            _ => system.connect_args(&format!("actor --id {}", machine - 2)),
        };
        let on = self.network.exec_prefix(MACHINES[machine]);
        system.start_process(&format!("{on} DRIML {args}"))
    }

    /// Requests the status of the run from the router; `None` while no process answers.
    fn status(&self) -> Option<Value> {
        let on = self.network.exec_prefix("router");
        let status = format!("{on} DRIML status --json");
        let ended = self.system.run(&self.system.connect_args(&status));
        let status: Value = serde_json::from_str(ended.stdout.lines().next()?).unwrap();
        status["servers"][0]["replay"].is_object().then_some(status)
    }

    fn inserted(&self) -> u64 {
        wait_for("an answer", || self.status())["replay"]["transitions_inserted"]
            .as_u64()
            .unwrap()
    }

    fn wait_for_frames(&self, frames: u64) {
        wait_until(&format!("{frames} frames"), || self.inserted() >= frames);
    }

    /// Waits for the end of the run, and checks that the counts are as if nothing had happened.
    fn check_end(mut self) {
        let is_over = |status: &Value| {
            status["replay"]["finished"] == true && status["learner"]["finished"] == true
        };
        let status = wait_for("the run's end", || self.status().filter(is_over));
        let count = |of: &str, what: &str| status[of][what].as_u64().unwrap();
        let inserted = count("replay", "transitions_inserted");
        let planned = (inserted - WARMUP) * self.ratio / u64::from(ROWS);
        assert_eq!(count("learner", "updates"), planned);
        assert_eq!(count("replay", "rows_sampled"), planned * u64::from(ROWS));
        for what in "transitions_lost transitions_duplicated messages_refused".split(' ') {
            assert_eq!(count("replay", what), 0, "{what}");
        }
        for actor in self.processes.drain(2..) {
            actor.wait_ok();
        }
        // Stop the learner, then the server.
        for process in self.processes.into_iter().rev() {
            process.stop(0);
        }
        assert_eq!(self.system.running_processes(), []);
    }
}

/// An actor is disconnected for longer than a session's lease, and then the learner and the server too. The others continue while they can.
#[test]
fn cut_cables_heal_by_themselves() {
    let system = system();
    // Pause the learner, so that even on a fast machine it is not done before the last cut.
    system.pause_learners_at(25_000);
    let Some(run) = Run::start(system, 2, 60_000, 8) else {
        return;
    };
    run.wait_for_frames(2_000);
    run.network.disconnect("actor0");
    let before = run.inserted();
    run.wait_for_frames(before + 2_000);
    sleep(Duration::from_secs(10));
    run.network.disconnect("learner");
    sleep(Duration::from_secs(15));
    run.network.reconnect("learner");
    sleep(Duration::from_secs(10));
    // The learner does not answer before its connection is there again.
    let status = wait_for("the learner's answer", || {
        run.status().filter(|it| it["learner"].is_object())
    });
    let is_over = &status["learner"]["finished"];
    assert_eq!(is_over, false, "a cut of a run that is over");
    run.network.reconnect("actor0");
    run.network.disconnect("server");
    sleep(Duration::from_secs(12));
    run.network.reconnect("server");
    run.system.release_learners();
    run.check_end();
}

/// One actor sends 64 kbit/s, so that a chunk takes half a second. No process restarts or loses its connection, and nothing is lost.
#[test]
fn a_narrow_link_stops_no_process() {
    let system = system();
    // Pause the learner, so that the other actor does not play all frames before this one begins.
    system.pause_learners_at(500);
    let Some(mut run) = Run::start(system, 2, 20_000, 8) else {
        return;
    };
    wait_until("both actors", || {
        let status = run.status();
        status.is_some_and(|it| it["replay"]["actors_acting"] == 2)
    });
    if !run.network.limit_rate("actor0", 64, 256) {
        return skip("tc knows no tbf");
    }
    run.system.release_learners();
    wait_until("packets that wait at the link", || {
        run.network.delayed_packets("actor0") > 20
    });
    let status = wait_for("6,000 frames", || {
        let inserted = |it: &Value| it["replay"]["transitions_inserted"].as_u64() >= Some(6_000);
        run.status().filter(inserted)
    });
    assert!(run.processes.iter_mut().all(Process::is_running));
    let processes = &status["servers"][0]["processes"]["processes"];
    let processes = processes.as_array().unwrap();
    assert_eq!(processes.len(), 3, "a learner and two actors");
    for process in processes {
        let is_there = process["connected"] == true && process["lives"] == 1;
        let last_seen_s = process["last_seen_s"].as_f64().unwrap();
        assert!(is_there && last_seen_s < 10.0, "{process}");
    }
    run.check_end();
}

/// The learner receives 12 kbit/s, so that a batch takes seconds. Batches that take longer than a request waits at first are not tested.
#[test]
fn batches_come_over_a_slow_link() {
    let system = system();
    system.pause_learners_at(100);
    let Some(run) = Run::start(system, 1, 1_000, 8) else {
        return;
    };
    let updates = || run.status()?["replay"]["updates"].as_u64();
    wait_until("updates", || updates() >= Some(90));
    if !run.network.limit_rate("learner", 256, 12) {
        return skip("tc knows no tbf");
    }
    run.system.release_learners();
    // Batches that were fetched before, and one more.
    wait_until("further updates", || updates() > Some(104));
}

/// Disconnects each process for 30 s, then for 90 s. Run by hand: it takes seven minutes.
#[test]
#[ignore = "seven minutes: cargo nextest run --workspace --run-ignored only -E 'test(cut_off_for_long)'"]
fn each_process_is_cut_off_for_long() {
    let Some(run) = Run::start(system(), 2, 400_000, 8) else {
        return;
    };
    run.wait_for_frames(2_000);
    for seconds in [30, 90] {
        for machine in ["actor0", "learner", "server"] {
            run.network.disconnect(machine);
            sleep(Duration::from_secs(seconds));
            run.network.reconnect(machine);
            run.wait_for_frames(run.inserted() + 1_000);
        }
    }
    run.check_end();
}

/// Kills, suspends, disconnects and restarts at random: DRIML_FAULTS faults (default 200) with the seed DRIML_FAULTS_SEED (default 1).
#[test]
#[ignore = "a quarter of an hour: cargo nextest run --workspace --run-ignored only -E 'test(random_faults)'"]
fn random_faults_lose_nothing() {
    let number = |name: &str, usual: u64| {
        let text = std::env::var(name);
        text.map_or(usual, |text| text.parse().expect("a number"))
    };
    let (seed, faults) = (number("DRIML_FAULTS_SEED", 1), number("DRIML_FAULTS", 200));
    // The replay ratio makes the learner the slower side, so that the run lasts as long as the faults.
    let Some(mut run) = Run::start(system(), 3, 600 * faults, 64) else {
        return;
    };
    run.wait_for_frames(500);
    let mut rng = StdRng::seed_from_u64(seed);
    let mut tried = [0; 4];
    for fault in 0..faults {
        let machine = rng.random_range(0..MACHINES.len());
        let pause = Duration::from_millis(rng.random_range(100..3_000));
        let kind = rng.random_range(0..4);
        tried[kind] += 1;
        let what = ["kill", "freeze", "cut", "restart"][kind];
        print_line(&format!(
            "fault {fault}: {what} {} for {pause:?}",
            MACHINES[machine]
        ));
        match kind {
            0 | 3 => {
                let signal = if kind == 0 {
                    Signal::SIGKILL
                } else {
                    Signal::SIGTERM
                };
                let process = &mut run.processes[machine];
                process.signal(signal);
                wait_until("its end", || !process.is_running());
                sleep(pause);
                run.processes[machine] = run.start_process_on(machine);
            }
            1 => {
                run.processes[machine].signal(Signal::SIGSTOP);
                sleep(pause);
                run.processes[machine].signal(Signal::SIGCONT);
            }
            _ => {
                run.network.disconnect(MACHINES[machine]);
                sleep(pause);
                run.network.reconnect(MACHINES[machine]);
            }
        }
        sleep(Duration::from_millis(rng.random_range(0..1_500)));
    }
    let faults = "kills, freezes, cuts, restarts";
    print_line(&format!("seed {seed}: {faults} {tried:?}"));
    let status = wait_for("an answer", || run.status());
    let is_over = &status["replay"]["finished"];
    assert_eq!(is_over, false, "faults after the end prove nothing");
    run.check_end();
}
