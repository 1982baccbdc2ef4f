//! `driml evaluate`: its output and films, and its errors for unusable checkpoints.
//! Whether an agent learns is tested in `lockstep`.

use std::fs;

use driml_launch::evaluator::SELECTION_SEED;
use driml_tests::{Outcome, TestSystem, check_has, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

use crate::{SHORT, system};

/// Creates a system with a finished run in the folder `run`.
fn with_run(flags: &str) -> TestSystem {
    let system = system();
    let run = format!("{SHORT} --agent driml-fix {flags} --run-dir run");
    system.run_ok(&format!("local --lockstep {run}"));
    system
}

/// All checks share one run, which the last check damages.
#[test]
fn a_run_is_evaluated() {
    let system = with_run("");
    the_agent_is_printed_beside_a_random_policy_for_people_and_for_programs(&system);
    an_evaluation_is_kept_by_hand_and_fewer_episodes_do_not_displace_it(&system);
    damaged_checkpoints_and_those_of_another_run_are_named(&system);
}

fn the_agent_is_printed_beside_a_random_policy_for_people_and_for_programs(system: &TestSystem) {
    let flags = "evaluate run --episodes 7 --seed 2";
    let stdout = system.run_ok(flags).stdout;
    let lines: Vec<_> = stdout.lines().collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    let head = "chain as trained on, 7 episodes each, online f32 weights after 540 updates played in f32, seed 2";
    assert_eq!(lines[0], head);
    // The same seed plays the same episodes.
    let json = system.run_json(&format!("{flags} --json --returns returns.csv"));
    assert_eq!(json["world"], "chain");
    assert_eq!(json["updates"], 540);
    let table = system.read("returns.csv");
    for (line, policy) in lines[1..].iter().zip(["driml-fix", "random"]) {
        let mean = json["policies"][policy]["mean_return"].as_f64().unwrap();
        let told = format!("{policy:12} mean return {mean:8.3}");
        let is_told = line.starts_with(&told) && line.contains("standard deviation");
        assert!(is_told, "{told}: {line}");
        let rows = table
            .lines()
            .filter_map(|row| row.strip_prefix(&format!("{policy},")));
        let returns: Vec<f64> = rows
            .map(|row| row.split_once(',').unwrap().1.parse().unwrap())
            .collect();
        assert_eq!(returns.len(), 7);
        // The table has six decimals.
        assert!((returns.iter().sum::<f64>() / 7.0 - mean).abs() < 1e-6);
    }
    // The chain world has no levels to hold out. A call that fails leaves existing files unchanged.
    let call = "evaluate run --levels unseen --returns returns.csv";
    system.rejects(call, "use --levels train");
    assert_eq!(system.read("returns.csv"), table);

    // Any existing checkpoint can be played.
    let (oldest, _) = system.run_folder("run").checkpoints()[0];
    assert!(oldest < 540);
    system
        .run_ok(&format!("evaluate run --episodes 2 --checkpoint {oldest}"))
        .expect_stdout(&format!("weights after {oldest} updates"));
}

/// By default an evaluation plays the weights that the run's actors receive, rounded to the actors' precision.
#[test]
fn averaged_weights_are_played_where_a_run_has_them_and_without_their_run() {
    let bf16 = "--set learner.publish_dtype=bf16 --set actor.precision=bf16";
    let system = with_run(&format!("--set learner.update.average_tau=0.01 {bf16}"));
    system.run_ok("evaluate run --keep --episodes 2");
    for (flags, weights, precision) in [
        ("", "averaged", "bf16"),
        ("--exact", "averaged", "f32"),
        ("--checkpoint newest", "averaged", "bf16"),
        ("--checkpoint best", "averaged", "bf16"),
        ("--weights average", "averaged", "bf16"),
        ("--weights online", "online", "bf16"),
    ] {
        let json = system.run_json(&format!("evaluate run --episodes 2 --json {flags}"));
        assert_eq!(json["averaged"], weights == "averaged", "{flags}");
        assert_eq!([&json["weights"], &json["arithmetic"]], [precision; 2]);
    }
    let words = "averaged bf16 weights after 540 updates played in bf16";
    let played = system.run_ok("evaluate run --episodes 2");
    played.expect_stdout(words);
    system
        .run_ok("evaluate run --export net.safetensors")
        .expect_stdout("averaged weights after 540 updates as f16");
    let run = system.run_ok("evaluate run --episodes 3 --exact");
    fs::rename(system.path("run"), system.path("moved")).unwrap();
    let net = system.run_ok("evaluate net.safetensors --episodes 3 --record play.gif --overlay");
    let lines: Vec<_> = net.stdout.lines().collect();
    check_has(lines[0], &["averaged f16 weights after 540 updates"]);
    // The last line is of the random policy.
    assert_eq!(lines.last(), run.stdout.lines().last().as_ref());
    let newest = system.run_folder("moved").newest_checkpoint();
    let online = newest.join("online.safetensors").display().to_string();
    system.rejects_each(&format!(
        "
        evaluate net.safetensors --keep => is a single network
        evaluate net.safetensors --weights online => is a single network
        evaluate net.safetensors --checkpoint best => is a single network
        evaluate none.safetensors => reading none.safetensors: No such file
        evaluate {online} => is not an exported network
        evaluate pretrained:pong => no pretrained weights of \"pong\"
        evaluate moved --export net => ends in .safetensors
        evaluate moved --checkpoint average => leave --checkpoint out
        evaluate moved --checkpoint 7 => no checkpoint after 7 updates; it has those after
        "
    ));
}

#[test]
fn a_finished_run_says_what_its_weights_earn() {
    let system = system();
    let summary_of = |name| serde_json::to_value(system.run_folder(name).summary()).unwrap();
    // In the last of these worlds no episode ends before the interrupt.
    let endless = "--env ising --preset smoke --frames 320 --set world.episode_steps=100000000";
    for (name, flags, play) in [
        ("played", SHORT, "--set local.play=true"),
        ("left-out", SHORT, "--no-play"),
        ("skipped", endless, "--set local.play=true"),
    ] {
        let call = format!("local --agent c51 {flags} {play} --run-dir {name}");
        let mut process = system.start(&call);
        if name == "skipped" {
            process.wait_for_stderr("playing the weights beside a random policy");
            process.signal(Signal::SIGINT);
        }
        let ended = process.wait_ok();
        assert!(!ended.stderr.contains("its weights failed"), "{ended:#?}");
        let is_said = ended.stdout.contains("Greedy return (online weights): ");
        let summary = summary_of(name);
        let found = (is_said, summary["played"].is_object());
        let is_played = name == "played";
        assert_eq!(found, (is_played, is_played), "{ended:#?}");
        assert_eq!(summary["outcome"], "finished");
    }
    let played = &summary_of("played")["played"];
    // Each batch of 20 episodes has its number as its seed.
    let batches = played["episodes"].as_u64().unwrap() / 20;
    assert!((1..=5).contains(&batches), "{played}");
    let evaluate = "evaluate played --episodes 20 --json --seed";
    let play = |seed| system.run_json(&format!("{evaluate} {seed}"));
    let again: Vec<_> = (0..batches).map(play).collect();
    for (policy, found) in [("c51", played), ("random", &played["random"])] {
        let [mean, low, high] = ["mean", "low", "high"].map(|it| found[it].as_f64().unwrap());
        let mean_of = |it: &Value| it["policies"][policy]["mean_return"].as_f64().unwrap();
        let wanted = again.iter().map(mean_of).sum::<f64>() / batches as f64;
        let is_mean = (mean - wanted).abs() < 1e-9 && low <= mean && mean <= high;
        assert!(is_mean, "{policy}: {wanted}, {played}");
    }
}

/// Plays checkpoints while a run of several processes, and one in lockstep, continue. The best checkpoint is kept.
#[test]
fn it_plays_checkpoints_while_the_run_continues() {
    let system = system();
    for (name, lockstep, rows_min) in [("processes", "", 1), ("lockstep", "--lockstep", 5)] {
        let flags = "--agent c51 --eval-interval 100 --eval-episodes 4";
        let ended = system.run_ok(&format!(
            "local {SHORT} {flags} {lockstep} --run-dir {name}"
        ));
        assert!(ended.stderr.contains("evaluated after"), "{}", ended.stderr);
        let folder = system.run_folder(name);
        let table = folder.table("evaluations.csv");
        let header = "seconds,frames,updates,episodes,evaluated_return,evaluated_return_sd";
        assert_eq!(table.header.join(","), header);
        // Before the first row of metrics the frames of the run are unknown.
        let rows = table.rows.iter().map(|row| {
            ["updates", "frames", "evaluated_return"]
                .map(|name| table.value::<f64>(row, name).unwrap_or_default())
        });
        let rows: Vec<_> = rows.collect();
        assert!(rows.len() >= rows_min, "{table:?}");
        let last = rows.last().unwrap();
        assert_eq!(last[0], 540.0, "the last checkpoint is played: {table:?}");
        let is_sorted = rows.is_sorted_by(|a, b| a[0] < b[0] && a[1] <= b[1]);
        assert!(is_sorted, "{table:?}");
        let most = rows.iter().map(|row| row[2]).fold(f64::MIN, f64::max);
        let best = rows.iter().find(|row| row[2] == most).unwrap();
        // Played again with the same seed, the best checkpoint gets the same return.
        let again = system.run_ok(&format!(
            "evaluate {name} --checkpoint best --episodes 4 --seed {SELECTION_SEED}"
        ));
        again
            .expect_stdout(&format!("weights after {} updates", best[0]))
            .expect_stdout(&format!("mean return {most:8.3}"));
        system.run_ok(&format!(
            "plot {name} --column evaluated_return --out {name}.svg"
        ));
    }
}

#[test]
fn an_evaluation_in_lockstep_neither_holds_up_a_run_nor_ends_it() {
    let system = system();
    let flags = "--agent c51 --eval-interval 100 --eval-episodes 1000000";
    let process = system.start(&format!("local --lockstep {SHORT} {flags} --run-dir run"));
    let run = system.run_folder("run");
    wait_until("a checkpoint", || !run.checkpoints().is_empty());
    process
        .interrupt()
        .expect_code(130)
        .expect_stderr("skipped an evaluation");
    fs::write(system.path("run/best"), "not a folder").unwrap();
    system
        .run_ok("local --resume run --set local.evaluation.episodes=2")
        .expect_stderr("the run continues without an evaluation: ");
    run.check_finished();
    // A file in place of the last checkpoint ends the run, which leaves its summary.
    let last = system.path("run/checkpoints/checkpoint-000000000860.tmp");
    fs::write(last, "").unwrap();
    system
        .fails("local --resume run --frames 1920", "000860.tmp")
        .expect_stderr("`driml train --resume run` resumes it");
    system.check_outcome(Outcome::Failed);
}

/// A checkpoint is compared with the best one over at least as many episodes as the best was played for.
fn an_evaluation_is_kept_by_hand_and_fewer_episodes_do_not_displace_it(system: &TestSystem) {
    let best = "evaluate run --checkpoint best";
    system.rejects(best, "run has no best checkpoint");
    let keep = |flags: &str| system.run_ok(&format!("evaluate run --keep {flags}"));
    keep("--episodes 3").expect_stdout("over 3 episodes, the best so far\n");
    system.run_ok("evaluate run --checkpoint best --episodes 1");
    let (updates, _) = system.run_folder("run").checkpoints()[0];
    keep(&format!("--episodes 1 --checkpoint {updates}"))
        .expect_stdout("; the best checkpoint stays, as its mean is over 3 episodes\n");
    // For a comparison over more episodes, the best checkpoint is played again.
    keep(&format!("--episodes 5 --checkpoint {updates}"));
    let table = system.run_folder("run").table("evaluations.csv");
    let count = |row, name| table.value::<u64>(row, name).unwrap();
    let rows = table.rows.iter();
    let rows: Vec<_> = rows
        .map(|row| (count(row, "updates"), count(row, "episodes")))
        .collect();
    assert_eq!(rows, [(540, 3), (updates, 1), (540, 5), (updates, 5)]);
}

#[test]
fn a_film_changes_nothing_that_is_played() {
    let system = system();
    system
        .run_ok("local --lockstep --env mspacman --agent driml-ada --preset smoke --frames 320 --run-dir run");
    let plain = system.run_ok("evaluate run --episodes 3");
    let film =
        "evaluate run --episodes 3 --record play.gif --overlay --record-steps 40 --record-envs 2";
    let filmed = system.run_ok(film);
    let mut lines: Vec<_> = filmed.stdout.lines().collect();
    assert_eq!(lines.remove(1), "filmed 40 steps: play.gif");
    assert_eq!(lines, plain.stdout.lines().collect::<Vec<_>>());
    let bytes = fs::read(system.path("play.gif")).unwrap();
    assert!(bytes.starts_with(b"GIF89a") && bytes.ends_with(b";"));
    system.run_ok(film);
    let again = fs::read(system.path("play.gif")).unwrap();
    assert!(bytes == again, "the same play is the same film");
    let unfinished = system.path("play.gif.tmp");
    assert!(!unfinished.exists());
    let process =
        system.start("evaluate run --episodes 1000000 --record play.gif --returns returns.csv");
    wait_until("a film that has begun", || unfinished.exists());
    process.interrupt().expect_code(130);
    assert!(!system.path("returns.csv").exists());
    assert!(!unfinished.exists());
    assert!(fs::read(system.path("play.gif")).unwrap() == bytes);
}

/// The learner's own tests check that damage to any file is found. Without a checkpoint no film is begun.
fn damaged_checkpoints_and_those_of_another_run_are_named(system: &TestSystem) {
    let newest = system.run_folder("run").newest_checkpoint();
    let name = newest.file_name().unwrap().to_str().unwrap();
    let path = newest.join("online.safetensors");
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let call = "evaluate run --episodes 1";
    let damaged = format!("error: run/checkpoints/{name}/online.safetensors is damaged: ");
    system
        .fails(call, &damaged)
        .expect_stderr("checkpoint before it, remove ");
    fs::write(&path, &whole).unwrap();
    let one = system.run_ok(call).stdout;
    assert!(one.contains("1 episode each") && !one.contains("deviation"));
    let one = &system.run_json(&format!("{call} --json"))["policies"]["driml-fix"];
    assert!(one["mean_return"].is_f64() && one["standard_deviation"].is_null());

    let text = system.read("run/config.toml");
    let other = text.replace("seed = 1", "seed = 2");
    fs::write(system.path("run/config.toml"), other).unwrap();
    system
        .fails(call, "belongs to a run with specification")
        .expect_stderr("resume with the settings it was made with");
    fs::remove_dir_all(system.path("run/checkpoints")).unwrap();
    system.rejects(call, "has no checkpoint yet");
    system.rejects("evaluate run --record play.gif", "has no checkpoint yet");
    assert!(!system.file_names(".").iter().any(|it| it.contains("play")));
}
