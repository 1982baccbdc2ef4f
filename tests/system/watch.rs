//! `driml watch`: shows and records runs that others have started, without disturbing them.
//! `driml status` is tested in `status`.

use std::collections::BTreeSet;

use driml_launch::{metrics::COLUMNS, run_folder::RunFolder};
use driml_tests::{
    python::{find_python, run_script},
    wait_until,
};
use nix::sys::signal::Signal;

use crate::{LONG, SHORT, start_run, system};

#[test]
fn a_run_of_processes_by_hand_leaves_the_folder_of_a_launched_one() {
    let system = system();
    let flags = "--agent driml-ada --actors 2";
    let server = format!("replay-server {flags} {SHORT}");
    let server = system.start_process(&system.listen_args(&server));
    let client = system.connect();
    let watch = system.start(&system.connect_args("watch --run-dir run --tensorboard"));
    wait_until("the folder", || system.path("run/metrics.csv").exists());
    // Pause the learner until both actors have played: an actor that starts late would play hardly an episode.
    system.pause_learners_at(100);
    let actors = [system.start_actor(0), system.start_actor(1)];
    client.wait_for_replay("both actors", |replay| replay.actors == 2);
    // The learner writes into the same folder, which is then as complete as that of a launched run.
    let learner = system.start_process(&system.connect_args("learner --run-dir run"));
    client.wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    system.release_learners();
    watch
        .wait_ok()
        .expect_stdout("finished: 1280 frames and 540 updates");
    drop(client);
    for process in actors.into_iter().chain([learner, server]) {
        process.wait_ok();
    }
    let watched = system.run_folder("run");
    let summary = watched.check_finished();
    assert_eq!((summary.frames, summary.updates), (1280, 540));
    // Check who played each episode, and that each was seen completely: frames outside these episodes are of episodes still being played.
    let column = |name| watched.episode_column::<u64>(name);
    let who: BTreeSet<_> = column("actor").into_iter().zip(column("env")).collect();
    let expected = (0..2).flat_map(|actor| (0..4).map(move |env| (Some(actor), Some(env))));
    assert_eq!(who, expected.collect());
    let played: u64 = column("length").into_iter().map(Option::unwrap).sum();
    // Each of the 8 environments plays an episode of at most 30 steps when the run ends.
    assert!((1280 - 8 * 30..=1280).contains(&played), "{played}");
    let seconds = watched.episode_column::<f64>("seconds");
    assert!(seconds.iter().all(Option::is_some));

    // The columns are those of a launched run with these settings.
    system.run_ok(&format!("local {flags} {SHORT} --run-dir launched"));
    let header = watched.table("metrics.csv").header;
    let launched = system.run_folder("launched").table("metrics.csv");
    assert_eq!(header, launched.header);
    assert_eq!(watched.column("rss_mib_learner").pop().unwrap(), "");
    system.run_ok("plot run launched --out plot.svg");
    let names = system.file_names("run");
    assert!(names.iter().any(|name| name.contains("tfevents")));
}

#[test]
fn a_launched_run_is_watched_and_continues_without() {
    let system = system();
    let launcher = start_run(&system, 1);
    let mut watched = system.start("watch run --run-dir seen");
    let seen = system.run_folder("seen");
    let rows = || seen.table("metrics.csv").rows.len();
    wait_until("two rows", || rows() >= 2);
    watched.signal(Signal::SIGINT);
    watched.wait_for_stderr("the run continues without being watched");
    watched.wait().expect_code(130);
    let before = rows();
    assert!(!system.path("seen/summary.json").exists());

    // No other process may write where the launcher writes, and a folder holds only one run.
    system.run_ok(&format!("local --agent c51 {SHORT} --run-dir other"));
    system.rejects_each(
        "
        watch other --run-dir late => nothing is written into late: the run is over
        watch run --run-dir run => run is written by `driml train` or by another `driml watch`
        watch run --run-dir other => other holds another run (chain with c51, seed 1)
        ",
    );

    let watched = system.start("watch run --run-dir seen");
    wait_until("further rows", || rows() > before + 1);
    launcher.interrupt().expect_code(130);
    watched.wait_ok().expect_stdout("--resume run` resumes it");
    let plot = system.run_ok("plot run other run/config.toml --column dim_4t4");
    plot.expect_stderr("other is not in the chart of dim_4t4")
        .expect_stderr("skipped run/config.toml: not the folder of a run");
    system.rejects("plot other --affinity", "other has no affinity");
    let frames = seen.numeric_column("frames");
    assert!(frames.is_sorted(), "{frames:?}");
}

/// A watch asks once a second, so that it often misses the last answers.
#[test]
fn a_run_that_ends_between_two_requests_leaves_its_summary() {
    let system = system();
    system.pause_learners_at(100);
    let flags = "--agent c51 --set learner.unreachable_max_ms=9000";
    let launcher = system.start(&system.local_args(&format!("{flags} {SHORT}")));
    system.connect().wait_for_updates(0);
    let mut watched = system.start("watch run --run-dir seen");
    wait_until("the folder", || system.path("seen/metrics.csv").exists());
    watched.signal(Signal::SIGSTOP);
    system.release_learners();
    launcher.wait_ok();
    // As if the launcher still played the last checkpoint.
    let lock = RunFolder::new(system.path("run")).lock().unwrap();
    watched.signal(Signal::SIGCONT);
    watched.wait_for_stderr("replay server: no answer for ");
    drop(lock);
    let ended = watched.wait_ok().expect_stdout("the run is over");
    ended.expect_stderr("seen/metrics.csv lacks the run's last rows");
    let [whole, seen] = ["run", "seen"].map(|it| system.read(&format!("{it}/summary.json")));
    assert_eq!(seen, whole);
}

#[test]
fn a_run_ends_with_a_replay_server_that_kept_nothing_on_disk() {
    let system = system();
    let server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    drop(system.connect());
    let mut watched = system.start(&system.connect_args("watch"));
    watched.wait_for_stderr("no learner has joined yet");
    server.kill();
    watched.fails("has exited, and its replay was in memory: the run has ended");
}

#[test]
fn a_silent_process_is_named_and_a_restarted_server_found_again() {
    let system = system();
    let flags = format!("--replay-dir replay --agent c51 {LONG}");
    let server = system.start_replay_server(&flags);
    let client = system.connect();
    let mut watched = system.start(&system.connect_args("watch --run-dir seen"));
    watched.wait_for_stderr("no learner has joined yet; no actor has joined yet");
    let learner = system.start_learner("run");
    let _actor = system.start_actor(0);
    client.wait_for_updates(0);
    learner.signal(Signal::SIGSTOP);
    watched.wait_for_stderr("learner: no answer for ");
    learner.signal(Signal::SIGCONT);

    let before = client.replay_status().unwrap().transitions_inserted;
    drop(client);
    server.kill();
    watched.wait_for_stderr("replay server: no answer for ");
    let _server = system.start_replay_server(&flags);
    let metrics = || system.run_folder("seen").table("metrics.csv");
    wait_until("rows after the restart", || {
        metrics().last::<u64>("frames") > Some(before)
    });
    watched.interrupt().expect_code(130);
}

/// The fields of `status --json` beside the metrics, which deploy/docs/src/reference/run-folder.md describes.
const JSON_FIELDS: &str = "actors_planned agent finished frames_planned learner replay replay_ratio_planned run_spec seed servers actions_needed \
    updates_planned waiting_for healthy world";

#[test]
fn one_look_tells_scripts_and_monitors_how_a_run_is() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent driml-ada {SHORT}"));
    let client = system.connect();
    let status = system.connect_args("status");
    // A process is missing.
    system
        .fails(&status, "error: the run is not healthy")
        .expect_stdout("to do: no learner has joined: start");
    let _processes = [system.start_learner("run"), system.start_actor(0)];
    client.wait_for_the_last_update();
    client.wait_for_replay("the actor's absence", |replay| replay.actors == 0);

    let ended = system.run_ok(&format!("{status} --json --prometheus run.prom"));
    let json = ended.json();
    let names = json.as_object().unwrap().keys().map(String::as_str);
    let names: BTreeSet<_> = names.collect();
    let metrics = COLUMNS.iter().map(|it| it.name);
    let fields: BTreeSet<_> = metrics.chain(JSON_FIELDS.split(' ')).collect();
    assert_eq!(names, fields);
    assert_eq!(json["frames"], 1280);
    assert_eq!(json["updates"], 540);
    assert_eq!(json["healthy"], true);
    assert_eq!(json["finished"], true);
    assert_eq!(json["losses"].as_object().unwrap().len(), 1);
    system
        .run_ok(&status)
        .expect_stdout("the run is over: all updates are made and saved");
    // A watcher that records nothing does not know how long a resumed run took.
    system
        .run_ok(&system.connect_args("watch"))
        .expect_stdout("finished: 1280 frames and 540 updates, replay ratio");

    // Each sample has the labels of the run first.
    let endpoint = system.endpoint();
    let run = format!("world=\"chain\",agent=\"driml-ada\",seed=\"1\",endpoint={endpoint:?}");
    let text = system.read("run.prom").replace(&run, "");
    check_prometheus(&text);
    if let Some(python) = find_python(&["prometheus_client"]) {
        let read = "import sys; from prometheus_client.parser import text_string_to_metric_families as parse; \
             print([it for it in parse(open(sys.argv[1]).read()) if it.name == 'driml_updates'][0].samples[0].value)";
        let path = system.path("run.prom").display().to_string();
        assert_eq!(run_script(&python, &["-c", read], &[&path]), "540.0\n");
    }
    let value = |sample: &str| -> f64 {
        let start = format!("driml_{sample} ");
        let value = text.lines().find_map(|it| it.strip_prefix(&start));
        value.unwrap().parse().unwrap()
    };
    let counts = ["frames_total{}", "updates_total{}", "finished{}"].map(value);
    assert_eq!(counts, [1280.0, 540.0, 1.0]);
    // The JSON parser may be off by the last digit.
    let (found, mean) = (value("mean_return{}"), &json["mean_return"]);
    assert!((found - mean.as_f64().unwrap()).abs() < 1e-12, "{found}");
    let losses = ["c51_kl{}", "total_loss{}", "losses{,loss=\"dim_4t4\"}"].map(value);
    assert!(losses.iter().all(|&it| it > 0.0), "{losses:?}");
    assert_eq!(text.matches("process_connected{,").count(), 1, "{text}");
}

/// Checks Prometheus' text format: each family once, its help and type before its samples, and each sample once. The labels of the run are
/// cut out, and a sample has at most one other.
fn check_prometheus(text: &str) {
    let families = text.strip_prefix("# HELP ").unwrap().strip_suffix('\n');
    let mut seen = BTreeSet::new();
    for family in families.unwrap().split("\n# HELP ") {
        let mut lines = family.lines();
        let (name, _) = lines.next().unwrap().split_once(' ').unwrap();
        let kind = ["gauge", "counter"][usize::from(name.ends_with("_total"))];
        assert_eq!(lines.next(), Some(&*format!("# TYPE {name} {kind}")));
        let is_plain = |it: u8| matches!(it, b'a'..=b'z' | b'0'..=b'9' | b'_');
        assert!(name.bytes().all(is_plain) && seen.insert(name), "{name}");
        for line in lines {
            let (sample, value) = line.rsplit_once(' ').unwrap();
            let labels = sample.strip_prefix(name).unwrap();
            let is_one = |it: &str| it.ends_with("\"}") && it.matches("=\"").count() == 1;
            let is_sound = labels == "{}" || labels.strip_prefix("{,").is_some_and(is_one);
            assert!(is_sound && value.parse::<f64>().is_ok(), "{line}");
            assert!(seen.insert(sample), "{line} comes twice");
        }
    }
}
