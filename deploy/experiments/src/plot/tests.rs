//! Tests which columns and runs the charts show or skip, and the messages.
//! They do not check the pixels of a picture.

use std::path::PathBuf;

use driml_machine::error::Usage;

use super::*;
use crate::sweep::TrainCall;

struct Runs(tempfile::TempDir);

impl Runs {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn run(&self, name: &str, agent: &str, seed: u32, metrics: &str) -> PathBuf {
        let folder = self.0.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join("metrics.csv"), metrics).unwrap();
        let config = format!(
            "[run]\nworld = \"chain\"\nagent = \"{agent}\"\nseed = {seed}\n[local]\nactors = 1\nlearner_threads = {seed}\n"
        );
        std::fs::write(folder.join("config.toml"), config).unwrap();
        folder
    }

    fn args(&self, runs: &[&PathBuf], columns: &[&str]) -> PlotArgs {
        PlotArgs {
            runs: runs.iter().map(|&run| run.clone()).collect(),
            column: columns.iter().map(|&column| column.into()).collect(),
            out: self.0.path().join("p.svg"),
            ..PlotArgs::default()
        }
    }
}

fn drawn(args: &PlotArgs) -> String {
    run(args).unwrap();
    std::fs::read_to_string(&args.out).unwrap()
}

fn read(folder: &PathBuf) -> Run {
    Run::read(&RunFolder::new(folder)).unwrap()
}

const METRICS: &str =
    "seconds,frames,mean_return,mean_k,waiting\n1,0,,,warm-up\n2,10,1.5,1.0,-\n3,20,2.5,2.0,-\n";

#[test]
fn runs_that_differ_in_their_seed_are_one_line_with_a_band() {
    let root = Runs::new();
    let a = root.run("a-1", "c51", 1, METRICS);
    let b = root.run("a-2", "c51", 2, &METRICS.replace("2.5", "4.5"));
    let c = root.run("c", "driml-ada", 1, METRICS);
    let runs = [&a, &b, &c].map(read);
    let groups = groups::group_runs(&runs, true);
    let names: Vec<_> = groups.iter().map(|group| group.name.as_str()).collect();
    assert_eq!(names, ["chain c51, 2 seeds", "chain driml-ada, seed 1"]);
    let args = PlotArgs::default();
    let curve = groups[0].curve("mean_return", &args).unwrap();
    assert_eq!(curve.points.last(), Some(&(20.0, 3.5)));
    assert_eq!(curve.band.last(), Some(&(20.0, 2.5, 4.5)));
    assert_eq!(groups::group_runs(&runs, false).len(), 3);
    let compared = ["local.learner_threads".into()];
    let compared = [&a, &b].map(|it| Run::read_comparing(&RunFolder::new(it), &compared).unwrap());
    assert_eq!(groups::group_runs(&compared, true).len(), 2);

    let svg = drawn(&root.args(&[&a, &b, &c], &[]));
    assert!(svg.contains("the band is their smallest and largest value"));
    assert!(svg.contains("Not smoothed."));

    // Of runs of one row the band is a bar, beside a dot and a legend in each chart; equal values have ticks that differ.
    let row = |seed: u32| format!("frames,mean_return,replay_ratio\n9,{seed},0.995595\n");
    let runs = [7_u32, 8, 9].map(|seed| root.run(&seed.to_string(), "c51", seed, &row(seed)));
    let svg = drawn(&root.args(&runs.each_ref(), &["mean_return", "replay_ratio"]));
    assert!(svg.matches("#0072b2").count() > 6 && !svg.contains("0.995595"));
}

#[test]
fn agents_with_different_losses_are_drawn_beside_each_other() {
    let root = Runs::new();
    let folder = |agent: &str, losses: &str, values: &str| {
        let metrics = format!("frames,c51_kl,{losses}total_loss\n10,0.5,{values}0.5\n");
        root.run(agent, agent, 1, &metrics)
    };
    let a = folder("driml-fix", "dim_3t3,dim_4t4,", ",1.5,");
    let b = folder("curl", "curl,", "2.5,");
    let c = folder("c51", "", "");
    for columns in [&[][..], &["dim_4t4", "curl"]] {
        let svg = drawn(&root.args(&[&a, &b, &c], columns));
        assert!(svg.contains("DIM 4t4 loss") && svg.contains("CURL loss"));
        assert!(!svg.contains("DIM 3t3"), "it has no values");
    }
}

#[test]
fn a_row_cut_off_a_folder_given_twice_and_one_that_is_no_runs_are_left_out() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, &format!("{METRICS}4,3"));
    let values = read(&a).values("frames", "mean_return").unwrap();
    assert_eq!(values, [(10.0, 1.5), (20.0, 2.5)]);
    let (none, again) = (root.0.path().to_owned(), root.0.path().join("./a"));
    let svg = drawn(&root.args(&[&none, &a, &again], &["mean_return"]));
    assert!(svg.contains("seed 1") && !svg.contains("2 seeds"));
}

#[test]
fn smoothing_is_a_mean_over_the_frames_before_and_said() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, METRICS);
    let mut args = root.args(&[&a], &["mean_return"]);
    args.smooth = Some(15);
    let runs = [read(&a)];
    let curve = groups::group_runs(&runs, true)[0].curve("mean_return", &args);
    assert_eq!(curve.unwrap().points, [(10.0, 1.5), (20.0, 2.0)]);
    let expected = "Smoothed: each point is the mean over the 15 frames before it.";
    assert!(drawn(&args).contains(expected));
}

#[test]
fn lines_are_called_by_what_differs_and_by_their_seeds() {
    let root = Runs::new();
    let runs = [
        ("a", 1, "0.1"),
        ("b", 1, "0.1"),
        ("c", 2, "0.1"),
        ("d", 2, "0.2"),
        ("e", 2, "0.2"),
        ("f", 3, "0.3"),
    ];
    let runs = runs.map(|(name, seed, lr)| {
        let folder = root.run(name, "c51", seed, METRICS);
        let path = folder.join("config.toml");
        let config = std::fs::read_to_string(&path).unwrap();
        std::fs::write(path, format!("{config}[learner.update.adam]\nlr = {lr}\n")).unwrap();
        read(&folder)
    });
    let names = |together| -> Vec<String> {
        let groups = groups::group_runs(&runs, together).into_iter();
        groups.map(|group| group.name).collect()
    };
    let expected = [
        "chain c51, lr=0.1, 3 runs of 2 seeds",
        "chain c51, lr=0.2, 2 runs of seed 2",
        "chain c51, lr=0.3, seed 3",
    ];
    assert_eq!(names(true), expected);
    let expected = ["seed 1 (a)", "seed 1 (b)", "seed 2"];
    let expected = expected.map(|seed| format!("chain c51, lr=0.1, {seed}"));
    assert_eq!(names(false)[..3], expected);
    let folders = runs.each_ref().map(|run| run.folder.path().to_owned());
    let svg = drawn(&root.args(&folders.each_ref(), &[]));
    assert!(!svg.contains('\u{2026}'), "a text was cut: {svg}");
}

#[test]
fn rows_at_the_same_place_are_one_point_whatever_their_order() {
    let metrics = "seconds,frames,updates,loss\n1,10,0,1\n2,10,1,3\n3,30,2,5\n4,20,2,7\n";
    let run = read(&Runs::new().run("a", "c51", 1, metrics));
    let over = |x| run.values(x, "loss").unwrap();
    assert_eq!(over("frames"), [(10.0, 2.0), (20.0, 7.0), (30.0, 5.0)]);
    assert_eq!(over("updates"), [(0.0, 1.0), (1.0, 3.0), (2.0, 6.0)]);
    assert_eq!(over("seconds").len(), 4);
}

#[test]
fn a_random_policy_is_a_line() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, METRICS);
    let call = TrainCall {
        env: Some("chain".into()),
        ..TrainCall::default()
    };
    std::fs::write(a.join("config.toml"), call.config().unwrap().to_toml()).unwrap();
    let mut args = root.args(&[&a], &["mean_return"]);
    args.random = Some(8);
    let svg = drawn(&args);
    assert!(svg.contains("random policy") && svg.contains("8 whole episodes"));
}

#[test]
fn random_policies_of_two_worlds_are_two_lines_that_can_be_told_apart() {
    let curve = Series::line("chain c51", 0, vec![(0.0, 1.0), (30.0, 2.0)]);
    let worlds = [("chain".to_owned(), 0.5), ("ising".to_owned(), 0.6)];
    let drawn = random_lines(&worlds, std::slice::from_ref(&curve), 1);
    let names: Vec<_> = drawn.iter().map(|it| it.name.as_str()).collect();
    assert_eq!(names, ["random policy, chain", "random policy, ising"]);
    assert_ne!(drawn[0].colour, drawn[1].colour);
    assert!(drawn.iter().all(|it| it.colour != curve.colour));
    assert_eq!(random_lines(&worlds[..1], &[curve], 1)[0].colour, GREY);
}

#[test]
fn a_run_without_an_episode_is_named() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, METRICS);
    let empty = root.run("e", "c51", 1, "frames,mean_return\n9,\n");
    let runs = [&a, &empty].map(read);
    let expected = format!(
        "{} is not in the chart of mean_return: no episode has ended in it",
        empty.display()
    );
    let groups = groups::group_runs(&runs, true);
    assert!(missing_messages(RETURN, true, &groups).eq([expected]));
}

#[test]
fn a_run_that_was_never_evaluated_stands_beside_one_that_was() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, METRICS);
    let evaluations = "seconds,frames,updates,evaluated_return\n3,20,2,7.5\n";
    std::fs::write(a.join("evaluations.csv"), evaluations).unwrap();
    // Another seed of the same agent, and another agent.
    for (name, agent, seed) in [("b", "c51", 2), ("c", "curl", 1)] {
        let b = root.run(name, agent, seed, METRICS);
        for columns in [&[][..], &["evaluated_return"]] {
            let svg = drawn(&root.args(&[&b, &a], columns));
            assert!(svg.contains("Return of checkpoints"), "{name} {columns:?}");
        }
    }
    let runs = ["a", "b", "c"].map(|it| read(&root.0.path().join(it)));
    let groups = groups::group_runs(&runs, true);
    let missing = [false, true].map(|all| missing_messages(EVALUATED, all, &groups).count());
    assert_eq!(missing, [1, 2], "b, and c, which has no line");
}

#[test]
fn different_replays_and_repeated_seeds_are_named() {
    let root = Runs::new();
    for (name, capacities, seeds, expected) in [
        (
            "a",
            [300, 5_000],
            [1, 2],
            Some("hold 300 to 2000 transitions"),
        ),
        ("b", [3_000, 5_000], [1, 2], None),
        ("c", [3_000, 5_000], [7, 7], Some("have the seed 7;")),
    ] {
        let runs = [0, 1].map(|at| {
            let folder = root.run(&format!("{name}{at}"), "c51", seeds[at], METRICS);
            let path = folder.join("config.toml");
            let config = std::fs::read_to_string(&path).unwrap();
            let capacity = capacities[at];
            let replay = format!("capacity_transitions = {capacity}\ntransitions_max = 2000\n");
            std::fs::write(path, format!("{config}[replay]\n{replay}")).unwrap();
            read(&folder)
        });
        let found: Vec<_> = groups::group_runs(&runs, true)[0].warnings().collect();
        assert_eq!(found.len(), expected.iter().len(), "{found:?}");
        assert!(
            found.iter().all(|it| it.contains(expected.unwrap())),
            "{found:?}"
        );
    }
}

#[test]
fn a_column_goes_by_the_word_that_the_help_has() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, METRICS);
    for (name, start) in [("p.pdf", b"%PDF"), ("p.png", b"\x89PNG")] {
        let mut args = root.args(&[&a], &["return", "k"]);
        args.plain = true;
        args.out = root.0.path().join(name);
        run(&args).unwrap();
        let bytes = std::fs::read(args.out).unwrap();
        assert!(bytes.starts_with(start), "{name}");
    }
}

#[test]
fn what_cannot_be_drawn_is_said() {
    let root = Runs::new();
    let a = root.run("a", "c51", 1, METRICS);
    let empty = root.run("e", "c51", 1, "frames,mean_return\n0,\n");
    let late = root.run("l", "c51", 2, "frames,mean_return\n90,1.5\n95,2.5\n");
    let none = ["a1", "a2", "a3", "a4", "a5", "a6"].map(|it| root.0.path().join(it));
    let ragged = root.run("r", "c51", 1, "frames,mean_return\n0\n");
    let mut eps = root.args(&[&a], &[]);
    eps.out = root.0.path().join("p.eps");
    let mut affinity = root.args(&[&a], &[]);
    affinity.affinity = true;
    for (args, expected) in [
        (
            root.args(&[&a], &["mean_retrun"]),
            "has no column of numbers \"mean_retrun\" (did you mean \"mean_return\"?); it has seconds, frames, mean_return, mean_k",
        ),
        (root.args(&[&a], &["retrun"]), "did you mean \"return\"?"),
        (root.args(&[&a], &["waiting"]), "has no column of numbers"),
        (
            root.args(&[&empty], &["mean_return"]),
            "none of these runs has a value of \"mean_return\" yet",
        ),
        (
            root.args(&[&a, &late], &["mean_return"]),
            "its seeds share no range of frames; --separate draws each",
        ),
        (root.args(&[&empty], &[]), "recorded a value yet"),
        (
            root.args(&none.each_ref(), &[]),
            "/a4, 2 more is not the folder of a run: it has no metrics.csv",
        ),
        (root.args(&[&ragged], &[]), "correct or remove that line"),
        (eps, ".svg, .pdf or .png"),
        (affinity, "no checkpoint"),
    ] {
        let e = run(&args).unwrap_err();
        assert!(e.is::<Usage>(), "{e}");
        assert!(e.to_string().contains(expected), "{e}");
    }
}
