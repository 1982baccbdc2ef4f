//! `driml bench peers`: measures our program and its peers in turn, round after round, and shows each ratio beside its goal.
//! `pairs` lists the comparisons. A goal that is missed is shown and is not an error.

mod pairs;
mod script;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
};

use anyhow::Context;
use clap::ValueEnum;
use driml_launch::{
    console::{self, align_columns},
    output,
};
use driml_machine::{resources::MachineInfo, speed_meter::median, units};
use serde::Serialize;

use crate::{
    flags::{BenchFlags, BenchPeersArgs, Component},
    peers::{
        pairs::{Pair, pairs},
        script::{Answer, Script},
    },
    recording::Recording,
    report::{self, Figures},
};

/// The load above which another program is running, which slows the two sides unequally.
const LOAD_MAX: f64 = 0.5;

/// A component's figures, and those of its peer or the reason why there are none.
#[derive(Debug, Default)]
struct Sides {
    ours: Figures,
    theirs: BTreeMap<String, Vec<f64>>,
    peer: String,
    absent: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
struct Row {
    #[serde(rename = "part")]
    component: String,
    what: String,
    unit: String,
    /// Median over the rounds.
    ours: f64,
    peer: String,
    /// Median over the rounds; none if skipped.
    theirs: Option<f64>,
    /// The median over the rounds of ours / theirs, taken in each round because the machine's speed drifts from round to round.
    ratio: Option<f64>,
    ratios: Vec<f64>,
    /// The goal: the lowest ratio that is wanted, if any.
    goal: Option<f64>,
    skipped: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
struct Comparison {
    rounds: u32,
    quick: bool,
    threads: u32,
    /// The machine, as it was before the first measurement.
    machine: MachineInfo,
    rows: Vec<Row>,
}

/// Measures, and reports. A peer that is missing or fails is reported as skipped.
pub(super) fn run(
    args: &BenchPeersArgs,
    flags: &BenchFlags,
    machine: MachineInfo,
) -> anyhow::Result<()> {
    let rounds = args.rounds.unwrap_or(flags.unless_quick(5, 1));
    let components: BTreeSet<_> = match args.only.as_slice() {
        [] => Component::value_variants().iter().copied().collect(),
        only => only.iter().copied().collect(),
    };
    let folder = output::temporary_folder()?;
    for (path, text) in script::SCRIPTS {
        let name = Path::new(path).file_name().expect("a script has a name");
        let written = fs::write(folder.path().join(name), text);
        written.with_context(|| format!("writing {}", name.display()))?;
    }
    let frames = folder.path().join("frames");
    if components.contains(&Component::Replay) {
        Recording::record()?.write_frames(&frames)?;
    }
    let mut sides = BTreeMap::new();
    for component in components {
        let script = Script::new(component, args, flags, &frames);
        let mut found = Sides {
            peer: script.peer.to_owned(),
            ..Sides::default()
        };
        if let Err(why) = script.check() {
            found.skip(why);
        }
        sides.insert(component, (script, found));
    }
    for round in 1..=rounds {
        for (component, (script, sides)) in &mut sides {
            let name = component.name();
            console::eprintln(&format!("round {round} of {rounds}: {name} of ours"));
            let ours = script::ours(*component, flags)?;
            ours.into_iter().for_each(|it| sides.ours.add(it));
            if sides.absent.is_none() {
                console::eprintln(&format!("round {round} of {rounds}: {}", sides.peer));
                match script.run(folder.path()) {
                    Ok(answer) => sides.add_theirs(answer),
                    Err(why) => sides.skip(format!("{why:#}")),
                }
            }
        }
    }
    let rows = pairs().into_iter().filter_map(|pair| {
        let (_, sides) = sides.get(&pair.component)?;
        compare(&pair, sides)
    });
    let comparison = Comparison {
        rounds,
        quick: flags.quick,
        threads: flags.threads,
        machine,
        rows: rows.collect(),
    };
    let table = format_table(&comparison);
    report::publish(&comparison, &table, flags.json.as_deref())
}

impl Sides {
    fn add_theirs(&mut self, answer: Answer) {
        self.peer = answer.peer;
        for (what, value) in answer.figures {
            self.theirs.entry(what).or_default().push(value);
        }
    }

    fn skip(&mut self, why: String) {
        console::eprintln(&format!("skipped: {why}"));
        self.absent = Some(why);
    }
}

/// Returns medians and ratio of one pair; `None` if ours was not measured, as in a precision that was not selected.
fn compare(pair: &Pair, sides: &Sides) -> Option<Row> {
    let (ours, unit) = sides.ours.values_of(&pair.ours)?;
    let what = &pair.theirs;
    let theirs = match pair.own_figure {
        Some(_) => sides.ours.values_of(what).map(|(values, _)| values),
        None => sides.theirs.get(what).map(Vec::as_slice),
    };
    let peer = match pair.own_figure {
        Some(name) => name.to_owned(),
        None if *what == pair.ours => sides.peer.clone(),
        None => format!("{}: {what}", sides.peer),
    };
    let rounds = ours.iter().zip(theirs.unwrap_or_default());
    let ratios: Vec<_> = rounds.map(|(ours, theirs)| ours / theirs).collect();
    let unknown = || format!("{peer} was not measured");
    let absent = || sides.absent.clone().unwrap_or_else(unknown);
    // A peer may fail in a later round; its earlier values are not the whole comparison.
    let failed = pair.own_figure.is_none() && sides.absent.is_some();
    Some(Row {
        component: pair.component.name(),
        what: pair.ours.clone(),
        unit: unit.into(),
        ours: median(ours),
        theirs: theirs.map(median),
        ratio: theirs.map(|_| median(&ratios)),
        ratios,
        goal: pair.goal,
        skipped: (theirs.is_none() || failed).then(absent),
        peer,
    })
}

fn format_table(comparison: &Comparison) -> String {
    let heads = ["what", "ours", "theirs", "", "", "ratio", "goal", ""];
    let mut cells = vec![heads.map(String::from).to_vec()];
    let mut skipped = BTreeSet::new();
    for row in &comparison.rows {
        let number = |value: Option<f64>| value.map_or("-".into(), units::format_number);
        let verdict = match (row.ratio, row.goal) {
            _ if row.skipped.is_some() => "skipped",
            (_, None) => "",
            (Some(ratio), Some(goal)) if ratio >= goal => "reached",
            _ => "missed",
        };
        cells.push(vec![
            row.what.clone(),
            number(Some(row.ours)),
            number(row.theirs),
            row.unit.clone(),
            row.peer.clone(),
            number(row.ratio),
            number(row.goal),
            verdict.into(),
        ]);
        skipped.extend(row.skipped.iter().map(|why| format!("skipped: {why}\n")));
    }
    let mut text = align_columns(&cells, &[1, 2, 5, 6]);
    text.extend(skipped);
    let rounds = units::count(comparison.rounds, "round");
    let threads = units::count(comparison.threads, "thread");
    let machine = &comparison.machine;
    let (processor, load) = (&machine.processor, machine.load);
    let cores = units::count(machine.cores, "core");
    text.push_str(&format!(
        "ours, theirs: medians of {rounds}; ratio: median of the rounds' ratios. {threads}; {processor}, {cores}.\n"
    ));
    if load > LOAD_MAX {
        text.push_str(&format!(
            "The machine was not idle before: {} tasks wanted a core. These figures are not reliable.\n",
            units::format_number(load)
        ));
    }
    if comparison.quick {
        text.push_str("Quick: a few iterations only; these figures are not reliable.\n");
    }
    text
}

#[cfg(test)]
mod tests;
