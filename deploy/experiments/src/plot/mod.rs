//! `driml plot`: what runs recorded, drawn beside each other over frames, as SVG or PNG.
//! It reads run folders and changes nothing in them; whatever it does to the numbers stands in the picture.

mod affinity;
pub mod flags;
mod groups;
mod names;
mod runs;

use std::{collections::BTreeSet, path::PathBuf};

use driml_figure::{Axis, Chart, Figure, Format, GREY, Mark, Panel, Series};
use driml_launch::{
    console::{self, print},
    evaluate::{mean_and_deviation, random_returns},
    live_view::loss_title,
    run_folder::RunFolder,
};
use driml_machine::error::usage;

pub(crate) use self::{
    affinity::figure as affinities,
    groups::{Curve, over_seeds, smoothed},
    runs::{Over, Run},
};
use self::{
    groups::{Group, Way},
    runs::C51_LOSS,
};
use crate::plot::flags::{Band, PlotArgs};

/// Width and height of a chart.
const CHART_SIZE: (f64, f64) = (460.0, 310.0);
/// The column over which a random policy is a line.
const RETURN: &str = "mean_return";
/// The column of what checkpoints earned when they were played.
const EVALUATED: &str = "evaluated_return";
/// Columns that are drawn if none is asked for, those that the runs have values of; auxiliary losses follow [`C51_LOSS`].
const OVERVIEW: [&str; 7] = [
    RETURN,
    EVALUATED,
    C51_LOSS,
    "mean_k",
    "replay_ratio",
    "frames_per_second",
    "updates_per_second",
];

/// Draws columns of the runs' metrics, or their action affinities.
///
/// # Errors
/// A folder that is no run's, a column that is not there, a file that cannot be written.
pub fn run(args: &PlotArgs) -> anyhow::Result<()> {
    Format::of(&args.out).map_err(|e| usage!("{e}"))?;
    let figure = if args.affinity {
        affinity::figure(&folders(args)?)?
    } else {
        charts(args)?
    };
    figure.save(&args.out)?;
    print(&format!("{}\n", args.out.display()))
}

/// The columns of the [`OVERVIEW`] and the auxiliary losses of which a run has values.
fn overview(runs: &[Run]) -> Vec<String> {
    let mut columns: Vec<&str> = OVERVIEW.into();
    let mut place = OVERVIEW.iter().position(|it| *it == C51_LOSS).unwrap_or(0) + 1;
    for loss in runs.iter().flat_map(Run::auxiliary_losses) {
        if !columns.contains(&loss.as_str()) {
            columns.insert(place, loss);
            place += 1;
        }
    }
    let has = |column: &&str| runs.iter().any(|run| run.has_values(column));
    columns.into_iter().filter(has).map(String::from).collect()
}

/// The folders of runs among those named, each once; what is none is left out with a word, as `runs/*` names it too.
fn folders(args: &PlotArgs) -> anyhow::Result<Vec<RunFolder>> {
    let mut seen = BTreeSet::new();
    // A folder given twice is one run, not two seeds.
    let whole = |folder: &PathBuf| folder.canonicalize().unwrap_or_else(|_| folder.clone());
    let named: Vec<_> = args
        .runs
        .iter()
        .filter(|it| seen.insert(whole(it)))
        .collect();
    let (runs, others): (Vec<_>, Vec<_>) = named
        .into_iter()
        .map(RunFolder::new)
        .partition(|folder| folder.metrics().is_file());
    if runs.is_empty() {
        let named: Vec<String> = others.iter().map(|it| it.display().to_string()).collect();
        return Err(usage!(
            "{} is not the folder of a run: there is no {} in it",
            named.join(", "),
            others[0]
                .metrics()
                .file_name()
                .unwrap_or_default()
                .display()
        )
        .into());
    }
    for other in others {
        console::line(&format!(
            "left out {}: it is not the folder of a run",
            other.display()
        ));
    }
    Ok(runs)
}

fn charts(args: &PlotArgs) -> anyhow::Result<Figure> {
    let runs = folders(args)?
        .iter()
        .map(Run::read)
        .collect::<anyhow::Result<Vec<_>>>()?;
    let columns = if args.column.is_empty() {
        overview(&runs)
    } else {
        args.column.clone()
    };
    let groups = groups::of(&runs, !args.separate);
    let way = Way {
        over: args.x,
        smooth: args.smooth,
        band: args.band,
    };
    let random = match args.random {
        Some(episodes) if columns.iter().any(|it| it == RETURN || it == EVALUATED) => {
            at_random(&runs, episodes as usize)?
        }
        Some(_) => {
            return Err(usage!("--random is a line over {RETURN:?}, which is not drawn").into());
        }
        None => Vec::new(),
    };
    let mut panels = Vec::new();
    for column in &columns {
        let reports = |run: &Run| run.auxiliary_losses().contains(column);
        let is_loss = runs.iter().any(reports);
        let drawn = groups
            .iter()
            .map(|group| {
                // Agents differ in their losses: what another one reports is not drawn for this one.
                if is_loss && !group.runs.iter().any(|run| reports(run)) {
                    return Ok(Curve::default());
                }
                group.curve(column, way)
            })
            .collect::<anyhow::Result<Vec<_>>>()?;
        if !args.column.is_empty() && drawn.iter().all(|curve| curve.points.is_empty()) {
            return Err(usage!("none of these runs has a value of {column:?} yet").into());
        }
        let mut series = series(&groups, drawn);
        if column == RETURN || column == EVALUATED {
            series.extend(lines(&random, &series));
        }
        panels.push(Panel::Chart(chart(column, is_loss, args.x, series)));
    }
    if panels.is_empty() {
        return Err(usage!("none of these runs has recorded a value yet").into());
    }
    Ok(Figure {
        title: title(&groups),
        notes: notes(args, &groups, &columns),
        columns: if panels.len() > 1 { 2 } else { 1 },
        panel_size: if panels.len() > 1 {
            CHART_SIZE
        } else {
            (860.0, 420.0)
        },
        panels,
    })
}

/// The curves that have points, each in the colour of its group.
fn series(groups: &[Group<'_>], curves: Vec<Curve>) -> Vec<Series> {
    let all = groups.iter().zip(curves).enumerate();
    all.filter(|(_, (_, curve))| !curve.points.is_empty())
        .map(|(index, (group, curve))| {
            Series::line(&group.name, index, curve.points).banded(curve.band)
        })
        .collect()
}

fn chart(column: &str, is_loss: bool, x: Over, series: Vec<Series>) -> Chart {
    let (title, y) = if is_loss {
        let title = format!("{} loss", loss_title(column));
        (title, "auxiliary loss [nats]".into())
    } else {
        words(column)
    };
    Chart::new(&title, Axis::linear(x.column()), Axis::linear(&y), series)
}

/// What a random policy earns in each of the runs' worlds, by the world's name.
fn at_random(runs: &[Run], episodes: usize) -> anyhow::Result<Vec<(String, f64)>> {
    let mut worlds: Vec<(String, f64)> = Vec::new();
    for run in runs {
        let config = run.config()?;
        let world = &config.run.world;
        if !worlds.iter().any(|(known, _)| known == world) {
            let (mean, _) = mean_and_deviation(&random_returns(&config, episodes, 0)?);
            worlds.push((world.clone(), mean));
        }
    }
    Ok(worlds)
}

/// Level lines from the start to where the longest curve ends.
fn lines(random: &[(String, f64)], curves: &[Series]) -> Vec<Series> {
    let xs = curves.iter().flat_map(|it| &it.points);
    let last = xs.map(|point| point.0).fold(0.0, f64::max);
    let line = |(world, mean): &(String, f64)| {
        let name = match random {
            [_] => "random policy".into(),
            _ => format!("random policy, {world}"),
        };
        Series::line(&name, 0, vec![(0.0, *mean), (last, *mean)])
            .marked(Mark::Dashed)
            .coloured(GREY)
    };
    random.iter().map(line).collect()
}

/// Title and label of a column's chart, with its unit.
fn words(column: &str) -> (String, String) {
    let (title, label) = match column {
        "mean_return" => ("Return", "mean of the last 100 episodes"),
        EVALUATED => (
            "Return of checkpoints, played greedily",
            "mean over episodes",
        ),
        "c51_kl" => ("C51 loss", "KL divergence [nats]"),
        "total_loss" => ("Total loss", "[nats]"),
        "mean_k" => (
            "How far ahead: k, mean since the start",
            "k [environment steps]",
        ),
        "replay_ratio" => ("Replay ratio", "rows sampled per transition"),
        "frames_per_second" => ("Acting speed", "frames per second"),
        "updates_per_second" => ("Learning speed", "updates per second"),
        "mean_age" => ("Age of sampled rows", "transitions"),
        "grad_norm" => ("Gradient before clipping", "global 2-norm"),
        "epsilon" => ("Epsilon", "probability of a random action"),
        _ => {
            let text = column.replace('_', " ");
            let label = if column.starts_with("rss_mib_") {
                "resident memory [MiB]".into()
            } else {
                text.clone()
            };
            return (text, label);
        }
    };
    (title.into(), label.into())
}

fn title(groups: &[Group<'_>]) -> String {
    match groups {
        [only] => only.name.clone(),
        _ => format!("{} configurations compared", groups.len()),
    }
}

/// What was done to the numbers.
fn notes(args: &PlotArgs, groups: &[Group<'_>], columns: &[String]) -> Vec<String> {
    let mut notes = Vec::new();
    if groups.iter().any(|group| group.runs.len() > 1) {
        notes.push(format!(
            "Runs that differ in their seed alone are one line, their mean; the band is {}.",
            match args.band {
                Band::Range => "their smallest and largest value",
                Band::Sd => "one standard deviation to each side",
                Band::Ci => "the 95% bootstrap interval of that mean over the choice of runs",
            }
        ));
    }
    let spread = groups.iter().flat_map(|group| &group.runs);
    if columns.iter().any(|column| column == "mean_k")
        && spread.clone().any(|run| run.has_values(runs::SPREAD_OF_K))
    {
        notes.push(
            "The band around k is one standard deviation of k itself to each side, cut at 1."
                .into(),
        );
    }
    match args.smooth {
        Some(width) => notes.push(format!(
            "Smoothed: each point is the mean over the {width} {} before it.",
            args.x.column()
        )),
        None => notes.push("Not smoothed.".into()),
    }
    if let Some(episodes) = args.random {
        notes.push(format!("Random policy: mean of {episodes} whole episodes."));
    }
    notes
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use driml_machine::{error::Usage, resources::Machine};
    use driml_settings::{
        flags::{self, RunFlags},
        resolve::Flags,
    };

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
    const METRICS: &str = "seconds,frames,mean_return,mean_k,waiting\n1,0,,,warm-up\n2,10,1.5,1.0,-\n3,20,2.5,2.0,-\n";

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
        assert!(said(&args(&[&a], &[], root.path().join("p.pdf"))).contains(".svg or .png"));
        let mut affinity = args(&[&a], &[], out);
        affinity.affinity = true;
        assert!(said(&affinity).contains("no checkpoint"));
    }
}
