//! `driml grid`: a run for each combination of settings and each seed, a table and a plot of them at the end.
//! Runs are made by `queue`; which there are follows from `axes`.

mod axes;

use driml_envs::WorldName;
use driml_launch::console::{self, print};
use driml_machine::{error::usage, resources::Machine};
use driml_settings::{
    config::RunConfig,
    flags::{RunFlags, resolve},
    resolve::Flags,
};
use serde_json::json;

use self::axes::{Axis, Cell, cells};
use crate::{
    flags::GridArgs,
    plot::{self, flags::PlotArgs},
    queue,
    runs::{FinishedRun, PlannedRun},
    session::Session,
    statistics::{Spread, interval},
};

/// Most letters of a cell in the name of a run's folder.
const NAME_LETTERS: usize = 80;

/// Makes the runs that are not there yet, then the table and the plot.
///
/// # Errors
/// A combination that cannot work, before anything starts; a folder of another grid, an interrupt, runs that failed.
pub(super) fn run(args: &GridArgs) -> anyhow::Result<()> {
    let axes = axes_of(args)?;
    let cells = cells(&axes, args.seeds)?;
    let configs = cells
        .iter()
        .map(|cell| config_of(args, &axes, cell))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut plans = Vec::new();
    // Seed by seed, so that a grid that was stopped has one seed of everything before it has two of anything.
    for seed in 1..=args.seeds {
        for (at, (cell, config)) in cells.iter().zip(&configs).enumerate() {
            plans.push(plan(args, &axes, cell, config, at, seed));
        }
    }
    if !args.report {
        for config in &configs {
            config.world.install(&mut console::line)?;
        }
    }
    let units = plans.iter().map(|plan| plan.units).sum();
    // Other seeds, and more runs at once, are the same grid.
    let settings = json!({
        "axes": axes.iter().map(|axis| json!({ "name": axis.name, "values": axis.values })).collect::<Vec<_>>(),
        "preset": args.preset,
        "frames": args.frames,
    });
    let mut session = Session::open_queue("grid", &args.folder(), &settings, units, args.report)?;
    let ran = queue::run_all(&mut session, &plans, args.jobs, args.report)?;
    session.work().1.clear();
    let table = Table::of(&axes, &cells, &ran);
    table.write(&session)?;
    print(&table.text())?;
    let folders: Vec<_> = ran
        .iter()
        .flatten()
        .map(|run| run.folder.path().to_owned())
        .collect();
    if folders.is_empty() {
        return Err(usage!("no run is finished yet: there is nothing to draw").into());
    }
    plot::run(&PlotArgs::overview(
        folders,
        session.folder().join("grid.svg"),
    ))?;
    let missing: Vec<String> = plans
        .iter()
        .zip(&ran)
        .filter(|(_, ran)| ran.is_none())
        .map(|(plan, _)| plan.name.clone())
        .collect();
    queue::check_made(&missing, args.report)
}

/// Worlds and agents first, where there are several, then the settings as they were named.
fn axes_of(args: &GridArgs) -> anyhow::Result<Vec<Axis>> {
    let mut axes = Vec::new();
    for (name, values) in [("env", &args.env), ("agent", &args.agent)] {
        let axis = Axis::of_flag(name, values);
        axis.check(&format!("--{name} takes a list, such as --{name} A,B"))?;
        axes.extend((!values.is_empty()).then_some(axis));
    }
    for set in &args.sets {
        let axis = Axis::parse(set)?;
        if axes.iter().any(|known| known.name == axis.name) {
            return Err(usage!(
                "{} is set twice: give its values in one --set, parted by commas",
                axis.name
            )
            .into());
        }
        axes.push(axis);
    }
    Ok(axes)
}

/// The flags of `driml local` that make a cell's run.
fn flags_of(args: &GridArgs, axes: &[Axis], cell: &Cell, seed: u64) -> RunFlags {
    let value = |name: &str| {
        let at = axes.iter().position(|axis| axis.name == name)?;
        Some(cell[at].clone())
    };
    let set = axes
        .iter()
        .zip(cell)
        .filter(|(axis, _)| axis.name != "env" && axis.name != "agent")
        .map(|(axis, value)| format!("{}={value}", axis.name));
    RunFlags {
        // A game may be named alone.
        env: value("env").map(|name| full_name(&name)),
        agent: value("agent"),
        preset: args.preset.clone(),
        config: None,
        over: Flags {
            frames: args.frames,
            seed: Some(seed),
            sets: set.collect(),
            ..Flags::default()
        },
    }
}

fn full_name(world: &str) -> String {
    let game = format!("procgen:{world}");
    match (world.parse::<WorldName>(), game.parse::<WorldName>()) {
        (Err(_), Ok(_)) => game,
        _ => world.to_owned(),
    }
}

fn config_of(args: &GridArgs, axes: &[Axis], cell: &Cell) -> anyhow::Result<RunConfig> {
    let flags = flags_of(args, axes, cell, 1);
    let resolved = resolve(&flags, &Machine::this());
    let (config, _) = resolved.map_err(|e| match cell.is_empty() {
        true => e,
        false => usage!("{}: {e}", described(axes, cell)),
    })?;
    Ok(config)
}

/// Such as `agent=c51, learner.batch_size=64`: the axes along which something changes.
fn described(axes: &[Axis], cell: &Cell) -> String {
    let words = axes.iter().zip(cell);
    let words: Vec<_> = words
        .map(|(axis, value)| format!("{}={value}", axis.name))
        .collect();
    words.join(", ")
}

fn plan(
    args: &GridArgs,
    axes: &[Axis],
    cell: &Cell,
    config: &RunConfig,
    at: usize,
    seed: u32,
) -> PlannedRun {
    let flags = flags_of(args, axes, cell, seed.into());
    let mut words = vec!["--seed".to_owned(), seed.to_string()];
    let named = [
        ("--env", flags.env),
        ("--agent", flags.agent),
        ("--preset", flags.preset),
        ("--frames", flags.over.frames.map(|it| it.to_string())),
    ];
    for (flag, value) in named {
        words.extend(
            value
                .map(|value| [flag.to_owned(), value])
                .into_iter()
                .flatten(),
        );
    }
    for set in flags.over.sets {
        words.extend(["--set".to_owned(), set]);
    }
    PlannedRun {
        name: format!("{}-seed{seed}", folder_name(axes, cell, at)),
        args: words,
        frames: config.frames(),
        episodes: None,
        units: config.frames(),
    }
}

/// A name for a cell's runs: its number, and what a person knows it by.
fn folder_name(axes: &[Axis], cell: &Cell, at: usize) -> String {
    let mut name = (at + 1).to_string();
    for (axis, value) in axes
        .iter()
        .zip(cell)
        .filter(|(axis, _)| axis.values.len() > 1)
    {
        let key = axis.name.rsplit('.').next().unwrap_or_default();
        let value = value.replace("procgen:", "");
        match axis.name.as_str() {
            "env" | "agent" => name += &format!("-{value}"),
            _ => name += &format!("-{key}={value}"),
        }
    }
    let fits = |letter: char| letter.is_ascii_alphanumeric() || "-_=.+".contains(letter);
    let letters = name.chars().map(|it| if fits(it) { it } else { '-' });
    letters.take(NAME_LETTERS).collect()
}

/// What came out, a row a cell.
struct Table {
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Of the cells, whose runs are there seed by seed.
    fn of(axes: &[Axis], cells: &[Cell], ran: &[Option<FinishedRun>]) -> Self {
        let columns = [
            "seeds",
            "mean_return",
            "sd",
            "ci_low",
            "ci_high",
            "lowest",
            "highest",
            "updates_per_second",
            "minutes",
        ];
        let header = axes.iter().map(|axis| axis.name.clone());
        let row = |(at, cell): (usize, &Cell)| {
            let runs: Vec<&FinishedRun> =
                ran.iter().skip(at).step_by(cells.len()).flatten().collect();
            let returns: Vec<f64> = runs
                .iter()
                .filter_map(|run| run.summary.mean_return)
                .collect();
            let (found, returns) = (interval(&returns), Spread::of(returns));
            let ends = found.and_then(|it| it.ends);
            let of = |value: fn(&FinishedRun) -> f64| Spread::of(runs.iter().map(|run| value(run)));
            let number = |value: Option<f64>, decimals: usize| {
                value.map_or(String::new(), |value| format!("{value:.decimals$}"))
            };
            let measured = [
                runs.len().to_string(),
                number(returns.map(|it| it.mean), 3),
                number(returns.filter(|it| it.count > 1).map(|it| it.sd), 3),
                number(ends.map(|it| it.0), 3),
                number(ends.map(|it| it.1), 3),
                number(returns.map(|it| it.min), 3),
                number(returns.map(|it| it.max), 3),
                number(
                    of(|run| run.summary.updates_per_second).map(|it| it.mean),
                    2,
                ),
                number(
                    of(|run| run.summary.wall_seconds / 60.0).map(|it| it.mean),
                    1,
                ),
            ];
            cell.iter().cloned().chain(measured).collect()
        };
        Self {
            header: header.chain(columns.map(String::from)).collect(),
            rows: cells.iter().enumerate().map(row).collect(),
        }
    }

    fn write(&self, session: &Session) -> anyhow::Result<()> {
        let header: Vec<&str> = self.header.iter().map(String::as_str).collect();
        session.csv("grid", &header, self.rows.iter().cloned())
    }

    /// Columns that stand below each other.
    fn text(&self) -> String {
        let lines = || std::iter::once(&self.header).chain(&self.rows);
        let width = |column: usize| {
            let cells = lines().map(|line| line[column].chars().count());
            cells.max().unwrap_or_default()
        };
        let widths: Vec<usize> = (0..self.header.len()).map(width).collect();
        let mut text = String::new();
        for line in lines() {
            let cells = line.iter().zip(&widths);
            let padded: Vec<_> = cells
                .map(|(cell, &width)| format!("{cell:width$}"))
                .collect();
            text += padded.join("  ").trim_end();
            text.push('\n');
        }
        text + "mean_return: of each run's last 100 training episodes, then over seeds; sd over seeds, ci_low and ci_high the mean's 95% interval (Student's t)\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_are_named_for_what_changes() {
        let axes = [
            Axis::of_flag("env", &["procgen:maze".into()]),
            Axis::of_flag("agent", &["c51".into(), "curl".into()]),
            Axis::parse("learner.update.adam.lr=1e-4,2.5e-4").unwrap(),
            Axis::parse("run.horizon=[1, 2],x y").unwrap(),
        ];
        let cells = cells(&axes, 1).unwrap();
        assert_eq!(
            folder_name(&axes, &cells[0], 0),
            "1-c51-lr=1e-4-horizon=-1--2-"
        );
        assert_eq!(
            folder_name(&axes, &cells[7], 7),
            "8-curl-lr=2.5e-4-horizon=x-y"
        );
    }

    #[test]
    fn a_game_may_be_named_alone() {
        assert_eq!(full_name("maze"), "procgen:maze");
        assert_eq!(full_name("chain"), "chain");
        assert_eq!(full_name("exec:python3 world.py"), "exec:python3 world.py");
    }
}
