//! Charts of run folders: what is drawn, left out and said of it.
//! No picture is looked at here.

use std::path::{Path, PathBuf};

use driml_machine::{error::Usage, resources::Machine};
use driml_settings::{
    flags::{self, RunFlags},
    resolve::Flags,
};

use super::{flags::Band, *};

/// A run's folder under `root`, with settings that differ in `agent` and `seed`.
fn run_folder(root: &Path, name: &str, agent: &str, seed: u32, metrics: &str) -> PathBuf {
    let folder = root.join(name);
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(folder.join("metrics.csv"), metrics).unwrap();
    let config = format!(
        "[run]\nworld = \"chain\"\nagent = \"{agent}\"\nseed = {seed}\n[local]\nactors = 1\nlearner_threads = {seed}\n"
    );
    std::fs::write(folder.join("config.toml"), config).unwrap();
    folder
}

fn args(runs: &[&PathBuf], columns: &[&str], out: PathBuf) -> PlotArgs {
    PlotArgs {
        column: columns.iter().map(|&column| column.into()).collect(),
        ..PlotArgs::overview(runs.iter().map(|&run| run.clone()).collect(), out)
    }
}

const WAY: Way = Way {
    over: Over::Frames,
    smooth: None,
    band: Band::Range,
};
const METRICS: &str =
    "seconds,frames,mean_return,mean_k,waiting\n1,0,,,warm-up\n2,10,1.5,1.0,-\n3,20,2.5,2.0,-\n";

#[test]
fn runs_that_differ_in_their_seed_are_one_line_with_a_band() {
    let root = tempfile::tempdir().unwrap();
    let other = METRICS.replace("2.5", "4.5");
    let a = run_folder(root.path(), "a-1", "c51", 1, METRICS);
    let b = run_folder(root.path(), "a-2", "c51", 2, &other);
    let c = run_folder(root.path(), "c", "driml-ada", 1, METRICS);
    let runs: Vec<_> = [&a, &b, &c]
        .map(|run| Run::read(&RunFolder::new(run)).unwrap())
        .into();
    let groups = groups::of(&runs, true);
    let names: Vec<_> = groups.iter().map(|group| group.name.as_str()).collect();
    assert_eq!(names, ["chain c51, 2 seeds", "chain driml-ada, seed 1"]);
    let curve = groups[0].curve("mean_return", WAY).unwrap();
    assert_eq!(curve.points.last(), Some(&(20.0, 3.5)));
    assert_eq!(curve.band.last(), Some(&(20.0, 2.5, 4.5)));
    assert_eq!(groups::of(&runs, false).len(), 3);

    for name in ["all.svg", "all.png"] {
        let out = root.path().join(name);
        run(&args(&[&a, &b, &c], &[], out.clone())).unwrap();
        assert!(std::fs::metadata(out).unwrap().len() > 1000);
    }
    let svg = std::fs::read_to_string(root.path().join("all.svg")).unwrap();
    assert!(svg.contains("the band is their smallest and largest value"));
    assert!(svg.contains("Not smoothed."));
}

#[test]
fn agents_with_different_losses_are_drawn_beside_each_other() {
    let root = tempfile::tempdir().unwrap();
    let folder = |agent: &str, losses: &str, values: &str| {
        let metrics = format!("frames,c51_kl,{losses}total_loss\n10,0.5,{values}0.5\n");
        run_folder(root.path(), agent, agent, 1, &metrics)
    };
    let a = folder("driml-fix", "dim_3t3,dim_4t4,", ",1.5,");
    let b = folder("curl", "curl,", "2.5,");
    let c = folder("c51", "", "");
    for columns in [&[][..], &["dim_4t4", "curl"]] {
        let out = root.path().join("losses.svg");
        run(&args(&[&a, &b, &c], columns, out.clone())).unwrap();
        let svg = std::fs::read_to_string(out).unwrap();
        assert!(svg.contains("DIM 4t4 loss") && svg.contains("CURL loss"));
        assert!(!svg.contains("DIM 3t3"), "it has no values");
    }
}

#[test]
fn a_row_that_was_cut_off_is_left_out_and_a_folder_given_twice_is_one_run() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, &format!("{METRICS}4,3"));
    let values = Run::read(&RunFolder::new(&a))
        .unwrap()
        .values("mean_return")
        .unwrap();
    assert_eq!(values, [(10.0, 1.5), (20.0, 2.5)]);
    let again = root.path().join(".").join("a");
    let out = root.path().join("twice.svg");
    run(&args(&[&a, &again], &["mean_return"], out.clone())).unwrap();
    let svg = std::fs::read_to_string(out).unwrap();
    assert!(!svg.contains("2 seeds"));
}

#[test]
fn smoothing_is_a_mean_over_the_frames_before_and_said() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, METRICS);
    let runs = [Run::read(&RunFolder::new(&a)).unwrap()];
    let groups = groups::of(&runs, true);
    let curve = groups[0]
        .curve(
            "mean_return",
            Way {
                smooth: Some(15),
                ..WAY
            },
        )
        .unwrap();
    assert_eq!(curve.points, [(10.0, 1.5), (20.0, 2.0)]);
    let mut args = args(&[&a], &["mean_return"], root.path().join("a.svg"));
    args.smooth = Some(15);
    run(&args).unwrap();
    let svg = std::fs::read_to_string(&args.out).unwrap();
    assert!(svg.contains("Smoothed: each point is the mean over the 15 frames before it."));
}

#[test]
fn lines_are_called_by_what_differs_and_by_their_seeds() {
    let root = tempfile::tempdir().unwrap();
    let run = |name: &str, seed: u32, lr: &str| {
        let folder = run_folder(root.path(), name, "c51", seed, METRICS);
        let path = folder.join("config.toml");
        let config = std::fs::read_to_string(&path).unwrap();
        std::fs::write(path, format!("{config}[learner.update.adam]\nlr = {lr}\n")).unwrap();
        Run::read(&RunFolder::new(folder)).unwrap()
    };
    let runs = [
        run("a", 1, "0.1"),
        run("b", 1, "0.1"),
        run("c", 2, "0.1"),
        run("d", 2, "0.2"),
        run("e", 2, "0.2"),
        run("f", 3, "0.3"),
    ];
    let names = |together| {
        let groups = groups::of(&runs, together);
        groups
            .into_iter()
            .map(|group| group.name)
            .collect::<Vec<_>>()
    };
    let expected = [
        "chain c51, lr=0.1, 3 runs of 2 seeds",
        "chain c51, lr=0.2, 2 runs of seed 2",
        "chain c51, lr=0.3, seed 3",
    ];
    assert_eq!(names(true), expected);
    assert_eq!(
        names(false)[..3],
        [
            "chain c51, lr=0.1, seed 1 (a)",
            "chain c51, lr=0.1, seed 1 (b)",
            "chain c51, lr=0.1, seed 2"
        ]
    );
}

#[test]
fn rows_at_the_same_place_are_one_point_whatever_their_order() {
    let root = tempfile::tempdir().unwrap();
    let metrics = "seconds,frames,updates,loss\n1,10,0,1\n2,10,1,3\n3,30,2,5\n4,20,2,7\n";
    let folder = run_folder(root.path(), "a", "c51", 1, metrics);
    let run = Run::read(&RunFolder::new(folder)).unwrap();
    let over = |x| run.values_over(x, "loss").unwrap();
    assert_eq!(over(Over::Frames), [(10.0, 2.0), (20.0, 7.0), (30.0, 5.0)]);
    assert_eq!(over(Over::Updates), [(0.0, 1.0), (1.0, 3.0), (2.0, 6.0)]);
    assert_eq!(over(Over::Seconds).len(), 4);
}

#[test]
fn a_folder_that_is_no_runs_is_left_out() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, METRICS);
    let none = root.path().to_owned();
    let out = root.path().join("p.svg");
    run(&args(&[&none, &a], &[], out.clone())).unwrap();
    assert!(std::fs::read_to_string(out).unwrap().contains("seed 1"));
}

#[test]
fn a_random_policy_is_a_line() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, METRICS);
    let flags = RunFlags {
        env: Some("chain".into()),
        agent: Some("c51".into()),
        preset: None,
        config: None,
        over: Flags::default(),
    };
    let (config, _) = flags::resolve(&flags, &Machine::this()).unwrap();
    std::fs::write(a.join("config.toml"), config.to_toml()).unwrap();
    let mut args = args(&[&a], &["mean_return"], root.path().join("p.svg"));
    args.random = Some(8);
    run(&args).unwrap();
    let svg = std::fs::read_to_string(&args.out).unwrap();
    assert!(svg.contains("random policy") && svg.contains("8 whole episodes"));
}

#[test]
fn random_policies_of_two_worlds_are_two_lines_that_can_be_told_apart() {
    let curve = Series::line("chain c51", 0, vec![(0.0, 1.0), (30.0, 2.0)]);
    let worlds = [("chain".to_owned(), 0.5), ("ising".to_owned(), 0.6)];
    let drawn = lines(&worlds, std::slice::from_ref(&curve), 1);
    let names: Vec<_> = drawn.iter().map(|it| it.name.as_str()).collect();
    assert_eq!(names, ["random policy, chain", "random policy, ising"]);
    assert_ne!(drawn[0].colour, drawn[1].colour);
    assert!(drawn.iter().all(|it| it.colour != curve.colour));
    assert_eq!(lines(&worlds[..1], &[curve], 1)[0].colour, GREY);
}

#[test]
fn a_run_without_an_episode_is_named() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, METRICS);
    let empty = run_folder(root.path(), "e", "c51", 1, "frames,mean_return\n9,\n");
    let runs = [&a, &empty].map(|run| Run::read(&RunFolder::new(run)).unwrap());
    let said = absent(RETURN, &runs);
    let expected = format!(
        "{} is not in the chart of mean_return: no episode has ended in it",
        empty.display()
    );
    assert_eq!(said, [expected]);
}

#[test]
fn a_column_goes_by_the_word_that_the_help_has() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, METRICS);
    let out = root.path().join("p.pdf");
    let mut args = args(&[&a], &["return", "k"], out.clone());
    args.plain = true;
    run(&args).unwrap();
    assert!(std::fs::read(out).unwrap().starts_with(b"%PDF"));
}

#[test]
fn what_cannot_be_drawn_is_said() {
    let root = tempfile::tempdir().unwrap();
    let a = run_folder(root.path(), "a", "c51", 1, METRICS);
    let empty = run_folder(root.path(), "e", "c51", 1, "frames,mean_return\n0,\n");
    let none = root.path().join("none");
    let out = root.path().join("p.svg");
    let said = |args: &PlotArgs| {
        let e = run(args).unwrap_err();
        assert!(e.is::<Usage>(), "{e}");
        e.to_string()
    };
    let no_column = said(&args(&[&a], &["mean_retrun"], out.clone()));
    assert!(
        no_column.ends_with(
            "has no column \"mean_retrun\" (did you mean \"mean_return\"?); it has seconds, frames, mean_return, mean_k"
        ),
        "{no_column}"
    );
    assert!(said(&args(&[&a], &["waiting"], out.clone())).contains("has no column"));
    assert!(
        said(&args(&[&empty], &["mean_return"], out.clone()))
            .contains("none of these runs has a value of \"mean_return\" yet")
    );
    assert!(said(&args(&[&empty], &[], out.clone())).contains("recorded a value yet"));
    assert!(said(&args(&[&none], &[], out.clone())).contains("is not the folder of a run"));
    assert!(said(&args(&[&a], &[], root.path().join("p.eps"))).contains(".svg, .pdf or .png"));
    let mut affinity = args(&[&a], &[], out);
    affinity.affinity = true;
    assert!(said(&affinity).contains("no checkpoint"));
}
