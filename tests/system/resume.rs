//! Resuming runs that ended by Ctrl-C or by the death of all their processes; and runs that cannot be resumed.

use std::fs;

use driml_tests::{Outcome, Summary, TestSystem, check_has};

use crate::{SHORT, start_run, system};

/// The updates of a resumed run: more than the 256 transitions of slack, a chunk in flight and one that refills the replay can allow.
const MORE_UPDATES: u64 = 200;

/// Resumes `run` for [`MORE_UPDATES`] updates, and checks what the run leaves behind.
fn resume_and_check(system: &TestSystem) -> Summary {
    let run = system.run_folder("run");
    let updates = run.saved_updates();
    // The warm-up, and 2 frames for each update of 16 rows at replay ratio 8.
    let frames = 200 + 2 * (updates + MORE_UPDATES);
    let ended = system.run_ok(&format!("local --resume run --frames {frames}"));
    let from = format!("from its checkpoint after {updates} updates");
    ended.expect_stdout(&from);
    let summary = run.check_finished();
    assert_eq!(summary.resumed_after_updates, updates);
    // The last chunk is stored whole, which allows up to 16 updates more.
    let planned = updates + MORE_UPDATES..updates + MORE_UPDATES + 16;
    assert!(planned.contains(&summary.updates), "{summary:#?}");
    assert!(summary.episodes > 0);

    for name in ["seconds", "frames", "updates", "episodes"] {
        let numbers = run.numeric_column(name);
        assert!(numbers.is_sorted(), "{name}: {numbers:?}");
    }
    let log = run.log("learner");
    check_has(&log, &[&format!("resumed after {updates} updates")]);
    let starts = log.matches("learning on cpu").count();
    assert!(starts >= 2, "{log}");
    summary
}

#[test]
fn an_interrupt_saves_and_ends_all_processes_and_the_run_continues() {
    let system = system();
    // 1,000 updates are 2,200 frames, in which more than 100 episodes end.
    let process = start_run(&system, 1_000);
    system.rejects("local --resume run", "is still running");
    process
        .interrupt()
        .expect_code(130)
        .expect_stderr("stopping: actors deliver what they have")
        .expect_stderr("`driml train --resume run` resumes it")
        .expect_stdout("interrupted: ");
    assert_eq!(system.running_processes(), []);
    let before = system.run_folder("run").check(Outcome::Interrupted);
    assert!(before.updates > 1_000, "{before:#?}");
    let summary = resume_and_check(&system);
    // A few tens of episodes have ended since, the short ones first. The mean return is still that of 100 episodes.
    let since = summary.episodes - before.episodes;
    assert!((1..100).contains(&since), "{since} episodes since");
    assert_eq!((before.mean_return_of, summary.mean_return_of), (100, 100));
    // A finished run can be resumed with more frames.
    assert_eq!(resume_and_check(&system).mean_return_of, 100);
    system
        .run_ok("local --resume run")
        .expect_stdout("nothing is left to do");
}

#[test]
fn a_run_whose_processes_were_all_killed_continues() {
    let system = system();
    let process = start_run(&system, 200);
    system.kill_all();
    process.wait();
    resume_and_check(&system);
}

#[test]
fn what_cannot_be_resumed() {
    let system = system();
    let run = format!("local --agent c51 {SHORT} --run-dir run");
    system.run_ok(&run);
    let set = "--set learner.batch_size=32";
    let unused = ", so the changed settings have no effect";
    for flags in ["", "--frames 700", "--frames 7", set] {
        let effect = if flags == set { unused } else { "" };
        let ended = system.run_ok(&format!("local --resume run {flags}"));
        let nothing = "nothing is left to do: the run in run has done 540 updates and 1280 frames";
        ended.expect_stdout(&format!("{nothing}{effect}.\n"));
    }
    system.run_ok(&format!("local --lockstep {SHORT} --run-dir step"));
    let rainbow = "--env chain --preset smoke --agent rainbow --frames 640";
    system.run_ok(&format!("local --lockstep {rainbow} --run-dir rainbow"));
    system.run_ok("local --resume step --frames 1600 --set learner.batch_size=32");
    let run = format!("local --agent c51 --durable {SHORT} --run-dir kept");
    system.run_ok(&run);
    system.rejects(
        "local --resume kept --frames 2000 --set replay.shards=2 --set local.actors=2",
        "replay.shards = 2, but kept/replay holds the transitions of 1 shard: resume",
    );
    system.run_ok("local --resume kept --frames 1600 --set local.durable=false");
    system.rejects_each(
        "
        local --resume run --frames 2000 --set run.n_step=5 => run.n_step cannot change in a run: resume without this --set
        local --resume run --frames 2000 --set world.reward_right=2 => world.reward_right cannot change in a run: resume without this --set
        local --resume run --frames 2000 --set model.atoms=31 => was saved with model.atoms = 51
        local --resume run --frames 2000 --set replay.disk_bytes_max=100000000 => only in memory; add --durable
        local --resume step --frames 2000 --set local.actors=3 => but this run in lockstep has 1
        local --resume rainbow --frames 1280 --set replay.sampling.alpha=0 => replay.sampling.alpha = 0, but the replay that is kept has its priorities to the power of 0.5
        local --resume kept --frames 2000 --durable => lacks what the run stored later
        ",
    );
    // The rejected calls have changed nothing.
    for run in ["run", "step", "kept", "rainbow"] {
        system.run_ok(&format!("evaluate {run} --episodes 2"));
        system.run_ok(&format!("local --resume {run} --frames 2000"));
    }
    // A new run with the settings of a resumed run does not take over the pace since its resume.
    let since = |run: &str| {
        let config = system.run_folder(run).config();
        config["replay"].get("since").is_some()
    };
    system.run_ok("local --lockstep --config step/config.toml --run-dir new");
    assert!(since("step") && !since("new"));
    fs::remove_dir_all(system.path("run/checkpoints")).unwrap();
    let resume = "local --resume run --frames 3000";
    system.rejects(resume, "there is no checkpoint");
    let others = system.path("rainbow/checkpoints");
    fs::rename(others, system.path("run/checkpoints")).unwrap();
    system.rejects(resume, "belongs to a run with specification");
}

/// The launcher was killed after the last update: only the end of the run is missing, and the shards no longer hold anything.
#[test]
fn a_run_cut_off_at_its_end_is_finished() {
    let system = system();
    for shards in [1, 2] {
        let dir = format!("run-{shards}");
        let run = format!(
            "--agent c51 {SHORT} --actors {shards} --replay-shards {shards} --run-dir {dir}"
        );
        system.run_ok(&format!("local {run}"));
        let path = format!("{dir}/summary.json");
        let failed = system.read(&path).replace(": \"finished\"", ": \"failed\"");
        fs::write(system.path(&path), failed).unwrap();
        let run = system.run_folder(&dir);
        let before = run.summary().updates;
        system.run_ok(&format!("local --resume {dir}"));
        let summary = run.summary();
        assert_eq!(summary.outcome, Outcome::Finished);
        // The last chunk of 32 is stored whole, which allows up to 16 updates more.
        let planned = before..before + 16;
        assert!(planned.contains(&summary.updates), "{summary:#?}");
    }
}

#[test]
fn a_damaged_checkpoint_is_reported_once() {
    let system = system();
    system.run_ok(&format!("local --agent c51 {SHORT} --run-dir run"));
    let newest = system.run_folder("run").newest_checkpoint();
    fs::write(newest.join("online.safetensors"), "").unwrap();
    let resumed = system.run("local --resume run --frames 2000");
    let ended = resumed.expect_code(1);
    let stderr = &ended.stderr;
    let reports = stderr.matches("online.safetensors is damaged").count();
    assert_eq!(reports, 1, "{stderr}");
    assert!(!stderr.contains("resumes it"), "{stderr}");
}
