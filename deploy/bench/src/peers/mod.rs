//! `driml bench peers`: ours and theirs in turn, round after round, and the ratio of each pair beside its goal.
//! What is compared with what is in `pairs`; a goal that is missed is shown and is no error.

mod pairs;
mod script;

use std::collections::{BTreeMap, BTreeSet};

use anyhow::Context;
use driml_launch::console;
use driml_learner::DeviceName;
use serde::{Deserialize, Serialize};

use crate::{
    alone,
    effort::median,
    flags::{BenchPeersArgs, Component},
    measurements::{self, MachineNote, Measurement},
    peers::{
        pairs::{PAIRS, Pair, Theirs},
        script::{Absent, Script},
    },
    recording::Recording,
    table,
};

/// The load above which something else is running, which slows the two sides unequally.
const LOAD_MAX: f64 = 0.5;
/// Rounds, and those of a quick comparison.
const ROUNDS: (u32, u32) = (5, 1);

/// What one side found in every round, by what was measured.
type Samples = BTreeMap<String, Vec<f64>>;

/// A component's figures, and its peer's or why there are none.
#[derive(Debug, Default)]
struct Sides {
    ours: Samples,
    theirs: Samples,
    units: BTreeMap<String, String>,
    peer: String,
    absent: Option<String>,
}

/// One line of the comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Row {
    #[serde(rename = "part")]
    component: String,
    what: String,
    unit: String,
    /// Median over the rounds.
    ours: f64,
    /// The peer, with its version.
    peer: String,
    /// Median over the rounds; none if skipped.
    theirs: Option<f64>,
    /// Median over the rounds of ours by theirs, as the machine's speed drifts from round to round.
    ratio: Option<f64>,
    /// That of each round.
    ratios: Vec<f64>,
    /// The least ratio that is wanted, if one is.
    goal: Option<f64>,
    /// Why there is nothing of the peer's.
    skipped: Option<String>,
}

/// The comparison, as it is written to JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Comparison {
    rounds: u32,
    quick: bool,
    threads: u32,
    /// Before the first measurement.
    machine: MachineNote,
    rows: Vec<Row>,
}

/// Measures, and reports.
///
/// # Errors
/// A component of ours that failed, or a file that cannot be written. A peer that is missing or fails is reported as skipped.
pub(super) fn run(args: &BenchPeersArgs) -> anyhow::Result<()> {
    let rounds = args.rounds.unwrap_or(match args.flags.quick {
        true => ROUNDS.1,
        false => ROUNDS.0,
    });
    let components: BTreeSet<_> = match args.only.as_slice() {
        [] => PAIRS.iter().map(|pair| pair.component).collect(),
        only => only.iter().copied().collect(),
    };
    let machine = MachineNote::this();
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    script::write_all(folder.path())?;
    let frames = folder.path().join("frames");
    if components.contains(&Component::Replay) {
        Recording::play()?.write_frames(&frames)?;
    }
    let mut sides = BTreeMap::new();
    for &component in &components {
        let script = Script::new(component, args, folder.path(), &frames);
        let mut found = Sides {
            peer: script.peer().name().to_owned(),
            ..Sides::default()
        };
        if let Err(absent) = script.check() {
            found.skip(absent);
        }
        sides.insert(component, (script, found));
    }
    for round in 1..=rounds {
        for (component, (script, sides)) in &mut sides {
            console::line(&format!(
                "round {round} of {rounds}: {} of ours",
                component.name()
            ));
            sides.add_ours(alone::figures(
                *component,
                &[],
                &args.flags,
                DeviceName::Cpu,
            )?);
            if sides.absent.is_none() {
                console::line(&format!("round {round} of {rounds}: {}", sides.peer));
                match script.run() {
                    Ok((peer, figures)) => sides.add_theirs(peer, figures),
                    Err(absent) => sides.skip(absent),
                }
            }
        }
    }
    let precisions = args.flags.precisions(DeviceName::Cpu);
    let is_measured =
        |pair: &&Pair| sides.contains_key(&pair.component) && pair.is_asked(&precisions);
    let rows = PAIRS.iter().filter(is_measured).map(|pair| {
        let (_, sides) = &sides[&pair.component];
        row(pair, sides).with_context(|| format!("comparing {:?}", pair.ours))
    });
    let comparison = Comparison {
        rounds,
        quick: args.flags.quick,
        threads: args.flags.threads,
        machine,
        rows: rows.collect::<anyhow::Result<_>>()?,
    };
    measurements::publish(
        &comparison,
        &describe(&comparison),
        args.flags.json.as_deref(),
    )
}

impl Sides {
    fn add_ours(&mut self, figures: Vec<Measurement>) {
        for Measurement { what, value, unit } in figures {
            self.units.insert(what.clone(), unit);
            self.ours.entry(what).or_default().push(value);
        }
    }

    fn add_theirs(&mut self, peer: String, figures: BTreeMap<String, f64>) {
        self.peer = peer;
        for (what, value) in figures {
            self.theirs.entry(what).or_default().push(value);
        }
    }

    /// Goes on without the peer.
    fn skip(&mut self, Absent(why): Absent) {
        console::line(&format!("skipped: {why}"));
        self.absent = Some(why);
    }
}

/// Medians and ratio of one pair; none if ours was not measured.
fn row(pair: &Pair, sides: &Sides) -> Option<Row> {
    let ours = sides.ours.get(pair.ours)?;
    let (peer, theirs) = match pair.theirs {
        Theirs::Peers(what) if what == pair.ours => (sides.peer.clone(), sides.theirs.get(what)),
        Theirs::Peers(what) => (format!("{}: {what}", sides.peer), sides.theirs.get(what)),
        Theirs::Ours(what, name) => (name.to_owned(), sides.ours.get(what)),
    };
    let rounds = ours.iter().zip(theirs.into_iter().flatten());
    let ratios: Vec<_> = rounds.map(|(ours, theirs)| ours / theirs).collect();
    let absent = || match &sides.absent {
        Some(why) => why.clone(),
        None => format!("{peer} was not measured"),
    };
    Some(Row {
        component: pair.component.name().into(),
        what: pair.ours.into(),
        unit: sides.units.get(pair.ours)?.clone(),
        ours: median(ours),
        theirs: theirs.map(|theirs| median(theirs)),
        ratio: theirs.map(|_| median(&ratios)),
        ratios,
        goal: pair.goal,
        skipped: theirs.is_none().then(absent),
        peer,
    })
}

/// The table, and below it why rows were skipped.
fn describe(comparison: &Comparison) -> String {
    let mut cells = vec![
        ["what", "ours", "theirs", "", "", "ratio", "goal", ""]
            .map(String::from)
            .to_vec(),
    ];
    let mut skipped = BTreeSet::new();
    for row in &comparison.rows {
        let number = |value: Option<f64>| value.map_or("-".into(), table::number);
        let verdict = match (row.ratio, row.goal) {
            (None, _) => "skipped",
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
    let Comparison {
        rounds,
        threads,
        machine,
        ..
    } = comparison;
    let mut text = table::aligned(&cells, &[1, 2, 5, 6]);
    text.extend(skipped);
    text.push_str(&format!(
        "Medians of {rounds} rounds of ours, theirs; the ratio is the median of the rounds' ratios. {threads} threads; {}, {} cores.\n",
        machine.processor, machine.cores
    ));
    if machine.load > LOAD_MAX {
        text.push_str(&format!(
            "The machine was not idle before: {} tasks wanted a core. These are no figures to go by.\n",
            table::number(machine.load)
        ));
    }
    if comparison.quick {
        text.push_str("Quick: a few iterations only, no figures to go by.\n");
    }
    text
}

#[cfg(test)]
mod tests;
