//! Fig. 3: ghosts that can be predicted more or less, and one lethal ghost of four that changes, with and without noise in
//! the walls. Whole runs through all processes; the picture is in `figure`, data and page in `report`.

mod figure;
mod report;

use driml_machine::error::{Usage, usage};
use driml_settings::presets;
use serde::{Deserialize, Serialize};

use super::{
    Session, command_line,
    queue::{self, Plan, Ran},
    settings,
};
use crate::flags::PacmanArgs;

const NAME: &str = "pacman";
/// Frames of an episode, about; only the estimate of the time left depends on it.
const EPISODE_FRAMES: u64 = 190;
/// Most frames of an episode: the world's step limit. A run of so many frames has all its episodes.
const EPISODE_FRAMES_MAX: u64 = 500;

/// `deploy/experiments/src/pacman/*.toml`. A folder holds the runs of one such choice; agents and seeds can be added.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    /// Agents of (b) and (c), the first for comparison.
    #[serde(skip_serializing)]
    agents: Vec<String>,
    /// Seeds 1 to this.
    #[serde(skip_serializing)]
    seeds: u32,
    /// Runs at once.
    #[serde(skip_serializing)]
    jobs: u32,
    /// As `--preset` takes it.
    preset: String,
    /// What differs from the preset in every run, as `--set` has it.
    sets: Vec<String>,
    predictability: Predictability,
    continual: Continual,
    noise: Continual,
}

/// (a) The share of random moves of the ghosts.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Predictability {
    agent: String,
    epsilons: Vec<f64>,
    /// Frames of a run.
    frames: u64,
}

/// (b, c) One lethal ghost after another.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Continual {
    /// Tasks of a run.
    tasks: u64,
    /// The lethal ghost of each task; after the last the first again.
    order: Vec<u8>,
    /// Episodes of a task, of all copies together.
    episodes_per_task: u64,
    /// Copies of the world, in one actor.
    envs: u64,
    /// What differs from the other runs, as `--set` has it.
    sets: Vec<String>,
}

/// What a run is for.
#[derive(Clone, Debug, PartialEq)]
enum Part {
    /// (a)
    Epsilon(f64),
    /// (b), of this agent.
    Ghosts(String),
    /// (c), of this agent.
    Noise(String),
}

/// All there is to report.
struct Results {
    settings: Settings,
    /// Part and seed of each finished run.
    runs: Vec<(Part, u32, Ran)>,
    /// Runs that are missing.
    missing: Vec<String>,
    command: String,
    smoke: bool,
}

/// Runs the experiment.
///
/// # Errors
/// Names that nothing has, a folder of other settings, an interrupt, a file system that refuses.
pub(super) fn run(args: &PacmanArgs) -> anyhow::Result<()> {
    let settings = with_flags(args)?;
    let plans = settings.plans();
    let units = plans.iter().map(|(_, _, plan)| plan.units).sum();
    let report_only = args.queue.report;
    let mut session = Session::open_queue(NAME, &args.flags, &settings, units, report_only)?;
    let runs: Vec<Plan> = plans.iter().map(|(_, _, plan)| plan.clone()).collect();
    let ran = queue::run_all(&mut session, &runs, settings.jobs, report_only)?;
    let mut results = Results {
        command: command(args, &session),
        smoke: args.flags.smoke,
        settings,
        runs: Vec::new(),
        missing: Vec::new(),
    };
    for ((part, seed, plan), ran) in plans.into_iter().zip(ran) {
        match ran {
            Some(ran) => results.runs.push((part, seed, ran)),
            None => results.missing.push(plan.name),
        }
    }
    if results.runs.is_empty() {
        return Err(usage!("no run is finished yet: there is nothing to report").into());
    }
    report::report(session, &results)?;
    queue::check_made(&results.missing, report_only)
}

/// The settings of the length asked for, with what the flags replace.
fn with_flags(args: &PacmanArgs) -> Result<Settings, Usage> {
    let mut settings: Settings = settings(
        NAME,
        include_str!("config.toml"),
        include_str!("smoke.toml"),
        &args.flags,
    );
    if !args.agents.is_empty() {
        let known = args.agents.iter().map(|name| presets::agent(name));
        let names = known.map(|agent| agent.map(|agent| agent.name.to_owned()));
        settings.agents = names.collect::<Result<_, _>>()?;
    }
    settings.seeds = args.flags.seeds.unwrap_or(settings.seeds);
    settings.jobs = args.queue.jobs.unwrap_or(settings.jobs);
    settings.sets.extend(args.queue.sets.iter().cloned());
    let predictability = &mut settings.predictability;
    predictability.frames = args.frames.unwrap_or(predictability.frames);
    for continual in [&mut settings.continual, &mut settings.noise] {
        let episodes = args
            .episodes_per_task
            .unwrap_or(continual.episodes_per_task);
        if !episodes.is_multiple_of(continual.envs) {
            return Err(usage!(
                "--episodes-per-task {episodes} is no multiple of the {} copies of the world, each of which changes its ghost \
                 by itself",
                continual.envs
            ));
        }
        continual.episodes_per_task = episodes;
    }
    Ok(settings)
}

impl Settings {
    /// The runs, seed by seed.
    fn plans(&self) -> Vec<(Part, u32, Plan)> {
        let mut plans = Vec::new();
        for seed in 1..=self.seeds {
            for &epsilon in &self.predictability.epsilons {
                let part = Part::Epsilon(epsilon);
                plans.push((part, seed, self.predictability_plan(epsilon, seed)));
            }
            for agent in &self.agents {
                let plan = self.continual_plan("ghosts", &self.continual, agent, seed);
                plans.push((Part::Ghosts(agent.clone()), seed, plan));
            }
            for agent in &self.agents {
                let plan = self.continual_plan("noise", &self.noise, agent, seed);
                plans.push((Part::Noise(agent.clone()), seed, plan));
            }
        }
        plans
    }

    fn predictability_plan(&self, epsilon: f64, seed: u32) -> Plan {
        let Predictability { agent, frames, .. } = &self.predictability;
        let sets = [format!("world.epsilon={epsilon}")];
        Plan {
            name: format!("epsilon{epsilon}-seed{seed}"),
            args: self.args(agent, seed, *frames, &sets),
            frames: *frames,
            episodes: None,
            units: *frames,
        }
    }

    fn continual_plan(&self, name: &str, continual: &Continual, agent: &str, seed: u32) -> Plan {
        let order: Vec<String> = continual.order.iter().map(u8::to_string).collect();
        let mut sets = continual.sets.clone();
        sets.push(format!(
            "world.lethal_schedule={{episodes_per_task={},order=[{}]}}",
            continual.episodes_per_task / continual.envs,
            order.join(",")
        ));
        sets.push("local.actors=1".into());
        sets.push(format!("actor.envs={}", continual.envs));
        let episodes = continual.episodes();
        let frames = episodes * EPISODE_FRAMES_MAX;
        Plan {
            name: format!("{name}-{agent}-seed{seed}"),
            args: self.args(agent, seed, frames, &sets),
            frames,
            episodes: Some(episodes),
            units: episodes * EPISODE_FRAMES,
        }
    }

    fn args(&self, agent: &str, seed: u32, frames: u64, sets: &[String]) -> Vec<String> {
        let (seed, frames) = (seed.to_string(), frames.to_string());
        let head = [
            ["--env", "mspacman"],
            ["--agent", agent],
            ["--preset", &self.preset],
            ["--seed", &seed],
            ["--frames", &frames],
        ];
        let mut args: Vec<String> = head.concat().into_iter().map(String::from).collect();
        for set in self.sets.iter().chain(sets) {
            args.extend(["--set".into(), set.clone()]);
        }
        args
    }
}

impl Continual {
    /// Episodes of a whole run.
    const fn episodes(&self) -> u64 {
        self.tasks * self.episodes_per_task
    }
}

fn command(args: &PacmanArgs, session: &Session) -> String {
    let mut words = command_line(NAME, &args.flags, session.folder());
    if !args.agents.is_empty() {
        words += &format!(" --agents {}", args.agents.join(","));
    }
    let numbers = [
        ("--frames", args.frames),
        ("--episodes-per-task", args.episodes_per_task),
        ("--jobs", args.queue.jobs.map(u64::from)),
    ];
    for (flag, number) in numbers {
        if let Some(number) = number {
            words += &format!(" {flag} {number}");
        }
    }
    for set in &args.queue.sets {
        words += &format!(" --set '{set}'");
    }
    words
}
