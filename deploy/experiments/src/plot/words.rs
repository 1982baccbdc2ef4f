//! What a figure of runs says: titles and labels of columns, and what was done to the numbers.
//! It draws nothing.

use driml_launch::metrics;

use super::{
    flags::{Band, PlotArgs},
    groups::Group,
    runs,
};

/// The column of what checkpoints earned when they were played.
pub(super) const EVALUATED: &str = "evaluated_return";

/// Title and label of a column's chart, with its unit.
pub(super) fn words(column: &str) -> (String, String) {
    if column == EVALUATED {
        return (
            "Return of checkpoints, played greedily".into(),
            "mean over episodes".into(),
        );
    }
    let named = column.replace('_', " ");
    match metrics::column(column) {
        Some(it) if it.name == column => (it.plot_label.into(), it.unit.into()),
        // One of several things.
        Some(it) => (named, it.unit.into()),
        None => (named.clone(), named),
    }
}

pub(super) fn title(groups: &[Group<'_>]) -> String {
    match groups {
        [only] => only.name.clone(),
        _ => format!("{} configurations compared", groups.len()),
    }
}

/// What was done to the numbers.
pub(super) fn notes(args: &PlotArgs, groups: &[Group<'_>], columns: &[String]) -> Vec<String> {
    let mut notes = Vec::new();
    if groups.iter().any(|group| group.runs.len() > 1) {
        notes.push(format!(
            "Runs that differ in their seed alone are one line, their mean; the band is {}.",
            match args.band {
                Band::Range => "their smallest and largest value",
                Band::Sd => "one standard deviation to each side",
                Band::Ci => "the 95% interval of that mean (Student's t)",
            }
        ));
    }
    let mut all = groups.iter().flat_map(|group| &group.runs);
    let has_spread = all.any(|run| run.has_values(runs::SPREAD_OF_K));
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
        notes.push(format!("Random policy: mean of {episodes} whole episodes."));
    }
    notes
}
