//! `driml train`: prepares settings, plan, engine and run folder, and then runs as separate processes or in lockstep.
//! `driml_launch::launcher` starts and ends the processes.

use std::{fs, io::ErrorKind, iter, path::PathBuf};

use anyhow::bail;
use clap::Args;
use driml_launch::{
    console::{self, print_wrapped},
    endpoint::{check_listen_endpoints, check_unused},
    launcher, lockstep, plan,
    resume::{self, Resumption},
    run_folder::RunFolder,
};
use driml_learner::DeviceName;
use driml_machine::{device::check_device, error::usage, resources::Machine, units, whole_number};
use driml_protocol::{RunSpec, session, tls::Role};
use driml_settings::{
    config::RunConfig,
    flags::{RunFlags, resolve},
};

use super::join::{NetworkFlag, TlsFlags};

/// The most characters of a world's name in the name of a run folder.
const WORLD_CHARS_MAX: usize = 40;
/// The arguments that a resumed run takes from its folder.
const RESUMED: &str = "env agent preset config actors replay_shards envs seed run_dir lockstep";

#[derive(Debug, Args)]
pub(crate) struct TrainArgs {
    #[command(flatten)]
    pub(crate) run: RunFlags,
    /// Folder for settings, metrics, checkpoints, logs and summary [default: runs/WORLD-AGENT-seedS-TIME]
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: Option<PathBuf>,
    /// Resume the run in this folder from its newest checkpoint, with its own settings; --frames, --device and --set may change
    #[arg(long, value_name = "DIR", conflicts_with_all = RESUMED.split(' '))]
    pub(crate) resume: Option<PathBuf>,
    /// Device of the learner: cpu, cuda (the first GPU) or cuda:N [default: cpu]
    #[arg(long, value_name = "DEVICE")]
    pub(crate) device: Option<DeviceName>,
    /// Keep the replay on disk, in the run folder, for a restarted replay server or --resume
    #[arg(long)]
    pub(crate) durable: bool,
    /// Write TensorBoard events into the run folder
    #[arg(long)]
    pub(crate) tensorboard: bool,
    /// Play a checkpoint every so many updates, in a separate process that takes a core, and keep the best; writes evaluations.csv.
    /// Unless it is a multiple of 1,000, checkpoints are saved at this period instead. `driml evaluate RUN --checkpoint best` plays the best
    #[arg(long, value_name = "UPDATES", value_parser = whole_number::within(1..=u64::MAX))]
    pub(crate) eval_interval: Option<u64>,
    /// Episodes per evaluation
    #[arg(long, value_name = "N", default_value_t = 20, requires = "eval_interval", value_parser = whole_number::within_u32(1..=1_000_000))]
    pub(crate) eval_episodes: u32,
    /// Skip the greedy episodes after the run, which take about 30 s
    #[arg(long)]
    pub(crate) no_play: bool,
    /// Run everything in one process in a fixed order: the same seed gives the same weights
    #[arg(long, conflicts_with = "listen")]
    pub(crate) lockstep: bool,
    /// Endpoint of the replay server [default: a unix socket in a fresh folder]; with --tls-dir, one for other machines, such as
    /// quic/[::]:7447, while local processes use a unix socket
    #[arg(long, value_name = "ENDPOINT")]
    pub(crate) listen: Option<String>,
    #[command(flatten)]
    pub(crate) tls: TlsFlags,
    #[command(flatten)]
    pub(crate) network: NetworkFlag,
    /// Stop as after Ctrl-C when the parent process PID exits
    #[arg(long, value_name = "PID", hide = true)]
    pub(crate) exit_with_parent: Option<u32>,
}

/// The `learner.checkpoint_period_updates` of all presets except `smoke`, whose period divides this one.
const CHECKPOINT_PERIOD: u64 = 1_000;

pub(crate) fn run(mut args: TrainArgs, version: &str) -> anyhow::Result<()> {
    let machine = Machine::detect();
    let sets = &mut args.run.flags.sets;
    sets.extend((args.device).map(|device| format!("local.learner_device={device}")));
    for (is_set, set) in [
        (args.durable, "local.durable=true"),
        (args.tensorboard, "local.tensorboard=true"),
        (args.no_play, "local.play=false"),
    ] {
        sets.extend(is_set.then(|| set.to_owned()));
    }
    if let Some(every) = args.eval_interval {
        let episodes = args.eval_episodes;
        if !every.is_multiple_of(CHECKPOINT_PERIOD) {
            // Insert this before the user's settings, which may make checkpoints more frequent.
            sets.insert(0, format!("learner.checkpoint_period_updates={every}"));
        }
        sets.push(format!(
            "local.evaluation={{every_updates={every},episodes={episodes}}}"
        ));
    }
    let (mut config, from, resume_point) = match &args.resume {
        Some(folder) => {
            let found = match resume::prepare(&RunFolder::new(folder), &args.run.flags)? {
                Resumption::Done(sentence) => return print_wrapped(&format!("{sentence}\n"), 0),
                Resumption::Resumed(found) => found,
            };
            args.lockstep = found.lockstep;
            if args.lockstep && args.listen.is_some() {
                bail!(usage!(
                    "a run in lockstep is one process: leave --listen out"
                ));
            }
            let updates = units::count(found.point.updates, "update");
            let from = format!("its checkpoint after {updates}");
            (found.config, from, Some(found.point))
        }
        None => {
            let (mut config, from) = resolve(&args.run, &machine)?;
            // `since` belongs to the run from which the file's settings come.
            config.replay.since = None;
            (config, from, None)
        }
    };
    config.program = format!("driml {version}");
    let listen = args.listen.as_slice();
    check_listen_endpoints(listen, args.tls.is_set(), args.network.allow_insecure)?;
    check_unused(listen)?;
    if args.tls.is_set() && !args.listen.as_deref().is_some_and(session::is_quic) {
        bail!(usage!(
            "--tls-dir is for processes on other machines, which need an endpoint: add --listen quic/HOST:PORT"
        ));
    }
    // Report errors in the certificates before anything is created.
    args.tls.credentials(Role::ReplayServer)?;
    check_device(config.local.learner_device)?;
    check(&config, args.lockstep)?;
    let is_new = args.resume.is_none() && !args.run_dir.as_ref().is_some_and(|it| it.is_dir());
    let run_dir = match args.resume {
        Some(folder) => RunFolder::new(folder),
        None => {
            let default = || default_run_dir("runs", &config.run);
            let run_dir = RunFolder::new(args.run_dir.unwrap_or_else(default));
            run_dir.check_free().map(|()| run_dir)?
        }
    };
    let (lockstep, point) = (args.lockstep, resume_point.unwrap_or_default());
    let plan = plan::describe(&config, &from, &run_dir, lockstep, point, &machine);
    print_wrapped(&plan, plan::INDENT)?;
    let parent = args.exit_with_parent;
    let train = || -> anyhow::Result<()> {
        config.world.install(&mut console::eprintln)?;
        if args.lockstep {
            return lockstep::run(&config, &run_dir, resume_point, parent);
        }
        let external = launcher::ExternalAccess {
            listen: args.listen,
            tls_dir: args.tls.tls_dir,
            allow_insecure: args.network.allow_insecure,
        };
        launcher::run(&config, &run_dir, resume_point, external, parent)
    };
    train().inspect_err(|_| {
        // Removes only an empty folder: one in which nothing was begun.
        if is_new {
            let _ = fs::remove_dir(run_dir.path());
        }
    })
}

/// Checks that this program can start the run: as processes, or in lockstep, which is one process with one replay for all actors.
fn check(config: &RunConfig, lockstep: bool) -> anyhow::Result<()> {
    let (replay, actors) = (&config.replay, config.local.actors);
    let shards = replay.shards;
    if shards > actors {
        bail!(usage!(
            "{shards} replay shards for {}: a shard without actors would stay empty; add --actors {shards} or use fewer shards",
            units::count(actors, "actor")
        ));
    }
    // All actors are started here, so the ladder of epsilons must have exactly one rung for each.
    if let Some(ladder) = &config.actor.epsilon_ladder
        && ladder.actors != actors
    {
        bail!(usage!(
            "actor.epsilon_ladder is for {}, but --actors is {actors}: --set actor.epsilon_ladder.actors={actors}",
            units::count(ladder.actors, "actor")
        ));
    }
    if lockstep && shards > 1 {
        bail!(usage!(
            "--lockstep runs everything in one process, with one replay: leave --replay-shards out"
        ));
    }
    if lockstep && let Some(max) = replay.disk_bytes_max {
        bail!(usage!(
            "--lockstep keeps the whole replay in the run folder, so that the run can be resumed exactly, and cannot keep it within \
             replay.disk_bytes_max = {max}: leave that out, or lower replay.capacity_transitions"
        ));
    }
    if config.world.library().is_some() {
        // This looks for files of the user's, and fetches none.
        let found = config.world.install(&mut console::eprintln);
        found.map_err(|e| usage!("--env: {e}"))?;
    }
    if !lockstep {
        let checked = match config.local.durable {
            true => replay.check_disk_budget(&config.run),
            false => replay.check_in_memory("--durable"),
        };
        checked.map_err(|e| usage!("{e}"))?;
    }
    Ok(())
}

/// Makes a run's folder, whose name is not that of another run. `check_free` reports a folder that cannot be made.
fn default_run_dir(parent: &str, run: &RunSpec) -> PathBuf {
    let (world, agent, seed) = (file_name_of(&run.world), &run.agent, run.seed);
    let time = jiff::Timestamp::now().strftime("%Y%m%d-%H%M%S");
    let name = format!("{parent}/{world}-{agent}-seed{seed}-{time}");
    // Another run may start in the same second, while this one installs the engine.
    let others = (2..).map(|number| format!("{name}-{number}"));
    let mut paths = iter::once(name.clone()).chain(others).map(PathBuf::from);
    let _ = fs::create_dir_all(parent);
    let made = |path: &PathBuf| fs::create_dir(path).map_err(|e| e.kind());
    let unused = paths.find(|path| made(path) != Err(ErrorKind::AlreadyExists));
    unused.expect("numbers do not end")
}

/// Converts a world's name to a part of a file name. The command of `exec:` may have blanks, slashes and any length.
fn file_name_of(world: &str) -> String {
    let is_kept = |it: char| it.is_ascii_alphanumeric() || "._-".contains(it);
    let chars = world.chars().map(|it| if is_kept(it) { it } else { '-' });
    chars.take(WORLD_CHARS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_that_start_at_once_have_separate_folders() {
        let root = tempfile::tempdir().unwrap();
        let parent = root.path().to_str().unwrap();
        let [one, other] = [(); 2].map(|()| default_run_dir(parent, &RunSpec::smallest()));
        assert!(one != other && one.is_dir() && other.is_dir());
    }

    #[test]
    fn the_folder_of_a_run_is_named_after_its_world() {
        let exec = "exec:python3 deploy/driml_env.py ALE/Pong-v5 --atari";
        for (world, name) in [
            ("procgen:coinrun", "procgen-coinrun"),
            (exec, "exec-python3-deploy-driml_env.py-ALE-Pon"),
            ("exec:/höhle", "exec--h-hle"),
        ] {
            assert_eq!(file_name_of(world), name);
        }
    }
}
