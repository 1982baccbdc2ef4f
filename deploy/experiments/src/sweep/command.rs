//! `driml sweep`: makes a run for each combination of settings and each seed, then a table and a plot of all runs.
//! `axes` decides which runs there are, and `queue` makes them.

use std::collections::BTreeMap;

use anyhow::bail;
use driml_launch::console::{align_columns, print_wrapped};
use driml_machine::{error::usage, shell::quoted};
use driml_settings::presets;
use serde::{Deserialize, Serialize};

use super::{
    axes::{Axis, Cell, RUNS_MAX, cells},
    plan::{PlannedRun, PointRun, TrainCall, install_worlds},
    queue,
};
use crate::{
    cache::{self, Session, settings_of},
    flags::{ExperimentFlags, SEEDS_MAX, SweepArgs},
    plot::{self, flags::PlotArgs},
    stats::{Spread, interval},
};

/// The name of the default folder, the table and the plot.
const NAME: &str = "sweep";
/// The most letters that describe a cell in the name of a run's folder.
const NAME_LETTERS_MAX: usize = 80;
const MEASURED: &str =
    "seeds,mean_return,sd,ci_low,ci_high,lowest,highest,updates_per_second,minutes";
const LEGEND: &str = "mean_return: of each run's last 100 training episodes, then over seeds; sd over seeds, ci_low and ci_high the mean's 95% \
                      interval (Student's t)\n";

/// What all runs of a folder share. The seeds and the number of runs at once may differ between calls.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Settings {
    axes: Vec<Axis>,
    frames: Option<u64>,
    preset: Option<String>,
}

/// Makes the missing runs of every combination of settings and every seed, then the table and the plot.
pub fn run(args: &SweepArgs) -> anyhow::Result<()> {
    let flags = ExperimentFlags {
        out: args.out.clone(),
        ..ExperimentFlags::default()
    };
    let stored = || settings_of::<Settings>(NAME, &flags);
    let (settings, seeds) = resolve_settings(args, stored())?;
    if let Some(other) = stored().filter(|it| *it != settings) {
        bail!(usage!(
            "{} holds the runs of `{}`, not of `{}`: choose another --out, or remove that folder",
            cache::folder(NAME, &flags).display(),
            other.command(),
            settings.command()
        ));
    }
    let axes = &settings.axes;
    let cells = cells(axes, args.seeds)?;
    // A report asks for `SEEDS_MAX` seeds; no sweep has more than `RUNS_MAX` runs.
    let seeds = seeds.min((RUNS_MAX / cells.len()) as u32);
    let (mut plans, mut known) = (Vec::new(), BTreeMap::new());
    for (at, cell) in cells.iter().enumerate() {
        let config = settings.call(cell, 1).config();
        let config = config.map_err(|e| match &describe(cell)[..] {
            "" => e,
            cell => usage!("{cell}: {e}"),
        })?;
        // A report may be made on another machine, on which values such as `auto` mean something else.
        let same = known.insert(config.to_toml(), cell);
        if let Some(same) = same.filter(|_| !args.report) {
            let [same, cell] = [same, cell].map(describe);
            bail!(usage!("{same} and {cell} are the same run: leave one out"));
        }
        plans.extend((1..=seeds).map(|seed| {
            let name = format!("{}-seed{seed}", folder_name(axes, cell, at));
            let call = settings.call(cell, seed);
            (at, PlannedRun::new(&name, call, config.frames()))
        }));
    }
    plans.sort_by_key(|(_, plan)| plan.call.seed);
    install_worlds(&plans, args.report)?;
    let mut session = Session::open(NAME, &flags, &settings, 0, args.report)?;
    let finished = queue::run_all(&mut session, plans, args.jobs)?;
    session.progress.clear();
    let rows = table_rows(&cells, &finished);
    let names = axes.iter().map(|axis| axis.name.as_str());
    let header: Vec<_> = names.chain(MEASURED.split(',')).map(String::from).collect();
    session.write_csv(NAME, &header.join(","), &rows)?;
    // An axis by the last part of its name, unless two axes end alike.
    let end = |it: &String| it.rsplit('.').next().unwrap_or(it).to_owned();
    let is_only = |it: &String| header.iter().filter(|other| end(other) == end(it)).count() == 1;
    let short = |it: &String| if is_only(it) { end(it) } else { it.clone() };
    let mut lines = [vec![header.iter().map(short).collect()], rows].concat();
    // The columns from `lowest` to `updates_per_second` are in the file alone, as a terminal is narrow.
    for line in &mut lines {
        line.drain(axes.len() + 5..axes.len() + 8);
    }
    print_wrapped(&(align_columns(&lines, &[]) + LEGEND), 4)?;
    session.check_has_runs(&finished)?;
    let runs = finished.iter().map(|it| it.run.folder.path().to_owned());
    let varied = axes.iter().filter(|axis| axis.values.len() > 1);
    plot::run(&PlotArgs {
        runs: runs.collect(),
        compared: varied.map(|axis| axis.name.clone()).collect(),
        out: session.folder.join(format!("{NAME}.svg")),
        ..PlotArgs::default()
    })?;
    session.check_none_missing()
}

/// Returns the settings and the number of seeds of a call. A report that names no axis uses the `stored` settings and all seeds. A call
/// that differs from the `stored` settings in the order of its flags or values uses their order, which the names of the runs depend on.
fn resolve_settings(args: &SweepArgs, stored: Option<Settings>) -> anyhow::Result<(Settings, u32)> {
    let given = Settings {
        axes: parse_axes(args)?,
        frames: args.frames,
        preset: args.preset.clone(),
    };
    Ok(match stored {
        Some(stored) if args.report && given.axes.is_empty() => {
            let settings = Settings {
                axes: stored.axes,
                frames: given.frames.or(stored.frames),
                preset: given.preset.or(stored.preset),
            };
            (settings, SEEDS_MAX)
        }
        Some(stored) if stored.sorted() == given.sorted() => (stored, args.seeds),
        _ => (given, args.seeds),
    })
}

/// Returns the axes of a call: `--env` and `--agent` first, if given, then each `--set` in the order of the command line.
fn parse_axes(args: &SweepArgs) -> anyhow::Result<Vec<Axis>> {
    let mut axes = Vec::new();
    for (name, values) in [("env", &args.env), ("agent", &args.agent)] {
        let axis = Axis {
            name: name.into(),
            values: values.clone(),
        };
        axis.check_values(&format!("--{name} takes a list, such as --{name} A,B"))?;
        axes.extend((!values.is_empty()).then_some(axis));
    }
    for set in &args.sets {
        let axis = Axis::parse(set)?;
        if axes.iter().any(|known| known.name == axis.name) {
            return Err(usage!(
                "{} is set twice: give its values in one --set, separated by commas",
                axis.name
            )
            .into());
        }
        axes.push(axis);
    }
    Ok(axes)
}

impl Settings {
    /// The same combinations in an order that does not depend on the command line.
    fn sorted(&self) -> Self {
        let mut sorted = self.clone();
        sorted.axes.iter_mut().for_each(|it| it.values.sort());
        sorted.axes.sort_by(|a, b| a.name.cmp(&b.name));
        sorted
    }

    /// The command with these settings, for a person who compares it with another.
    fn command(&self) -> String {
        let axes = self.axes.iter().map(|Axis { name, values }| {
            let values = values.join(",");
            match name.as_str() {
                "env" | "agent" => format!("--{name} {}", quoted(&values)),
                _ => format!("--set {}", quoted(&format!("{name}={values}"))),
            }
        });
        let mut words = vec!["driml sweep".to_owned()];
        words.extend(axes);
        words.extend(self.preset.iter().map(|it| format!("--preset {it}")));
        words.extend(self.frames.iter().map(|it| format!("--frames {it}")));
        words.join(" ")
    }

    fn call(&self, cell: &Cell, seed: u32) -> TrainCall {
        let mut call = TrainCall {
            preset: self.preset.clone(),
            seed,
            frames: self.frames,
            ..TrainCall::default()
        };
        for (name, value) in cell {
            match name.as_str() {
                // The user may name a game without its `procgen:`.
                "env" => call.env = Some(world_name(value)),
                "agent" => call.agent = Some(value.clone()),
                _ => call.sets.push(format!("{name}={value}")),
            }
        }
        call
    }
}

fn world_name(world: &str) -> String {
    presets::world(world).map_or_else(|_| world.to_owned(), |it| it.to_string())
}

fn describe(cell: &Cell) -> String {
    let words = cell.iter().map(|(name, value)| format!("{name}={value}"));
    words.collect::<Vec<_>>().join(", ")
}

/// Returns a name for the runs of a cell: its number, and its values on the axes that vary.
fn folder_name(axes: &[Axis], cell: &Cell, at: usize) -> String {
    let mut name = (at + 1).to_string();
    let varied = axes.iter().zip(cell);
    for (_, (axis, value)) in varied.filter(|(axis, _)| axis.values.len() > 1) {
        let key = axis.rsplit('.').next().unwrap_or_default();
        let value = value.replace("procgen:", "");
        name += &match axis.as_str() {
            "env" | "agent" => format!("-{value}"),
            _ => format!("-{key}={value}"),
        };
    }
    name.chars().take(NAME_LETTERS_MAX).collect()
}

/// Returns the table, a row for each cell of the grid; a missing number is empty. The `point` of a run is the number of its cell.
fn table_rows(cells: &[Cell], finished: &[PointRun<usize>]) -> Vec<Vec<String>> {
    let row = |(at, cell): (usize, &Cell)| {
        let here = finished.iter().filter(|it| it.point == at);
        let runs: Vec<_> = here.map(|it| &it.run.summary).collect();
        let returns: Vec<f64> = runs.iter().filter_map(|it| it.mean_return).collect();
        let (low, high) = interval(&returns).and_then(|it| it.ends).unzip();
        let returns = Spread::of(returns);
        let speed = Spread::of(runs.iter().map(|it| it.updates_per_second));
        let minutes = Spread::of(runs.iter().map(|it| it.wall_seconds / 60.0));
        let numbers = [
            (returns.map(|it| it.mean), 3),
            (returns.filter(|it| it.count > 1).map(|it| it.sd), 3),
            (low, 3),
            (high, 3),
            (returns.map(|it| it.min), 3),
            (returns.map(|it| it.max), 3),
            (speed.map(|it| it.mean), 2),
            (minutes.map(|it| it.mean), 1),
        ];
        let numbers = numbers.map(|(number, decimals)| {
            number.map_or(String::new(), |it| format!("{it:.decimals$}"))
        });
        let values = cell.iter().map(|it| it.1.clone());
        let row = values.chain([runs.len().to_string()]).chain(numbers);
        row.collect()
    };
    cells.iter().enumerate().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flags::tests::parse;

    #[test]
    fn a_report_need_not_repeat_what_the_folder_was_made_with() {
        let of = |line: &str, stored| resolve_settings(&parse(line), stored).unwrap();
        let stored = || Some(of("--agent c51,curl --frames 320", None).0);
        assert_eq!(of("--report", stored()), (stored().unwrap(), SEEDS_MAX));
        let given = of("--report --agent c51 --seeds 2", stored());
        assert_eq!(given, of("--agent c51 --seeds 2", None));
    }

    #[test]
    fn the_order_of_flags_and_values_makes_no_other_sweep() {
        let of = |line: &str, stored| resolve_settings(&parse(line), stored).unwrap();
        let made = of("--agent c51,curl --set a.b=1,2 --set c.d=3", None).0;
        for (line, is_same) in [
            ("--set c.d=3 --set a.b=2,1 --agent curl,c51", true),
            ("--set c.d=3 --set a.b=2 --agent curl,c51", false),
        ] {
            let found = of(line, Some(made.clone())).0;
            assert_eq!(found == made, is_same, "{line}");
        }
    }

    #[test]
    fn the_command_of_a_folder_has_the_same_settings() {
        let line = "--env chain --agent c51,curl --set learner.batch_size=64,256 --preset smoke --frames 320";
        let (settings, _) = resolve_settings(&parse(line), None).unwrap();
        assert_eq!(settings.command(), format!("driml sweep {line}"));
    }

    #[test]
    fn folders_are_named_for_what_changes() {
        let axes = [
            "env=procgen:maze",
            "agent=c51,curl",
            "learner.update.adam.lr=1e-4,2.5e-4",
            "run.horizon=[1, 2],x y",
        ]
        .map(|it| Axis::parse(it).unwrap());
        let cells = cells(&axes, 1).unwrap();
        let name = |at: usize| folder_name(&axes, &cells[at], at);
        assert_eq!(name(0), "1-c51-lr=1e-4-horizon=[1, 2]");
        assert_eq!(name(7), "8-curl-lr=2.5e-4-horizon=x y");
    }

    #[test]
    fn a_game_may_be_named_alone() {
        assert_eq!(world_name("maze"), "procgen:maze");
        assert_eq!(world_name("chain"), "chain");
        assert_eq!(world_name("exec:python3 world.py"), "exec:python3 world.py");
    }
}
