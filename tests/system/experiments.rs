//! The experiments from end to end at smoke length: all files exist and are reproducible, and calls resume or are rejected.
//! The pages in `deploy/experiments/results/` explain the numbers at full length.

use std::{collections::BTreeMap, fs, os::unix::fs::MetadataExt, path::Path};

use driml_tests::{check_has, wait_until};

use crate::{SMALL_NETWORK, system};

/// Returns every file of a folder except the page, which contains the time it took.
fn data_files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    let files = entries.filter(|entry| entry.file_type().unwrap().is_file());
    files
        .map(|entry| {
            let name = entry.file_name().into_string().unwrap();
            (name, fs::read(entry.path()).unwrap())
        })
        .filter(|(name, _)| name != "README.md")
        .collect()
}

fn joined_names(files: &BTreeMap<String, Vec<u8>>) -> String {
    files.keys().cloned().collect::<Vec<_>>().join(" ")
}

/// Returns the number of lines of a CSV file without its header.
fn count_rows(files: &BTreeMap<String, Vec<u8>>, name: &str) -> usize {
    String::from_utf8_lossy(&files[name]).lines().count() - 1
}

fn read_page(folder: &Path) -> String {
    fs::read_to_string(folder.join("README.md")).unwrap()
}

/// Checks the sections of a page and the files beside it. Returns the page.
fn check_page(folder: &Path, sections: &[&str], files: &str) -> String {
    let page = read_page(folder);
    let of_all = [
        "smoke length",
        "**Claim.**",
        "**Command.** `driml experiment",
        "**Results.**",
        "**Differences from the paper.**",
    ];
    check_has(&page, &of_all);
    check_has(&page, sections);
    let found = data_files(folder);
    assert_eq!(joined_names(&found), files);
    for (file, bytes) in &found {
        let text = String::from_utf8_lossy(bytes);
        let is_sound = file.ends_with(".png") || !text.contains("NaN");
        assert!(bytes.len() > 50 && is_sound, "{file}: {text}");
    }
    page
}

fn check_experiment(name: &str, files: &str) {
    let system = system();
    let call = format!("experiment {name} --smoke");
    // More seeds add pieces to the same grid; the full length is another grid.
    system.run_ok(&format!("{call} --seeds 1"));
    let printed = system.run_ok(&call).stdout;
    let out = format!("experiments/{name}-smoke");
    let full = format!("experiment {name} --out {out}");
    system.rejects(&full, "holds results made with ");
    let folder = system.path(&out);
    assert!(printed.ends_with("README.md\n"), "{printed}");
    check_page(&folder, &["**Time.**", "**Expected.**"], files);
    let first = data_files(&folder);
    let mut tables = first.keys().filter(|name| name.ends_with(".csv"));
    assert!(tables.all(|name| count_rows(&first, name) > 0));

    // If half of the pieces are lost, the next call makes them again, with the same bytes.
    let mut pieces = system.file_names(&format!("{out}/pieces"));
    pieces.retain(|it| !["settings.json", "cores.json"].contains(&&**it));
    pieces.sort();
    for piece in pieces.iter().step_by(2) {
        fs::remove_file(folder.join("pieces").join(piece)).unwrap();
    }
    let inode = |name: &String| fs::metadata(folder.join(name)).unwrap().ino();
    let before: Vec<_> = first.keys().map(inode).collect();
    system.run_ok(&call);
    // A file that is replaced whole is another file.
    let now = first.keys().map(inode);
    assert!(now.zip(before).all(|(now, before)| now != before));
    assert_eq!(data_files(&folder), first);
}

#[test]
fn random_walk() {
    check_experiment(
        "random-walk",
        "alpha.csv convergence.csv convergence.png convergence.svg curves.csv fig1.png fig1.svg ratio.csv",
    );
}

#[test]
fn ising() {
    check_experiment(
        "ising",
        "auc.csv fig2.png fig2.svg learning.png learning.svg loss.csv maps.csv",
    );
}

/// The command fails if a routine breaks a promise in this build.
#[test]
fn stability() {
    check_experiment("stability", "promises.csv worst.png worst.svg");
}

/// Real processes make each run different, but finished runs stay unchanged.
#[test]
fn procgen_without_the_engine() {
    let system = system();
    let call = &format!("experiment procgen --smoke {SMALL_NETWORK}");
    // A rejected call leaves the folder free for the corrected call.
    system.rejects(&format!("{call} --set learner.batchsize=1"), "no setting");
    system.run_ok(call);
    let folder = system.path("experiments/procgen-smoke");
    let files = "curves.png curves.svg table.csv";
    let page = check_page(&folder, &["**Results.**\n\n* ", "| --- |"], files);
    let words = page.split_whitespace().count();
    assert!(words <= 500, "{words} words");
    let first = data_files(&folder);
    let results = system.run_folder("experiments/procgen-smoke");
    let table = || results.table("table.csv");
    let before = table();
    let header = "game,agent,torso,seed,frames,training,greedy,random,paper,wall_seconds,commit";
    assert_eq!(before.header.join(","), header);
    assert_eq!(before.rows.len(), 2 * 2 * 2, "worlds, agents, seeds");
    for row in &before.rows {
        assert_eq!([&row[2], &row[4], &row[8]], ["nature", "2016", ""]);
        assert!(!row[7].is_empty() && !row[10].is_empty(), "{row:?}");
    }
    assert!(page.contains("| chain | "), "{page}");
    assert!(!page.contains("Interquartile"), "of two seeds: {page}");

    // Nothing is run again, and the same runs give the same files.
    system.run_ok(call);
    assert_eq!(data_files(&folder), first);

    // A run that failed before its first checkpoint is moved aside, made again and played again; the others stay. The earlier evaluations
    // get the return 777, so that they can be recognised.
    let pieces = folder.join("pieces");
    for name in ["chain-c51-seed1-greedy", "chain-c51-seed2-greedy"] {
        let path = pieces.join(format!("{name}.json"));
        let mut piece: serde_json::Value =
            serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        piece["result"] = vec![777.0].into();
        fs::write(&path, piece.to_string()).unwrap();
    }
    let summary = |name: &str| folder.join("runs").join(name).join("summary.json");
    let text = fs::read_to_string(summary("chain-c51-seed2")).unwrap();
    let failed = text.replace(": \"finished\"", ": \"failed\"");
    fs::write(summary("chain-c51-seed2"), failed).unwrap();
    fs::remove_dir_all(folder.join("runs/chain-c51-seed2/checkpoints")).unwrap();
    // Runs without a recorded commit are adopted.
    fs::remove_file(folder.join("runs/chain-c51-seed1.commit")).unwrap();
    system
        .run_ok(call)
        .expect_stderr("chain-c51-seed2 was not finished");
    assert!(summary("chain-c51-seed2.unfinished-1").exists());
    let again = fs::read_to_string(summary("chain-c51-seed2")).unwrap();
    assert!(again.contains(": \"finished\""), "{again}");
    let after = table();
    let row = |game: &str, agent: &str, seed: &str| {
        let mut rows = after.rows.iter();
        let found = rows.find(|it| [&it[0], &it[1], &it[3]] == [game, agent, seed]);
        found.unwrap()
    };
    assert!(before.rows.contains(row("mspacman", "driml-ada", "2")));
    // The evaluation of unchanged weights is kept; that of new weights is not.
    let is_kept = |seed: &str| row("chain", "c51", seed).iter().any(|it| it == "777.0");
    assert!(is_kept("1") && !is_kept("2"));
    assert_eq!(&row("chain", "c51", "1")[10], "", "no commit");

    // A call can add agents, but cannot change the length.
    let others = "runs: chain-driml-ada-seed1, chain-driml-ada-seed2, mspacman-driml-ada-seed1, ";
    system
        .run_ok(&format!("{call} --agents c51,cpc --report"))
        .expect_stderr(others);
    check_has(&read_page(&folder), &["Not finished: chain-cpc-seed1"]);
    system.run(&format!("{call} --frames 900")).expect_code(64);

    // Without the pieces, a report is made from the runs alone.
    fs::remove_dir_all(&pieces).unwrap();
    system.run_ok(&format!("{call} --report"));
    let table = table();
    let is_anew = table.rows.iter().flatten().all(|it| it != "777.0");
    assert!(table.rows.len() == 8 && is_anew, "{table:?}");
}

#[test]
fn pacman() {
    let system = system();
    system.run_ok(&format!("experiment pacman --smoke {SMALL_NETWORK}"));
    let folder = system.path("experiments/pacman-smoke");
    let files = "fig3.png fig3.svg final_loss.csv ghosts.csv loss.csv noise.csv";
    check_page(&folder, &["**Results.**\n\n* ", "| --- |"], files);
    // Two agents with 64 episodes each.
    for returns in ["ghosts.csv", "noise.csv"] {
        assert_eq!(count_rows(&data_files(&folder), returns), 128, "{returns}");
    }
    let config = |name: &str| {
        fs::read_to_string(folder.join("runs").join(name).join("config.toml")).unwrap()
    };
    assert!(config("epsilon0.25-seed1").contains("epsilon = 0.25"));
    let noise = config("noise-driml-fix-seed1");
    // 32 episodes over 4 environments.
    check_has(&noise, &["episodes_per_task = 8", "[world.ising]"]);
    assert!(!config("ghosts-c51-seed1").contains("[world.ising]"));
}

/// Makes a plan, runs one dial, then one more in the same folder. Finished runs stay unchanged.
#[test]
fn tradeoff() {
    let system = system();
    let call = |more: &str| {
        let call = format!("tradeoff --env chain --smoke --out t {more}");
        system.run_ok(&call).stdout
    };
    let folder = system.path("t");
    let planned = call("--dials learner.precision --plan");
    check_has(&planned, &["level       learner.precision = bf16: about"]);
    let has_run = folder.join("runs/c51-seed1").exists();
    assert!(!has_run, "a plan runs nothing");
    let settings = folder.join("pieces/settings.json");
    assert!(!settings.exists(), "a plan settles nothing");

    call("--dials learner.precision");
    let summary = |run: &str| fs::read(folder.join("runs").join(run).join("summary.json"));
    let first = summary("c51-seed1").unwrap();
    let plan = |dial: &str| call(&format!("--plan --budget 1 --dials {dial}"));
    let finished = "learner.precision = bf16: finished\n";
    check_has(&plan("learner.precision"), &[finished]);
    check_has(&plan("DIM --seeds 500"), &["DIM = driml-fix: does not fit"]);
    call("--dials DIM");
    assert_eq!(summary("c51-seed1").unwrap(), first, "it was not run again");
    let files = data_files(&folder);
    let all = "equal_time.csv levels.csv pareto.png pareto.svg pareto_training.png pareto_training.svg runs.csv wall.png wall.svg";
    assert_eq!(joined_names(&files), all);
    // The base has two seeds and each level has one. The base of each dial has its own row.
    let counts = || ["levels.csv", "runs.csv"].map(|name| count_rows(&data_files(&folder), name));
    assert_eq!(counts(), [2 + 3, 2 + 3]);
    let page = system.read("t/README.md");
    let parts = [
        "smoke length",
        "| learner.precision | bf16 | c51 |",
        "| DIM | driml-ada | driml-ada |",
        "against f32 by candle's operations",
        "over 1 seed of a level and 2 of a base",
        "--dials learner.precision`, then `driml tradeoff --env chain",
    ];
    check_has(&page, &parts);
    check_has(&call("--report"), &["learner.precision = bf16 (c51): x"]);
    assert_eq!(data_files(&folder), files);

    // The page includes the seeds of other calls. A report of one dial contains only that dial.
    call("--dials learner.precision --seeds 2");
    call("--report");
    assert_eq!(counts(), [2 + 3, 4 + 4]);
    call("--dials learner.precision --report");
    assert_eq!(counts()[0], 2);

    // The errors of a level are measured on a batch of its size, at most 64 rows.
    call("--dials learner.batch_size");
    let rows = ["64 (base) | c51 | 16", "32 | c51 | 32", "256 | c51 | 64"];
    check_has(&system.read("t/README.md"), &rows);
    // If the first seed of a level is missing, the other seeds are reported.
    let names = system.file_names("t/runs").into_iter();
    let first = names.filter(|it| it.contains("bf16") && it.ends_with("-seed1"));
    for name in first {
        fs::remove_file(folder.join("runs").join(name).join("summary.json")).unwrap();
    }
    call("--dials learner.precision --report");
    assert_eq!(counts(), [2, 4 + 4 - 1 + 2]);

    // Runs this short may have no return yet when the others end; these curves give each one.
    for name in system.file_names("t/runs") {
        let path = folder.join("runs").join(&name).join("metrics.csv");
        let rows = match name.starts_with("c51") {
            true => "1,32,1,0.5\n2,64,2,0.25\n",
            false => "1,32,1,0.75\n4,64,2,1\n",
        };
        if path.exists() {
            let header = "seconds,frames,episodes,mean_return";
            fs::write(path, format!("{header}\n{rows}")).unwrap();
        }
    }
    call("--dials DIM --report");
    let table = system.run_folder("t").table("equal_time.csv");
    for (name, value) in [("equal_seconds", 2.0), ("minus_base_at_equal_time", 0.5)] {
        let cells = table.rows.iter().map(|row| table.value(row, name));
        assert_eq!(cells.collect::<Vec<_>>(), [Some(value); 2], "{name}");
    }
    let page = system.read("t/README.md");
    check_has(&page, &["at equal wall-clock time (2 s)"]);
}

/// Killing an experiment ends its runs; the next call resumes them.
#[test]
fn killed_and_resumed() {
    let system = system();
    let call = &format!(
        "experiment procgen --smoke --games mspacman --agents c51 --seeds 1 --out x --frames 4000 {SMALL_NETWORK}"
    );
    // Pause the learner, so that the run does not end before it is killed.
    system.pause_learners_at(100);
    let process = system.start(call);
    let run = system.run_folder("x/runs/mspacman-c51-seed1");
    run.wait_for_updates(0);
    process.kill();
    // Released before its launcher notices, the learner may finish the run.
    wait_until("the run stops", || {
        let log = system.read("x/runs/mspacman-c51-seed1.log");
        log.contains("stopping: ")
    });
    system.release_learners();
    system
        .run_ok(call)
        .expect_stderr("mspacman-c51-seed1 resumes from its checkpoint");
    let summary = run.check_finished();
    assert!(summary.resumed_after_updates > 0, "{summary:#?}");
    let page = system.read("x/README.md");
    assert!(page.contains("* Finished: 1 of 1 run, each"), "{page}");
}

#[test]
fn a_grid_makes_every_combination_once() {
    let system = system();
    let fixed = "grid --env chain --agent c51,driml-ada --preset smoke";
    let call = format!("{fixed} --frames 320 --set learner.update.adam.lr=1e-4,1e-3");
    let printed = system.run_ok(&format!("{call} --jobs 2")).stdout;
    let is_narrow = |line: &str| line.len() <= 80;
    assert!(printed.lines().take(5).all(is_narrow), "{printed}");
    let folder = system.path("experiments/sweep");
    assert!(printed.ends_with("sweep.svg\n"), "{printed}");
    let table = || system.run_folder("experiments/sweep").table("sweep.csv");
    let columns = ["env", "agent", "learner.update.adam.lr", "seeds"];
    assert_eq!(table().header[..4], columns);
    let rows = table().rows;
    let cells: Vec<_> = rows.iter().map(|row| [&row[1], &row[2], &row[3]]).collect();
    let expected = [
        ["c51", "1e-4", "1"],
        ["c51", "1e-3", "1"],
        ["driml-ada", "1e-4", "1"],
        ["driml-ada", "1e-3", "1"],
    ];
    assert_eq!(cells, expected);
    let summary = folder.join("runs/1-c51-lr=1e-4-seed1/summary.json");
    assert!(summary.is_file());
    // One more seed makes only the missing runs.
    let made = || fs::metadata(&summary).unwrap().modified().unwrap();
    let before = made();
    system.run_ok(&format!("{call} --seeds 2 --jobs 2"));
    assert_eq!(made(), before);
    let made = table().rows;
    let is_whole = made.iter().all(|row| row.get(3) == Some("2"));
    assert!(made.len() == 4 && is_whole, "{made:?}");
    // A report includes all runs in the folder.
    system.run_ok("grid --report");
    assert_eq!(table().rows, made);
    // Another grid is rejected in the same folder.
    let other = format!("{fixed} --frames 352");
    let not_of =
        "`, not of `driml sweep --env chain --agent c51,driml-ada --preset smoke --frames 352`";
    system.rejects(&other, not_of);
}
