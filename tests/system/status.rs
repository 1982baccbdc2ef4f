//! `driml status`: its output for a run in which a process is missing, gone, suspended or done.
//! The messages that processes log while they wait are tested here, too.

use driml_protocol::Leave;
use driml_tests::{Process, TestSystem, check_has, wait_for, wait_until};
use nix::sys::signal::Signal;

use crate::{
    LONG, SHORT,
    refusals::{Row, check_replies},
    system,
};

/// Returns the page of `driml status` as one line, because words stand where its lines are broken.
pub(crate) fn status_text(system: &TestSystem) -> String {
    let ended = system.run(&system.connect_args("status"));
    let page = ended.expect_stdout("\nprocess ").stdout;
    page.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Requests the status until it contains all of `words`.
pub(crate) fn wait_for_status(system: &TestSystem, words: &[&str]) -> String {
    wait_for(&format!("{words:?} in the status"), || {
        let text = status_text(system);
        words.iter().all(|it| text.contains(it)).then_some(text)
    })
}

#[test]
fn missing_processes_are_named_with_what_to_do() {
    let system = system();
    let endpoint = system.endpoint();
    let mut server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let client = system.connect();
    let learn =
        format!("no learner has joined: start `driml learner --connect {endpoint} --run-dir DIR`");
    let act = format!("no actor has joined: start `driml actor --connect {endpoint} --id N`");
    let words = ["chain, c51: frames 0/", &learn, &act];
    check_has(&status_text(&system), &words);
    // The server also logs this itself.
    server.wait_for_stderr("no learner has joined yet; waiting for");

    let twice = format!("status --connect {endpoint}");
    let words = "are both shard 0: give each endpoint once";
    system.rejects(&system.connect_args(&twice), words);
    let second = format!("replay-server {SHORT} --listen {endpoint}-2");
    system.rejects(&system.connect_args(&second), "another replay server of");

    let mut learner = system.start_learner("run");
    wait_for_status(&system, &["learner up ", "warm-up 0/", &act]);
    // After 10 s, or later if the machine stalls.
    learner.wait_for_stderr(" s: warm-up 0/");
    check_has(&learner.stderr(), &["waiting for a batch for "]);
    server.wait_for_stderr("no actor has joined yet; waiting for");

    let [_stays, leaves] = [0, 5].map(|id| system.start_actor(id));
    let words = ["actor-0 ", "actor-5 ", "learns (", "nothing is missing"];
    wait_for_status(&system, &words);
    // An actor that is stopped is not missing, and one that is killed is.
    client.wait_for_replay("both actors", |it| it.actors_acting == 2);
    leaves.stop(130);
    wait_until("a status without it", || {
        let text = status_text(&system);
        text.contains("nothing is missing") && !text.contains("actor-5")
    });
    // An actor whose delivery failed counts a transition that is not stored.
    client.join_as_actor(6, 1);
    check_replies(&client, [Row::of(&client, &Leave::new(6, 1, 1), "Ack")]);
    wait_for_status(&system, &["actor-6 DOWN "]);
    let killed = system.start_actor(5);
    wait_for_status(&system, &["actor-5 up "]);
    killed.signal(Signal::SIGKILL);
    client.wait_for_replay("one actor", |it| it.actors == 1);
    let again = format!("`driml actor --connect {endpoint} --id 5`");
    let words = ["actor-5 DOWN ", "the run continues without it", &again];
    wait_for_status(&system, &words);
    learner.signal(Signal::SIGKILL);
    let words = ["learner DOWN ", "from its newest checkpoint"];
    wait_for_status(&system, &words);

    let answer = system.run(&system.connect_args("status --json")).json();
    let processes = &answer["servers"][0]["processes"]["processes"];
    assert_eq!(processes[0]["who"], "Learner");
    assert_eq!(processes[0]["connected"], false);
    assert_eq!(processes[2]["who"]["Actor"], 5);
    assert_eq!(answer["actions_needed"].as_array().unwrap().len(), 3);

    // A suspended server is reported within seconds, too.
    server.signal(Signal::SIGSTOP);
    let ended = system.run(&system.connect_args("status"));
    server.signal(Signal::SIGCONT);
    ended.expect_code(1).expect_stderr("endpoint");
}

#[test]
fn an_actor_that_is_stopped_before_its_first_chunk_is_not_missing() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let mut actor = system.start_actor(0);
    actor.wait_for_stderr("waiting for the learner's first weights");
    wait_for_status(&system, &["actor-0 up "]);
    actor.stop(130);
    wait_until("a status without it", || {
        !status_text(&system).contains("actor-0")
    });
}

#[test]
fn a_run_folder_is_asked_while_it_is_alive_and_read_afterwards() {
    let system = system();
    let run = format!("local --agent c51 {LONG} --actors 2 --durable --run-dir run");
    let process = system.start(&run);
    wait_until("a status of the living run", || {
        let ended = system.run("status run");
        ended.code == Some(0) && ended.stdout.contains("learns")
    });
    let early = system.start("status run --watch --json");
    wait_until("its first answer", || !early.stdout().is_empty());
    // A launcher that is stopped does not restart its server.
    process.signal(Signal::SIGSTOP);
    system.find_process("replay-server").signal(Signal::SIGKILL);
    let last_has = |watched: &Process, words: &str| {
        let stdout = watched.stdout();
        let last = stdout.lines().next_back();
        last.is_some_and(|it| it.contains(words))
    };
    let late = system.start("status run --watch --json");
    for watched in [&early, &late] {
        wait_until("its end", || last_has(watched, "no replay server listens"));
    }
    process.signal(Signal::SIGCONT);
    for watched in [&early, &late] {
        wait_until("the next server", || last_has(watched, "\"healthy\":true"));
    }
    process.interrupt().expect_code(130);
    for watched in [early, late] {
        watched.wait_ok();
    }
    system
        .fails("status run --prometheus run.prom", "the run is not healthy")
        .expect_stdout("no process runs in run, which holds")
        .expect_stdout("`driml train --resume run` resumes it");
    let file = system.read("run.prom");
    assert!(file.ends_with("\ndriml_up 0\n"), "{file}");
    system.rejects("status nowhere", "nowhere is not the folder of a run");
}

/// The launcher still plays the last checkpoint; no other process is left.
#[test]
fn a_run_that_is_ending_is_no_riddle() {
    let system = system();
    let mut process = system.start(&format!(
        "local --agent c51 {SHORT} --eval-interval 1000 --eval-episodes 1000000 --run-dir run"
    ));
    process.wait_for_stderr("playing the last checkpoint");
    let config = system.read("run/config.toml");
    check_has(&config, &["checkpoint_period_updates = 50"]);
    system
        .run_ok("status run")
        .expect_stdout("the run in run is stopping: all frames are stored");
    let stopping = system.run_json("status --json run");
    assert_eq!(stopping["finished"], false, "{stopping}");
    process.interrupt().expect_code(0);
    system.run_ok("status run").expect_stdout("the run is over");
    let over = system.run_json("status --json run");
    assert_eq!(over["finished"], true);
    assert_eq!(over["message"], "the run is over");
    assert_eq!(over["summary"]["outcome"], "finished", "{over}");
}
