//! `driml local` with a process for each role: what a run leaves behind, in every world that needs no installation.
//! Runs that fail are in `failures`.

use std::collections::BTreeSet;

use driml_tests::{Outcome, Summary, TestSystem, check_has, wait_until};

use crate::{LONG, PATIENT, SHORT, chain, listen_on_free_port, system, tls_system};

#[test]
fn c51_leaves_a_whole_run_folder() {
    let system = system();
    system.pause_learners_at(100);
    let process = system.start(&format!(
        "local --agent c51 {SHORT} {PATIENT} --run-dir run"
    ));
    let run = system.run_folder("run");
    for name in ["rss_mib_learner", "rss_mib_actor_0"] {
        let memory = || run.table("metrics.csv").last::<f64>(name);
        wait_until(name, || memory() > Some(1.0));
    }
    system.release_learners();
    let ended = process.wait_ok();
    let summary = run.check_finished();
    // The frames are chosen so that chunks and batches fit without a remainder; in general the ratio is within 1%.
    assert_eq!(summary.replay_ratio, Some(8.0));
    assert_eq!((summary.frames, summary.updates), (1280, 540));
    assert!(summary.episodes > 0 && summary.mean_return.is_some());
    assert_eq!(summary.mean_k, None, "c51 draws no positive");

    for name in "seconds frames replay_ratio c51_kl total_loss waiting".split(' ') {
        let has_value = run.column(name).iter().any(|cell| !cell.is_empty());
        assert!(has_value, "{name}");
    }
    for role in ["replay-server", "learner", "actor-0"] {
        let log = run.log(role);
        let is_sound = !log.contains("panicked") && !log.contains("driml_");
        assert!(log.contains("INFO") && is_sound, "{role}:\n{log}");
    }
    let mut lines = ended.stderr.lines();
    let warned = lines.find(|it| it.contains(" WARN ") || it.contains(" ERROR "));
    assert_eq!(warned, None, "an orderly run warns of nothing");
    ended
        .expect_stdout("trains      c51 on chain, seed 1")
        .expect_stdout("finished: 1280 frames and 540 updates");
    assert_eq!(system.running_processes(), []);
    let names = system.file_names("run").into_iter();
    let events = names.filter(|name| name.contains("tfevents"));
    assert_eq!(events.count(), 0, "there are none without the flag");
    let config = system.read("run/config.toml");
    check_has(&config, &["\n# Written by driml 0.1.0 ("]);
    // The run's `config.toml` repeats the run. Processes race, so the weights differ; the counts do not.
    let again = system.train("--config run", "again");
    assert_eq!(system.run_folder("again").config(), run.config());
    let counts = |it: &Summary| (it.frames, it.updates, it.replay.rows_sampled);
    assert_eq!(counts(&again), counts(&summary));
}

#[test]
fn clipped_returns_and_a_loss_that_is_stuck_are_warned_of_once() {
    let system = system();
    let narrow = "model.v_min=-0.05 --set model.v_max=0.05";
    let wider = "--set model.v_min=-0.2 --set model.v_max=0.2";
    let stuck = "such as --set learner.update.tanh_clip=";
    for (agent, set, words, warnings) in [
        ("c51", narrow, wider, 1),
        ("driml-ada", "learner.update.tanh_clip=0.00001", stuck, 1),
        ("driml-ada", "learner.update.tanh_clip=1000", stuck, 0),
    ] {
        let call = format!("local --lockstep --agent {agent} {SHORT} --set {set}");
        let ended = system.run_ok(&call);
        let found = ended.stderr.matches(words).count();
        assert_eq!(found, warnings, "{set}: {ended:#?}");
    }
}

#[test]
fn driml_ada_with_two_actors_over_tcp() {
    let (endpoint, _) = listen_on_free_port();
    let system = system().with_endpoint(endpoint);
    // Pause the learner, so that the run does not end before its second actor plays.
    system.pause_learners_at(500);
    let longer = chain(2_560);
    // The alphabet maps all actions to one, so the learner's affinity A is 1 everywhere and k reaches its maximum. Without the learner's A,
    // the replay server uses A = 1/3 everywhere, and the mean of k is at most 1 + 1/3 + .. + 1/81.
    let alphabet = "--set learner.affinity.alphabet=visible --set learner.affinity.visible=[0,0,0]";
    let flags = format!("--agent driml-ada {alphabet} {longer} --actors 2");
    let process = system.start(&system.local_args(&flags));
    system
        .connect()
        .wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    system.release_learners();
    process.wait_ok();
    let run = system.run_folder("run");
    let summary = run.check_finished();
    assert_eq!(summary.replay_ratio, Some(8.0));
    let mean_k = summary.mean_k.expect("driml-ada draws positives");
    assert!(mean_k > 3.0, "{mean_k}");
    for role in ["actor-0", "actor-1"] {
        let log = run.log(role);
        check_has(&log, &["leaves: "]);
        assert!(!log.contains("leaves: 0 "), "{log}");
    }
    // The learner sends an affinity after each update; the replay server reports the version that it uses.
    let affinity = run.table("metrics.csv").last::<u64>("affinity_version");
    assert!(affinity > Some(0), "it reached the replay server");
}

/// With `driml local --listen`, actors of other machines play in the same run, and other processes watch it.
fn plays_with_an_actor_from_elsewhere(system: &TestSystem) {
    let run = system.start(&system.local_args(&format!("--agent c51 {LONG}")));
    let mut outside = system.start_actor(2);
    outside.wait_for_stderr("actor 2 steps 4 environments");
    let client = system.connect();
    client.wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    // An observer receives everything that is recorded, including episodes.
    let watched = system.start(&system.connect_args("watch --run-dir seen"));
    let both = BTreeSet::from([0_u32, 2]);
    let has_both = |folder| {
        let actors = system.run_folder(folder).episode_column("actor");
        actors.into_iter().flatten().collect::<BTreeSet<_>>() == both
    };
    wait_until("episodes of both actors", || {
        has_both("run") && has_both("seen")
    });
    watched.interrupt().expect_code(130);
    outside.stop(130).expect_stderr("actor 2 leaves: ");
    drop(client);
    run.interrupt().expect_code(130);
    system.run_folder("run").check(Outcome::Interrupted);
    assert!(has_both("run"));
}

#[test]
fn an_actor_from_elsewhere_plays_in_a_launched_run() {
    let (endpoint, _) = listen_on_free_port();
    plays_with_an_actor_from_elsewhere(&system().with_endpoint(endpoint));
}

/// The run's own processes connect through a unix socket.
#[test]
fn an_actor_from_elsewhere_plays_over_tls() {
    if let Some(system) = tls_system() {
        plays_with_an_actor_from_elsewhere(&system);
    }
}

/// The replay server serves the positives that an agent's loss needs and no more: five a row for `cpc`, none for `curl`. Anchors and
/// positives stay paired through actor, server, wire and learner: the trained model tells a row's positive from those of other rows. With the
/// positives of other rows, the loss cannot fall below ln B, where it begins. The checkpoints of all can be evaluated.
#[test]
fn agents_get_the_positives_that_they_need_and_tell_them_from_other_rows() {
    let system = system();
    // Measured over five seeds: 2.2 to 2.4 for `driml-fix` and 2.7 to 2.8 for `curl`; with the positives of other rows 4.0 to 4.1. ln B is
    // 4.16. Five steps ahead, most of the chain's episodes have ended, and few rows are left for `cpc` to tell apart.
    let told_apart = 0.75 * 64f64.ln();
    for (agent, rows, served, loss, loss_max) in [
        ("cpc", 16, Some(5), "cpc_4t4", f64::INFINITY),
        ("curl", 64, Some(0), "curl", told_apart),
        ("driml-fix", 64, None, "dim_4t4", told_apart),
    ] {
        let ratio = SHORT.replace("replay_ratio=8", &format!("replay_ratio={}", rows / 2));
        let flags = format!("--agent {agent} {ratio} --set learner.batch_size={rows}");
        let summary = system.train(&flags, agent);
        assert_eq!((summary.frames, summary.updates), (1280, 540), "{agent}");
        // The histogram counts rows by their largest k: each k up to 5 is served where the episode is long enough.
        let counts = &summary.replay.k_histogram;
        let is_needed = |served: usize| counts.len() == served + 1 && !counts.contains(&0);
        assert!(served.is_none_or(is_needed), "{agent}: {counts:?}");
        let metrics = system.run_folder(agent).table("metrics.csv");
        let last: f64 = metrics.last(loss).unwrap();
        assert!(last > 0.0 && last < loss_max, "{agent}: {last}");
        let ended = system.run_ok(&format!("evaluate {agent} --episodes 3"));
        ended.expect_stdout(agent);
    }
}
