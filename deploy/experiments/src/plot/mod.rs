//! `driml plot`: what runs recorded, drawn beside each other over frames, as SVG or PNG.
//! It reads run folders and changes nothing in them; whatever it does to the numbers stands in the picture.

mod affinity;
pub mod flags;
mod groups;
mod runs;

use std::collections::BTreeSet;

use driml_figure::{Axis, Chart, Figure, Format, Panel, Series};
use driml_launch::{console::print, live_view::loss_title, run_folder::RunFolder};
use driml_machine::error::usage;

pub(crate) use self::{
    affinity::figure as affinities,
    groups::{Curve, over_seeds, smoothed},
    runs::Run,
};
use self::{groups::Group, runs::C51_LOSS};
use crate::plot::flags::{Band, PlotArgs};

/// Width and height of a chart.
const CHART_SIZE: (f64, f64) = (460.0, 310.0);
/// Columns that are drawn if none is asked for, those that the runs have values of; auxiliary losses follow [`C51_LOSS`].
const OVERVIEW: [&str; 6] = [
    "mean_return",
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
        {
            let folders: Vec<_> = args.runs.iter().map(RunFolder::new).collect();
            affinity::figure(&folders)?
        }
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

fn charts(args: &PlotArgs) -> anyhow::Result<Figure> {
    let mut seen = BTreeSet::new();
    let runs = args
        .runs
        .iter()
        // A folder given twice is one run, not two seeds.
        .filter(|folder| seen.insert(folder.canonicalize().unwrap_or_else(|_| (*folder).clone())))
        .map(|folder| Run::read(&RunFolder::new(folder)))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let columns = if args.column.is_empty() {
        overview(&runs)
    } else {
        args.column.clone()
    };
    let groups = groups::of(&runs, !args.separate);
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
                group.curve(column, args.smooth, args.band)
            })
            .collect::<anyhow::Result<Vec<_>>>()?;
        if !args.column.is_empty() && drawn.iter().all(|curve| curve.points.is_empty()) {
            return Err(usage!("none of these runs has a value of {column:?} yet").into());
        }
        panels.push(Panel::Chart(chart(column, is_loss, &groups, drawn)));
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

fn chart(column: &str, is_loss: bool, groups: &[Group<'_>], curves: Vec<Curve>) -> Chart {
    let series = groups.iter().zip(curves).enumerate();
    let series = series
        .filter(|(_, (_, curve))| !curve.points.is_empty())
        .map(|(index, (group, curve))| {
            Series::line(&group.name, index, curve.points).banded(curve.band)
        })
        .collect();
    let (title, y) = if is_loss {
        let title = format!("{} loss", loss_title(column));
        (title, "auxiliary loss [nats]".into())
    } else {
        words(column)
    };
    Chart::new(&title, Axis::linear("frames"), Axis::linear(&y), series)
}

/// Title and label of a column's chart, with its unit.
fn words(column: &str) -> (String, String) {
    let (title, label) = match column {
        "mean_return" => ("Return", "mean of the last 100 episodes"),
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
            }
        ));
    }
    let spread = groups.iter().flat_map(|group| &group.runs);
    if columns.iter().any(|column| column == "mean_k")
        && spread.clone().any(|run| run.has_values(runs::SPREAD_OF_K))
    {
        notes.push("The band around k is one standard deviation of k itself to each side.".into());
    }
    match args.smooth {
        Some(frames) => notes.push(format!(
            "Smoothed: each point is the mean over the {frames} frames before it."
        )),
        None => notes.push("Not smoothed.".into()),
    }
    notes
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use driml_machine::error::Usage;

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
            runs: runs.iter().map(|&run| run.clone()).collect(),
            column: columns.iter().map(|&column| column.into()).collect(),
            smooth: None,
            band: Band::Range,
            separate: false,
            affinity: false,
            out,
        }
    }

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
        assert_eq!(names, ["chain c51, 2 seeds", "c"]);
        let curve = groups[0].curve("mean_return", None, Band::Range).unwrap();
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
            .curve("mean_return", Some(15), Band::Range)
            .unwrap();
        assert_eq!(curve.points, [(10.0, 1.5), (20.0, 2.0)]);
        let mut args = args(&[&a], &["mean_return"], root.path().join("a.svg"));
        args.smooth = Some(15);
        run(&args).unwrap();
        let svg = std::fs::read_to_string(&args.out).unwrap();
        assert!(svg.contains("Smoothed: each point is the mean over the 15 frames before it."));
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
