//! Table 1: agents on Procgen's games, as a queue of whole runs that are then played on levels seen and unseen.
//! Data and figures are in `curves`, scores over all games in `scores`, the page in `page`, other people's numbers in
//! `published`, the choice of games in `screen`.

mod curves;
mod k;
mod page;
mod published;
mod scores;
mod screen;

use std::{collections::BTreeMap, thread::ScopedJoinHandle};

use driml_envs::WorldName;
use driml_launch::{
    console,
    evaluate::{Levels, Player, Who},
};
use driml_machine::error::{Usage, usage};
use driml_settings::presets;
use serde::{Deserialize, Serialize};

use super::{
    Session, command_line,
    queue::{self, Plan, Ran},
};
use crate::{flags::ProcgenArgs, plot};

const FULL: &str = include_str!("config.toml");
const SMOKE: &str = include_str!("smoke.toml");
/// Seed of the played episodes: the same levels for every agent.
const PLAY_SEED: u64 = 1;
/// Playing after a run, as a part of the run's work; only the estimate of the time left depends on it.
const PLAY_SHARE: u64 = 10;

/// `deploy/experiments/src/procgen/*.toml`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    grid: Settings,
    screen: Settings,
}

/// A grid of runs.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    /// As `--env` takes them, or `all` for Procgen's sixteen.
    worlds: Vec<String>,
    /// As `--agent` takes them, or `all`.
    agents: Vec<String>,
    /// Seeds 1 to this.
    seeds: u32,
    /// Runs at once.
    jobs: u32,
    /// As `--preset` takes it.
    preset: String,
    /// Frames of a run.
    frames: u64,
    /// What differs from the preset, as `--set` has it.
    sets: Vec<String>,
    /// Episodes played on each kind of levels.
    episodes: u32,
}

/// What every run and every piece has in common: a folder holds those of one such choice, while games, agents and seeds
/// can be added.
#[derive(Serialize)]
struct Common<'a> {
    preset: &'a str,
    frames: u64,
    sets: &'a [String],
    episodes: u32,
}

/// A finished run and how its agent plays.
struct Cell {
    world: String,
    agent: String,
    seed: u32,
    ran: Ran,
    played: Played,
}

/// Returns of whole episodes.
#[derive(Debug, Serialize, Deserialize)]
struct Played {
    /// In the world as it was trained in.
    trained: Vec<f64>,
    /// On the levels trained on, one an episode; none for a world without levels.
    single: Option<Vec<f64>>,
    /// On unseen levels, one an episode; none for a world without levels.
    unseen: Option<Vec<f64>>,
}

/// All there is to report.
struct Results {
    settings: Settings,
    cells: Vec<Cell>,
    /// The random policy, by world.
    random: BTreeMap<String, Played>,
    /// Runs that are missing.
    missing: Vec<String>,
    command: String,
    smoke: bool,
}

/// Runs the grid, or the screen.
///
/// # Errors
/// Names that nothing has, a folder of other settings, an interrupt, a file system that refuses.
pub(super) fn run(args: &ProcgenArgs) -> anyhow::Result<()> {
    let settings = settings(args)?;
    let name = if args.screen {
        "procgen-screen"
    } else {
        "procgen"
    };
    let plans = settings.plans();
    let worlds = settings.worlds.len() as u64;
    let frames = settings.frames;
    let play_units = (frames / PLAY_SHARE).max(1);
    let units = plans.len() as u64 * (frames + play_units) + worlds * play_units;
    let common = Common {
        preset: &settings.preset,
        frames,
        sets: &settings.sets,
        episodes: settings.episodes,
    };
    let report_only = args.queue.report;
    let mut session = Session::open_queue(name, &args.flags, &common, units, report_only)?;
    let is_procgen = |world: &String| world.starts_with("procgen:");
    if !report_only && settings.worlds.iter().any(is_procgen) {
        procgen_sys::Engine::install(&mut console::line)?;
    }
    let runs: Vec<Plan> = plans.iter().map(|(_, plan)| plan.clone()).collect();
    let ran = queue::run_all(&mut session, &runs, settings.jobs, report_only)?;
    let mut results = Results {
        command: command(args, name, &session),
        smoke: args.flags.smoke,
        settings,
        cells: Vec::new(),
        random: BTreeMap::new(),
        missing: Vec::new(),
    };
    for ((spot, plan), ran) in plans.into_iter().zip(ran) {
        let Some(ran) = ran else {
            results.missing.push(plan.name);
            continue;
        };
        let mut play = |of: &str, key: &str, who| {
            let episodes = results.settings.episodes;
            session.piece_of(of, key, play_units, |progress| {
                let played = played(&ran, who, episodes)?;
                progress.advance(play_units)?;
                Ok(played)
            })
        };
        // A run may have been made anew, or gone on, since it was played.
        let weights = &ran.summary.weights_sha256;
        let played = play(weights, &format!("{}-played", plan.name), Who::Agent)?;
        if !results.random.contains_key(&spot.world) {
            let random = play("", &format!("{}-random", short(&spot.world)), Who::Random)?;
            results.random.insert(spot.world.clone(), random);
        }
        results.cells.push(Cell {
            world: spot.world,
            agent: spot.agent,
            seed: spot.seed,
            ran,
            played,
        });
    }
    if results.cells.is_empty() {
        return Err(usage!("no run is finished yet: there is nothing to report").into());
    }
    if args.screen {
        screen::report(session, &results)?;
    } else {
        report(session, &results)?;
    }
    queue::check_made(&results.missing, report_only)
}

/// Writes everything.
fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    curves::write_runs(&session, results)?;
    curves::write_table(&session, results)?;
    session.figure("curves", &curves::figure(&session, results)?)?;
    let aggregates = scores::of(results);
    let rows = aggregates.iter().map(|it| {
        let head = [it.measure, it.kind.name(), &it.agent].map(String::from);
        let numbers = [it.estimate.value, it.estimate.low, it.estimate.high];
        let numbers = numbers.map(|number| format!("{number:.4}"));
        head.into_iter()
            .chain([it.games.to_string()])
            .chain(numbers)
            .collect()
    });
    let header = ["measure", "of", "agent", "games", "value", "low", "high"];
    session.csv("aggregate", &header, rows)?;
    session.figure("aggregate", &scores::figure(results, &aggregates))?;
    let adaptive: Vec<&Cell> = results.adaptive().collect();
    if !adaptive.is_empty() {
        session.figure("k", &curves::k_figure(&session, results)?)?;
        curves::write_actions(&session, results)?;
        let first = adaptive.iter().filter(|cell| cell.seed == adaptive[0].seed);
        let folders: Vec<_> = first.map(|cell| cell.ran.folder.clone()).collect();
        session.figure("affinity", &plot::affinities(&folders)?)?;
    }
    session.finish(&page::page(results, &aggregates, !adaptive.is_empty()))
}

fn played(ran: &Ran, who: Who, episodes: u32) -> anyhow::Result<Played> {
    let player = Player::load(&ran.folder)?;
    let on = |levels| player.returns(who, levels, episodes, PLAY_SEED);
    // A world steps on one thread.
    std::thread::scope(|scope| {
        let single = scope.spawn(|| on(Levels::TrainSingle));
        let unseen = scope.spawn(|| on(Levels::Unseen));
        let trained = on(Levels::Train)?.unwrap_or_default();
        let join =
            |thread: ScopedJoinHandle<'_, _>| thread.join().expect("a panic has ended the process");
        Ok(Played {
            trained,
            single: join(single)?,
            unseen: join(unseen)?,
        })
    })
}

/// Where in the grid a run is.
struct Spot {
    world: String,
    agent: String,
    seed: u32,
}

impl Settings {
    /// The runs, seed by seed, so that a grid that was stopped has a seed of everything before it has two of anything.
    fn plans(&self) -> Vec<(Spot, Plan)> {
        let mut plans = Vec::new();
        for seed in 1..=self.seeds {
            for world in &self.worlds {
                for agent in &self.agents {
                    let spot = Spot {
                        world: world.clone(),
                        agent: agent.clone(),
                        seed,
                    };
                    let plan = self.plan(&spot);
                    plans.push((spot, plan));
                }
            }
        }
        plans
    }

    fn plan(&self, spot: &Spot) -> Plan {
        let (seed, frames) = (spot.seed.to_string(), self.frames.to_string());
        let (agent, k) = with_k(&spot.agent);
        let mut args: Vec<String> = [
            ["--env", &spot.world],
            ["--agent", agent],
            ["--preset", &self.preset],
            ["--seed", &seed],
            ["--frames", &frames],
        ]
        .concat()
        .into_iter()
        .map(String::from)
        .collect();
        let k = k.map(|k| format!("run.horizon.k={k}"));
        for set in self.sets.iter().chain(&k) {
            args.extend(["--set".into(), set.clone()]);
        }
        Plan {
            name: format!("{}-{}-seed{}", short(&spot.world), spot.agent, spot.seed),
            args,
            frames: self.frames,
            episodes: None,
            units: self.frames,
        }
    }
}

/// A world's name as files have it.
fn short(world: &str) -> &str {
    world.strip_prefix("procgen:").unwrap_or(world)
}

/// The settings of the length asked for, with what the flags replace.
fn settings(args: &ProcgenArgs) -> Result<Settings, Usage> {
    let (name, text) = if args.flags.smoke {
        ("smoke", SMOKE)
    } else {
        ("config", FULL)
    };
    let file: File = toml::from_str(text).unwrap_or_else(|e| {
        panic!("experiments/procgen/{name}.toml is built in, and a test reads it: {e}")
    });
    let mut settings = if args.screen { file.screen } else { file.grid };
    if !args.games.is_empty() {
        settings.worlds = args.games.clone();
    }
    if !args.agents.is_empty() {
        settings.agents = args.agents.clone();
    }
    settings.worlds = worlds(&settings.worlds)?;
    settings.agents = agents(&settings.agents)?;
    settings.seeds = args.flags.seeds.unwrap_or(settings.seeds);
    settings.jobs = args.queue.jobs.unwrap_or(settings.jobs);
    settings.frames = args.frames.unwrap_or(settings.frames);
    settings.episodes = args.episodes.unwrap_or(settings.episodes);
    if let Some(preset) = &args.preset {
        settings.preset = presets::preset(preset)?.name.to_owned();
    }
    settings.sets.extend(args.queue.sets.iter().cloned());
    Ok(settings)
}

/// Worlds by their names or their games', each once; `all` is every game.
fn worlds(names: &[String]) -> Result<Vec<String>, Usage> {
    let mut found = Vec::new();
    for name in names {
        if name == "all" {
            let games = WorldName::all().filter(|it| it.kind() == "procgen");
            found.extend(games.map(|world| world.to_string()));
        } else {
            let world = presets::world(name).map_err(|e| usage!("--games: {e}"))?;
            found.push(world.to_string());
        }
    }
    Ok(once(found))
}

/// Agents that look a fixed k ahead, so that another k can be asked for.
const OF_FIXED_K: [&str; 2] = ["driml-fix", "driml-noact"];

/// The agent and the k of a name such as `driml-noact-k5`; other names are the agent's alone.
fn with_k(name: &str) -> (&str, Option<u32>) {
    let split = name.rsplit_once("-k");
    match split.and_then(|(agent, k)| Some((agent, k.parse().ok()?))) {
        Some((agent, k)) if OF_FIXED_K.contains(&agent) => (agent, Some(k)),
        _ => (name, None),
    }
}

/// Agents by name, each once; `all` is every one, and a name with a k one that looks so far ahead.
fn agents(names: &[String]) -> Result<Vec<String>, Usage> {
    let mut found = Vec::new();
    for name in names {
        if name == "all" {
            found.extend(published::AGENTS.map(String::from));
        } else {
            let (agent, k) = with_k(name);
            let agent = presets::agent(agent)?.name;
            found.push(k.map_or_else(|| agent.to_owned(), |k| format!("{agent}-k{k}")));
        }
    }
    Ok(once(found))
}

fn once(names: Vec<String>) -> Vec<String> {
    let mut kept: Vec<String> = Vec::new();
    for name in names {
        if !kept.contains(&name) {
            kept.push(name);
        }
    }
    kept
}

fn command(args: &ProcgenArgs, name: &str, session: &Session) -> String {
    let experiment = if args.screen {
        "procgen --screen"
    } else {
        name
    };
    let mut words = command_line(experiment, &args.flags, session.folder());
    for (flag, list) in [("--games", &args.games), ("--agents", &args.agents)] {
        if !list.is_empty() {
            words += &format!(" {flag} {}", list.join(","));
        }
    }
    let numbers = [
        ("--frames", args.frames),
        ("--episodes", args.episodes.map(u64::from)),
        ("--jobs", args.queue.jobs.map(u64::from)),
    ];
    for (flag, number) in numbers {
        if let Some(number) = number {
            words += &format!(" {flag} {number}");
        }
    }
    if let Some(preset) = &args.preset {
        words += &format!(" --preset {preset}");
    }
    for set in &args.queue.sets {
        words += &format!(" --set '{set}'");
    }
    words
}

impl Results {
    /// Runs whose k follows the affinity.
    fn adaptive(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(|cell| cell.agent == "driml-ada")
    }

    /// The runs of an agent in a world, by seed.
    fn of<'a>(&'a self, world: &'a str, agent: &'a str) -> impl Iterator<Item = &'a Cell> {
        let here = move |cell: &&Cell| cell.world == world && cell.agent == agent;
        self.cells.iter().filter(here)
    }

    /// Mean returns of the played episodes, by seed.
    fn means(&self, world: &str, agent: &str, kind: Kind) -> Vec<f64> {
        let cells = self.of(world, agent);
        cells.filter_map(|cell| cell.score(kind)).collect()
    }

    /// Worlds and agents that have a run.
    fn worlds(&self) -> Vec<&str> {
        let has = |world: &&String| self.cells.iter().any(|cell| cell.world == **world);
        let worlds = self.settings.worlds.iter();
        worlds.filter(has).map(String::as_str).collect()
    }

    fn agents(&self) -> Vec<&str> {
        let has = |agent: &&String| self.cells.iter().any(|cell| cell.agent == **agent);
        let agents = self.settings.agents.iter();
        agents.filter(has).map(String::as_str).collect()
    }
}

/// What a score is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// The last 100 episodes of the training, as in table 1.
    Training,
    /// Greedy, in the world as it was trained in.
    Trained,
    /// Greedy, on the levels trained on, one an episode.
    Single,
    /// Greedy, on unseen levels, one an episode.
    Unseen,
}

impl Kind {
    const ALL: [Self; 4] = [Self::Training, Self::Trained, Self::Single, Self::Unseen];

    /// As figures and data have it.
    const fn name(self) -> &'static str {
        match self {
            Self::Training => "training",
            Self::Trained => "greedy",
            Self::Single => "levels trained on",
            Self::Unseen => "unseen levels",
        }
    }
}

impl Cell {
    fn score(&self, kind: Kind) -> Option<f64> {
        match kind {
            Kind::Training => self.ran.summary.mean_return,
            _ => self.played.mean(kind),
        }
    }
}

impl Played {
    fn mean(&self, kind: Kind) -> Option<f64> {
        let returns = match kind {
            Kind::Training => None,
            Kind::Trained => Some(&self.trained),
            Kind::Single => self.single.as_ref(),
            Kind::Unseen => self.unseen.as_ref(),
        }?;
        (!returns.is_empty()).then(|| returns.iter().sum::<f64>() / returns.len() as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_settings_can_be_read() {
        for text in [FULL, SMOKE] {
            let file: File = toml::from_str(text).unwrap();
            for settings in [&file.grid, &file.screen] {
                assert!(!worlds(&settings.worlds).unwrap().is_empty());
                assert!(!agents(&settings.agents).unwrap().is_empty());
                assert!(presets::preset(&settings.preset).is_ok());
            }
        }
    }

    #[test]
    fn games_go_by_short_names_and_all_is_sixteen() {
        let names = |list: &[&str]| worlds(&list.iter().map(|&it| it.into()).collect::<Vec<_>>());
        assert_eq!(names(&["all", "bigfish"]).unwrap().len(), 16);
        assert_eq!(
            names(&["chain", "bigfish"]).unwrap(),
            ["chain", "procgen:bigfish"]
        );
        let said = names(&["bigfihs"]).unwrap_err().to_string();
        assert!(said.contains("did you mean"), "{said}");
        assert_eq!(agents(&["all".into()]).unwrap().len(), 7);
    }

    #[test]
    fn an_agent_of_fixed_k_can_be_given_another() {
        let names = |list: &[&str]| agents(&list.iter().map(|&it| it.into()).collect::<Vec<_>>());
        let both = ["driml-noact-k1", "driml-noact-k5"];
        assert_eq!(names(&both).unwrap(), both);
        assert!(names(&["driml-ada-k5"]).is_err() && names(&["driml-noact-kx"]).is_err());
        let file: File = toml::from_str(SMOKE).unwrap();
        let spot = Spot {
            world: "procgen:heist".into(),
            agent: "driml-noact-k5".into(),
            seed: 2,
        };
        let plan = file.grid.plan(&spot);
        assert_eq!(plan.name, "heist-driml-noact-k5-seed2");
        let has = |pair: [&str; 2]| plan.args.windows(2).any(|words| *words == pair);
        assert!(has(["--agent", "driml-noact"]) && has(["--set", "run.horizon.k=5"]));
    }

    #[test]
    fn the_first_seed_of_everything_comes_first() {
        let file: File = toml::from_str(SMOKE).unwrap();
        let plans = file.grid.plans();
        let names: Vec<_> = plans.iter().map(|(_, plan)| plan.name.as_str()).collect();
        assert_eq!(
            names[..5],
            [
                "chain-c51-seed1",
                "chain-driml-ada-seed1",
                "mspacman-c51-seed1",
                "mspacman-driml-ada-seed1",
                "chain-c51-seed2"
            ]
        );
    }
}
