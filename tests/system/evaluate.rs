//! `driml evaluate`: what it prints, and what it says of folders and checkpoints that cannot be used.
//! Whether an agent has learned is in `lockstep`.

use std::fs;

use driml_launch::evaluator::SELECTION_SEED;
use driml_tests::{TestSystem, updates_of, wait_for};

use crate::{SHORT, system};

/// A system with a run in `run`.
pub(crate) fn with_run() -> TestSystem {
    with_run_of("")
}

fn with_run_of(flags: &str) -> TestSystem {
    let system = system();
    let run = format!("{SHORT} --agent driml-fix {flags} --run-dir run");
    system.run_ok(&format!("local --lockstep {run}"));
    system
}

#[test]
fn it_prints_the_agent_beside_a_random_policy() {
    let system = with_run();
    let ended = system.run_ok("evaluate --run run --episodes 7 --seed 2");
    let lines: Vec<_> = ended.stdout.lines().collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    assert_eq!(
        lines[0],
        "chain as trained on, 7 episodes each, online f32 weights after 540 updates played in f32, seed 2"
    );
    for (line, policy) in lines[1..].iter().zip(["driml-fix", "random"]) {
        assert!(
            line.starts_with(policy) && line.contains("standard deviation"),
            "{line}"
        );
    }
    let again = system.run_ok("evaluate --run run --episodes 7 --seed 2");
    assert_eq!(
        ended.stdout, again.stdout,
        "the same seed plays the same episodes"
    );
    // The chain has no levels to hold back.
    system.refuses("evaluate --run run --levels unseen", "use --levels train");
}

#[test]
fn it_tells_programs_what_it_tells_people() {
    let system = with_run();
    let flags = "evaluate run --episodes 7 --seed 2";
    let lines = system.run_ok(flags).stdout;
    let ended = system.run_ok(&format!("{flags} --json --returns returns.csv"));
    let told: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(
        (&told["world"], &told["updates"]),
        (&"chain".into(), &540.into())
    );
    let table = fs::read_to_string(system.path("returns.csv")).unwrap();
    for policy in ["driml-fix", "random"] {
        let mean = told["policies"][policy]["mean_return"].as_f64().unwrap();
        assert!(
            lines.contains(&format!("{policy:12} mean return {mean:8.3}")),
            "{lines}"
        );
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
    system
        .run("evaluate run --returns none/returns.csv")
        .expect_code(1)
        .expect_said("--returns none/returns.csv");
}

#[test]
fn it_plays_any_checkpoint_that_is_there() {
    let system = with_run();
    let kept = system.run_folder("run").checkpoints();
    let oldest = updates_of(&kept[0]);
    assert!(oldest < 540);
    let ended = system.run_ok(&format!("evaluate run --episodes 2 --checkpoint {oldest}"));
    let said = format!("weights after {oldest} updates");
    ended.expect_printed(&said);
    system.refuses(
        "evaluate run --checkpoint 7",
        "no checkpoint after 7 updates; it has those after",
    );
}

/// A system with a run with averaged weights in `run`.
fn with_averages() -> TestSystem {
    with_run_of("--set learner.update.average_tau=0.01")
}

#[test]
fn it_plays_averaged_weights_where_a_run_has_them() {
    let system = with_averages();
    system.run_ok("evaluate run --keep --episodes 2");
    for (flags, weights) in [
        ("", "averaged"),
        ("--checkpoint newest", "averaged"),
        ("--checkpoint best", "averaged"),
        ("--weights average", "averaged"),
        ("--weights online", "online"),
    ] {
        let said = system.run_ok(&format!("evaluate run --episodes 2 {flags}"));
        said.expect_printed(&format!("{weights} f32 weights after 540 updates"));
        let json = system.run_ok(&format!("evaluate run --episodes 2 --json {flags}"));
        let told: serde_json::Value = serde_json::from_str(&json.stdout).unwrap();
        assert_eq!(told["averaged"], weights == "averaged");
    }
    system.refuses("evaluate run --checkpoint average", "leave it out");
}

#[test]
fn an_exported_network_is_played_without_its_run() {
    let system = with_averages();
    system
        .run_ok("evaluate run --export net.safetensors")
        .expect_printed("averaged weights after 540 updates as f16");
    let run = system.run_ok("evaluate run --episodes 3 --exact");
    fs::rename(system.path("run"), system.path("moved")).unwrap();
    let net = system.run_ok("evaluate net.safetensors --episodes 3 --record play.gif --overlay");
    let lines: Vec<_> = net.stdout.lines().collect();
    assert!(
        lines[0].contains("averaged f16 weights after 540 updates"),
        "{lines:?}"
    );
    assert_eq!(lines.last(), run.stdout.lines().last().as_ref());
    let online = system.run_folder("moved").newest_checkpoint();
    let online = online.join("online.safetensors").display().to_string();
    for (args, said) in [
        ("net.safetensors --keep", "is a single network"),
        ("net.safetensors --weights online", "is a single network"),
        ("net.safetensors --checkpoint best", "is a single network"),
        ("none.safetensors", "reading none.safetensors: No such file"),
        (&online, "is not an exported network"),
        ("pretrained:pong", "no pretrained weights of \"pong\""),
        ("moved --export net", "ends in .safetensors"),
    ] {
        system.refuses(&format!("evaluate {args}"), said);
    }
}

#[test]
fn a_finished_run_says_what_its_weights_earn() {
    let system = system();
    for (flags, is_played) in [("--set local.play=true", true), ("--no-play", false)] {
        let name = if is_played { "played" } else { "left-out" };
        let ended = system.run_ok(&format!(
            "local --agent c51 {SHORT} {flags} --run-dir {name}"
        ));
        let line = "Greedy return (online weights): ";
        assert_eq!(ended.stdout.contains(line), is_played, "{}", ended.stdout);
        let text = fs::read_to_string(system.path(name).join("summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
        let played = &summary["played"];
        assert_eq!(played.is_object(), is_played);
        if is_played {
            let number = |name: &str| played[name].as_f64().unwrap();
            assert!(number("low") <= number("mean") && number("mean") <= number("high"));
            let episodes = played["episodes"].as_u64().unwrap();
            assert!((20..=100).contains(&episodes), "{episodes}");
        }
    }
}

/// Checkpoints of a run of processes, and of one in lockstep, are played during the run; the best is kept.
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
        let table = fs::read_to_string(folder.path().join("evaluations.csv")).unwrap();
        let mut lines = table.lines();
        assert_eq!(
            lines.next(),
            Some("seconds,frames,updates,episodes,evaluated_return,evaluated_return_sd")
        );
        let rows: Vec<Vec<f64>> = lines
            .map(|row| {
                let cells = row.split(',');
                // Before the first row of metrics the run's seconds and frames are not known.
                let cells = cells.map(|it| if it.is_empty() { "0" } else { it });
                cells.map(|it| it.parse().unwrap()).collect()
            })
            .collect();
        assert!(rows.len() >= rows_min, "{table}");
        let last = rows.last().unwrap();
        assert_eq!(last[2], 540.0, "the last checkpoint is played: {table}");
        assert!(
            rows.is_sorted_by(|a, b| a[2] < b[2] && a[1] <= b[1]),
            "{table}"
        );
        let most = rows.iter().map(|row| row[4]).fold(f64::MIN, f64::max);
        let best = rows.iter().find(|row| row[4] == most).unwrap();
        // Played again with the same seed, the best earns the same.
        let again = system.run_ok(&format!(
            "evaluate {name} --checkpoint best --episodes 4 --seed {SELECTION_SEED}"
        ));
        again
            .expect_printed(&format!("weights after {} updates", best[2]))
            .expect_printed(&format!("mean return {most:8.3}"));
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
    wait_for("a checkpoint", || {
        let saved = fs::read_dir(system.path("run/checkpoints")).ok()?;
        let is_checkpoint = |it: fs::DirEntry| !it.path().ends_with(".lock");
        saved.flatten().any(is_checkpoint).then_some(())
    });
    process
        .interrupt()
        .expect_code(130)
        .expect_said("an evaluation was left out");
    fs::write(system.path("run/best"), "not a folder").unwrap();
    system
        .run_ok("local --resume run --set local.evaluation.episodes=2")
        .expect_said("the run continues without an evaluation: ");
    system.run_folder("run").check_finished();
}

#[test]
fn an_evaluation_can_be_kept_by_hand() {
    let system = with_run();
    system.refuses(
        "evaluate run --checkpoint best",
        "run has no best checkpoint",
    );
    let keep = "evaluate run --keep --episodes 3";
    system
        .run_ok(keep)
        .expect_printed("over 3 episodes, the most so far\n");
    system.run_ok("evaluate run --checkpoint best --episodes 1");
    // The episodes that choose are never those of a report.
    system.refuses(&format!("{keep} --seed 0"), "'--keep' cannot be used with");
    system.refuses(
        "evaluate run --checkpoint bset",
        "the updates of a checkpoint",
    );
    system.refuses(
        &format!("local {SHORT} --eval-interval 150 --set learner.checkpoint_period_updates=100"),
        "local.evaluation.every_updates = 150: checkpoints are played",
    );
}

/// A checkpoint is compared with the best over as many episodes as that was played for, or more.
#[test]
fn fewer_episodes_do_not_displace_the_best() {
    let system = with_run();
    let oldest = system.run_folder("run").checkpoints().remove(0);
    let updates = &updates_of(&oldest).to_string();
    let keep = |flags: &str| system.run_ok(&format!("evaluate run --keep {flags}"));
    let rows = || {
        let text = fs::read_to_string(system.path("run/evaluations.csv")).unwrap();
        let column = |row: &str, at: usize| row.split(',').nth(at).unwrap().to_owned();
        let rows = text.lines().skip(1);
        rows.map(|row| (column(row, 2), column(row, 3)))
            .collect::<Vec<_>>()
    };
    keep("--episodes 3");
    keep(&format!("--episodes 1 --checkpoint {updates}")).expect_printed(
        "; the best stays: it was played for 3 episodes, and fewer do not compare\n",
    );
    // Over more episodes the best is played again, as it was played for fewer.
    keep(&format!("--episodes 5 --checkpoint {updates}"));
    let row = |updates: &str, episodes: &str| (updates.to_owned(), episodes.to_owned());
    let expected = [
        row("540", "3"),
        row(updates, "1"),
        row("540", "5"),
        row(updates, "5"),
    ];
    assert_eq!(rows(), expected);
}

/// An evaluation plays the weights that actors of the run get, rounded as these are, unless it is told otherwise.
#[test]
fn it_plays_in_the_precision_of_the_run() {
    let system = system();
    system
        .run_ok(&format!(
            "local --lockstep --agent c51 {SHORT} --set learner.publish_dtype=bf16 --set actor.precision=bf16 --run-dir run"
        ));
    for (flags, words) in [
        ("", "bf16 weights after 540 updates played in bf16"),
        ("--exact", "f32 weights after 540 updates played in f32"),
    ] {
        let said = system.run_ok(&format!("evaluate run --episodes 2 {flags}"));
        said.expect_printed(words);
    }
    let json = system.run_ok("evaluate run --episodes 2 --json");
    let told: serde_json::Value = serde_json::from_str(&json.stdout).unwrap();
    assert_eq!(
        (&told["weights"], &told["arithmetic"]),
        (&"bf16".into(), &"bf16".into())
    );
}

#[test]
fn a_folder_that_is_no_run_s() {
    let system = system();
    fs::create_dir(system.path("empty")).unwrap();
    for folder in ["empty", "none"] {
        system.refuses(
            &format!("evaluate --run {folder}"),
            &format!("error: {folder} is not the folder of a run"),
        );
    }
    fs::write(system.path("empty/config.toml"), "[run]\n").unwrap();
    system.refuses("evaluate --run empty", "config.toml that driml wrote");
}

#[test]
fn a_damaged_checkpoint_is_named_and_not_used() {
    let system = with_run();
    let newest = system.run_folder("run").newest_checkpoint();
    let name = newest.file_name().unwrap().to_str().unwrap();
    for file in [
        "online.safetensors",
        "target.safetensors",
        "optimizer.safetensors",
        "state.json",
    ] {
        let path = newest.join(file);
        let whole = fs::read(&path).unwrap();
        for broken in [&whole[..whole.len() / 2], &whole[..0], &flipped(&whole)] {
            fs::write(&path, broken).unwrap();
            system
                .run("evaluate --run run --episodes 1")
                .expect_code(1)
                .expect_said(&format!(
                    "error: run/checkpoints/{name}/{file} is damaged: "
                ))
                .expect_said("remove the folder it is in");
        }
        fs::remove_file(&path).unwrap();
        system
            .run("evaluate --run run --episodes 1")
            .expect_code(1)
            .expect_said(&format!("{file} is damaged: it is missing"));
        fs::write(&path, &whole).unwrap();
    }
    system.run_ok("evaluate --run run --episodes 1");
}

fn flipped(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let at = bytes.len() * 3 / 4;
    bytes[at] ^= 1;
    bytes
}

#[test]
fn weights_of_another_run_are_refused() {
    let system = with_run();
    let config = system.path("run/config.toml");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("seed = 1", "seed = 2")).unwrap();
    system
        .run("evaluate --run run")
        .expect_code(1)
        .expect_said("belongs to a run with specification")
        .expect_said("resume with the settings it was made with");
    fs::remove_dir_all(system.path("run/checkpoints")).unwrap();
    system.refuses("evaluate --run run", "has no checkpoint yet");
}
