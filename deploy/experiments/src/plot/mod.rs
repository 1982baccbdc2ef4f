//! `driml plot`: draws the recorded metrics of runs side by side, as SVG, PDF or PNG.
//! It reads run folders and does not change them. The notes in the picture say what was done to the numbers.

mod affinity;
pub mod flags;
mod groups;
mod names;
mod runs;

use std::{collections::BTreeSet, path::PathBuf};

use driml_figure::{Axis, Chart, Figure, Format, GREY, Look, Mark, Panel, Series};
use driml_launch::{
    checkpoint_choice::read_config,
    console::{self, print},
    evaluate::random_returns,
    metrics, output,
    run_folder::RunFolder,
    stats::mean_and_deviation,
    view::loss_title,
};
use driml_machine::{
    error::{Usage, usage},
    units::count,
};

pub(crate) use self::{
    flags::Band,
    groups::{Curve, combine_seeds, smooth},
    runs::{Run, Settings, read_settings},
};
use self::{
    flags::PlotArgs,
    groups::Group,
    runs::{C51_LOSS, SD_OF_K, SHORT_NAMES},
};

const CHART_SIZE: (f64, f64) = (460.0, 310.0);
/// The column of training returns; the chart can show a random policy as a line.
const RETURN: &str = "mean_return";
const EVALUATED: &str = "evaluated_return";
/// The most skipped folders that are named. Of further folders the message has only the number.
const SKIPPED_MAX: usize = 4;
/// The columns drawn by default, if the runs have values of them. Auxiliary losses follow after [`C51_LOSS`].
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
/// No folder is that of a run, a column does not exist, or the file cannot be written.
pub fn run(args: &PlotArgs) -> anyhow::Result<()> {
    let format = Format::from_path(&args.out).map_err(|e| usage!("--out: {e}"))?;
    output::check_file("--out", &args.out)?;
    let figure = match args.affinity {
        true => affinity::figure(&run_folders(args)?)?,
        false => charts_figure(args)?,
    };
    let look = if args.plain { Look::Plain } else { Look::Card };
    output::write_file("--out", &args.out, &figure.encode(format, look)?)?;
    print(&format!("{}\n", args.out.display()))
}

/// Returns the columns of the [`OVERVIEW`] and the auxiliary losses for which some run has values.
fn overview_columns(runs: &[Run]) -> Vec<String> {
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

/// Returns the named run folders, each once. Others are skipped with a message, files beside a run without one: a sweep's `runs/*` names both.
fn run_folders(args: &PlotArgs) -> anyhow::Result<Vec<RunFolder>> {
    let mut seen = BTreeSet::new();
    // A folder given twice is one run, not two seeds.
    let whole = |folder: &PathBuf| folder.canonicalize().unwrap_or_else(|_| folder.clone());
    let named = args.runs.iter().filter(|it| seen.insert(whole(it)));
    let folders = named.map(RunFolder::new);
    let (runs, others): (Vec<_>, Vec<_>) = folders.partition(|it| it.metrics().is_file());
    let parents: BTreeSet<_> = runs.iter().map(|run| run.path().parent()).collect();
    let is_told = |it: &&RunFolder| !it.path().is_file() || !parents.contains(&it.path().parent());
    let others = others.iter().filter(is_told);
    let mut others: Vec<String> = others.map(|it| it.display().to_string()).collect();
    if let more @ 1.. = others.len().saturating_sub(SKIPPED_MAX) {
        others.truncate(SKIPPED_MAX);
        others.push(format!("{more} more"));
    }
    if runs.is_empty() {
        let why = "it has no metrics.csv, which `driml train` and `driml watch --run-dir` write; a sweep's runs are in its folder runs";
        let others = others.join(", ");
        return Err(usage!("{others} is not the folder of a run: {why}").into());
    }
    for other in others {
        console::eprintln(&format!("skipped {other}: not the folder of a run"));
    }
    Ok(runs)
}

fn charts_figure(args: &PlotArgs) -> anyhow::Result<Figure> {
    let runs = run_folders(args)?.into_iter();
    let runs = runs.map(|it| Run::read_comparing(&it, &args.compared));
    let runs = runs.collect::<anyhow::Result<Vec<_>>>()?;
    let named = |column: &String| {
        let word = SHORT_NAMES.iter().find(|(word, _)| word == column);
        word.map_or_else(|| column.clone(), |(_, column)| (*column).to_owned())
    };
    let columns = match &args.column[..] {
        [] => overview_columns(&runs),
        columns => columns.iter().map(named).collect(),
    };
    let groups = groups::group_runs(&runs, !args.separate);
    let warnings = groups.iter().flat_map(Group::warnings);
    warnings.for_each(|line| console::eprintln(&line));
    let is_return = |column: &String| column == RETURN || column == EVALUATED;
    if args.random.is_some() && !columns.iter().any(is_return) {
        return Err(usage!("--random draws a line over {RETURN:?}: add --column return").into());
    }
    let random = match args.random {
        Some(episodes) => random_means(&runs, episodes as usize)?,
        None => Vec::new(),
    };
    let mut panels = Vec::new();
    for column in &columns {
        // A column that no run has is an error.
        if !runs.iter().any(|run| run.has_values(column)) {
            runs[0].values(args.x.column(), column)?;
        }
        let reports = |run: &Run| run.auxiliary_losses().contains(column);
        let is_loss = runs.iter().any(reports);
        let (mut series, mut apart) = (Vec::new(), Vec::new());
        for (index, group) in groups.iter().enumerate() {
            // Agents differ in their losses: a loss that only other agents report is not drawn for this group.
            if is_loss && !group.runs.iter().any(|run| reports(run)) {
                continue;
            }
            let curve = group.curve(column, args)?;
            if curve.points.is_empty() && group.runs.iter().any(|run| run.has_values(column)) {
                apart.push(format!(
                    "{} is not in the chart of {column}: its seeds share no range of {}; --separate draws each",
                    group.name,
                    args.x.column()
                ));
            }
            series.extend((!curve.points.is_empty()).then(|| curve.series(&group.name, index)));
        }
        if !args.column.is_empty() && series.is_empty() {
            let none = format!("none of these runs has a value of {column:?} yet");
            return Err(Usage(apart.pop().unwrap_or(none)).into());
        }
        apart.iter().for_each(|line| console::eprintln(line));
        // The overview also draws k and losses that some agents do not have.
        let all = column == RETURN || !args.column.is_empty();
        missing_messages(column, all, &groups).for_each(|line| console::eprintln(&line));
        if is_return(column) {
            series.extend(random_lines(&random, &series, groups.len()));
        }
        let (title, y) = title_and_label(column, is_loss);
        let (x, y) = (Axis::linear(args.x.column()), Axis::linear(&y));
        panels.push(Panel::Chart(Chart::new(&title, x, y, series)));
    }
    let (grid, panel_size) = match panels.len() {
        0 => return Err(usage!("none of these runs has recorded a value yet").into()),
        1 => (1, (860.0, 420.0)),
        _ => (2, CHART_SIZE),
    };
    Ok(Figure {
        title: match &groups[..] {
            [only] => only.name.clone(),
            _ => format!("{} configurations compared", groups.len()),
        },
        notes: notes(args, &groups, &columns),
        columns: grid,
        panel_size,
        panels,
    })
}

/// Returns the title of a column's chart and the label of its y axis.
fn title_and_label(column: &str, is_auxiliary_loss: bool) -> (String, String) {
    let named = column.replace('_', " ");
    match metrics::find_column(column) {
        _ if is_auxiliary_loss => {
            let title = format!("{} loss", loss_title(column));
            (title, "auxiliary loss [nats]".into())
        }
        _ if column == EVALUATED => {
            let title = "Return of checkpoints, played greedily";
            (title.into(), "mean over episodes".into())
        }
        Some(it) if it.name == column => (it.plot_label.into(), it.unit.into()),
        // The column is one of several that share a description.
        Some(it) => (named, it.unit.into()),
        None => (named.clone(), named),
    }
}

fn notes(args: &PlotArgs, groups: &[Group<'_>], columns: &[String]) -> Vec<String> {
    let mut notes = Vec::new();
    if groups.iter().any(|group| group.runs.len() > 1) {
        notes.push(format!(
            "Seeds are one line, their mean where all have values; the band is {}.",
            match args.band {
                Band::Range => "their smallest and largest value",
                Band::Sd => "one standard deviation to each side",
                Band::Ci => "the 95% interval of that mean (Student's t)",
            }
        ));
    }
    let mut all = groups.iter().flat_map(|group| &group.runs);
    let has_spread = all.any(|run| run.has_values(SD_OF_K));
    if has_spread && columns.iter().any(|column| column == "mean_k") {
        let it = "The band around k is one standard deviation of k itself to each side, cut at 1.";
        notes.push(it.into());
    }
    match args.smooth {
        Some(width) => notes.push(format!(
            "Smoothed: each point is the mean over the {width} {} before it.",
            args.x.column()
        )),
        None => notes.push("Not smoothed.".into()),
    }
    if let Some(episodes) = args.random {
        let episodes = count(episodes, "whole episode");
        notes.push(format!("Random policy: mean of {episodes}."));
    }
    notes
}

/// Returns a message for each run that has no value of a drawn column; unless `all`, only for runs of groups that have a line.
fn missing_messages(column: &str, all: bool, groups: &[Group<'_>]) -> impl Iterator<Item = String> {
    let why = match column {
        RETURN => "no episode has ended in it",
        _ => "it has no value",
    };
    let named = groups.iter().map(|it| &it.runs);
    let named = named.filter(move |it| all || it.iter().any(|run| run.has_values(column)));
    let absent = named.flatten().filter(move |run| !run.has_values(column));
    absent.map(move |run| {
        let run = run.folder.display();
        format!("{run} is not in the chart of {column}: {why}")
    })
}

/// Returns the mean return of a random policy in each of the runs' worlds, with the name of the world.
fn random_means(runs: &[Run], episodes: usize) -> anyhow::Result<Vec<(String, f64)>> {
    let (mut known, mut found) = (Vec::new(), Vec::new());
    for run in runs {
        let config = read_config(&run.folder)?;
        let task = (config.world.clone(), config.actor.actions);
        if !known.contains(&task) {
            let (mean, _) = mean_and_deviation(&random_returns(&config, episodes, 0, || false)?);
            // Two tasks may have the same world, with other settings of it or other actions.
            let mut name = config.run.world.clone();
            if found.iter().any(|(other, _)| *other == name) {
                name += &format!(" as in {}", run.folder.display());
            }
            found.push((name, mean));
            known.push(task);
        }
    }
    Ok(found)
}

/// Returns horizontal lines from 0 to the end of the longest curve. Lines of several worlds have colours that no run uses.
fn random_lines(random: &[(String, f64)], curves: &[Series], groups: usize) -> Vec<Series> {
    let xs = curves.iter().flat_map(|it| &it.points);
    let last = xs.map(|point| point.0).fold(0.0, f64::max);
    let line = |(at, (world, mean)): (usize, &(String, f64))| {
        let ends = vec![(0.0, *mean), (last, *mean)];
        let line = match random {
            [_] => Series::line("random policy", 0, ends).with_colour(GREY),
            _ => Series::line(&format!("random policy, {world}"), groups + at, ends),
        };
        line.with_mark(Mark::Dashed)
    };
    random.iter().enumerate().map(line).collect()
}

#[cfg(test)]
mod tests;
