//! `driml evaluate`: plays whole episodes with the weights of a run or an exported network, and with a random policy for comparison. Makes
//! a film of them on request.

mod recording;
mod tile;

use std::{
    fs,
    ops::ControlFlow,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use driml_actor::Step;
use driml_launch::{
    checkpoint_choice::{CheckpointChoice, WeightsChoice},
    console::{self, Screen, print},
    evaluate::{EPSILON, Levels, Player, PolicyKind, world_with_levels},
    evaluator::evaluate_and_keep,
    metrics::rounded,
    output, pretrained,
    run_folder::RunFolder,
    stats::{describe_deviation, mean_and_deviation},
    view::PROGRESS_TEMPLATE,
};
use driml_machine::{
    error::{Interrupted, usage},
    shell::quoted_path,
    units::count,
    whole_number,
};
use driml_protocol::Shutdown;

use self::recording::{RecordArgs, Recording};

#[derive(Debug, Args)]
pub(crate) struct EvaluateArgs {
    /// Folder of a run, file written by --export, or pretrained:GAME for built-in weights
    #[arg(value_name = "RUN")]
    pub(crate) folder: PathBuf,
    /// Episodes to play
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = whole_number::within_u32(1..=1_000_000))]
    pub(crate) episodes: u32,
    /// Which levels to play
    #[arg(long, value_enum, default_value_t = Levels::Train)]
    pub(crate) levels: Levels,
    /// Seed of the worlds and of exploration
    #[arg(long, value_name = "S", default_value_t = 0, value_parser = whole_number::within(0..=u64::MAX))]
    pub(crate) seed: u64,
    /// Probability of a random action [default: 0.001]
    #[arg(long, value_name = "P", value_parser = probability)]
    pub(crate) epsilon: Option<f64>,
    /// Checkpoint to play: a number of updates, or "best" for the best of evaluations.csv [default: newest]
    #[arg(long, value_name = "UPDATES")]
    pub(crate) checkpoint: Option<CheckpointChoice>,
    /// Weights to play [default: average]
    #[arg(long, value_enum)]
    pub(crate) weights: Option<WeightsChoice>,
    /// Write the weights as f16, with the run's settings, into this file, and play nothing
    #[arg(long, value_name = "FILE.safetensors", conflicts_with_all = ["episodes", "levels", "seed", "epsilon", "keep", "exact", "returns", "json", "record"])]
    pub(crate) export: Option<PathBuf>,
    /// Add the mean return to the run's evaluations.csv, and keep the checkpoint if it is the best
    #[arg(long, conflicts_with_all = ["levels", "seed", "epsilon", "weights", "exact", "returns", "json", "record"])]
    pub(crate) keep: bool,
    /// Play with f32 weights and arithmetic, even if the run's actors used bf16 or f16
    #[arg(long)]
    pub(crate) exact: bool,
    /// Write every episode's return into this CSV file: policy, episode, return
    #[arg(long, value_name = "FILE")]
    pub(crate) returns: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) film: RecordArgs,
    /// Exit when the parent process PID exits
    #[arg(long, value_name = "PID", hide = true, requires = "keep")]
    pub(crate) exit_with_parent: Option<u32>,
}

fn probability(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|it| (0.0..=1.0).contains(it));
    value.ok_or_else(|| "give a number from 0 to 1".into())
}

/// Evaluates on a thread, so that the first Ctrl-C also ends the wait for a world that hangs.
pub(crate) fn run(args: EvaluateArgs) -> anyhow::Result<()> {
    let shutdown = Shutdown::on_signals(args.exit_with_parent);
    let shutdown = shutdown.context("listening for signals")?;
    let (flag, film) = (shutdown.clone(), args.film.tmp_path());
    let work = move || evaluate(&args, &flag);
    let ended = shutdown.run_unless_set("evaluation", work, || false);
    ended.context("starting a thread")?.unwrap_or_else(|| {
        // The thread that would remove it still waits for its world.
        if let Some(film) = film {
            let _ = fs::remove_file(film);
        }
        Err(Interrupted.into())
    })
}

fn evaluate(args: &EvaluateArgs, shutdown: &Shutdown) -> anyhow::Result<()> {
    if let Some(path) = &args.film.record
        && path.extension().is_none_or(|it| it != "gif")
    {
        bail!(usage!(
            "--record: {} is not the name of a film: use one that ends in .gif",
            path.display()
        ));
    }
    let pretrained = pretrained::load(&args.folder)?;
    let folder = RunFolder::new(&args.folder);
    let choice = args.checkpoint.unwrap_or_default();
    if pretrained.is_some() && (args.checkpoint.is_some() || args.weights.is_some() || args.keep) {
        bail!(usage!(
            "{} is a single network: --checkpoint, --weights and --keep are for the folder of a run",
            folder.display()
        ));
    }
    if args.keep {
        let (evaluation, rank) = evaluate_and_keep(&folder, choice, args.episodes, shutdown)?;
        return print(&format!("{}{rank}\n", evaluation.describe()));
    }
    let mut player = match pretrained {
        Some(player) => player,
        None => Player::load(&folder, choice, args.weights.unwrap_or_default())?,
    };
    if let Some(path) = &args.export {
        return export(&player, path);
    }
    if args.exact {
        player = player.with_f32();
    }
    player.epsilon = args.epsilon.unwrap_or(EPSILON);
    player.config.world.install(&mut console::eprintln)?;
    // Check the file before an hour of playing. Its content is replaced only after that.
    if let Some(path) = &args.returns {
        output::check_file("--returns", path)?;
    }
    let world = world_with_levels(&player.config.world, args.levels)?;
    let mut film = Recording::begin(&args.film, &player, args.episodes)?;
    let spec = &player.config.run;
    let on = match args.levels {
        Levels::Train if !world.is_resumable() => "from the start of world.lethal_schedule",
        Levels::Train => "as trained on",
        Levels::TrainSingle => "on the levels trained on, one per episode",
        Levels::Unseen => "on unseen levels",
    };
    let print_text = |text: &str| if args.json { Ok(()) } else { print(text) };
    print_text(&format!(
        "{} {on}, {} each, {} {} weights after {} played in {}, seed {}{}\n",
        spec.world,
        count(args.episodes, "episode"),
        player.weights_name(),
        player.config.learner.publish_dtype,
        count(player.updates, "update"),
        player.config.actor.precision,
        args.seed,
        args.epsilon
            .map_or(String::new(), |it| format!(", epsilon {it}"))
    ))?;
    let episodes = args.episodes as usize;
    let mut played: Vec<PolicyReturns<'_>> = Vec::new();
    for (policy, name) in [
        (PolicyKind::Agent, &*spec.agent),
        (PolicyKind::Random, "random"),
    ] {
        let mut screen = Screen::new(episodes as u64, PROGRESS_TEMPLATE);
        let mut filmed = Ok(());
        let watch = &mut |step: &Step<'_>, returns: &[f64]| {
            screen.show(returns.len() as u64, |_| progress(name, returns, episodes));
            filmed = film.iter_mut().try_for_each(|film| film.add_step(step));
            match shutdown.is_set() || filmed.is_err() {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            }
        };
        let returns = player.play(policy, &world, episodes, args.seed, watch);
        screen.clear();
        filmed.context("making the film")?;
        let returns = returns?;
        if shutdown.is_set() {
            return Err(Interrupted.into());
        }
        // Only the agent is filmed.
        if let Some(film) = film.take() {
            print_text(&film.finish()?)?;
        }
        let (mean, deviation) = mean_and_deviation(&returns);
        let deviation = describe_deviation(deviation);
        print_text(&format!("{name:12} mean return {mean:8.3}{deviation}\n"))?;
        played.push((name, returns));
    }
    if let Some(path) = &args.returns {
        output::write_file("--returns", path, returns_table(&played).as_bytes())?;
    }
    if args.json {
        print(&json_report(&player, args.levels, args.seed, &played)?)?;
    }
    Ok(())
}

fn export(player: &Player, path: &Path) -> anyhow::Result<()> {
    if path.extension().is_none_or(|it| it != "safetensors") {
        let name = path.display();
        bail!(usage!(
            "--export {name}: use a name that ends in .safetensors"
        ));
    }
    output::check_file("--export", path)?;
    let bytes = pretrained::export(player)?;
    output::write_file("--export", path, &bytes)?;
    print(&format!(
        "{} weights after {} as f16, {} kB; `driml evaluate {}` plays them\n",
        player.weights_name(),
        count(player.updates, "update"),
        bytes.len() / 1000,
        quoted_path(path)
    ))
}

/// The name of a policy, and the returns of its episodes.
type PolicyReturns<'a> = (&'a str, Vec<f64>);

fn returns_table(played: &[PolicyReturns<'_>]) -> String {
    let mut text = "policy,episode,return\n".to_owned();
    for (name, returns) in played {
        for (episode, value) in (1..).zip(returns) {
            text += &format!("{name},{episode},{}\n", rounded(*value));
        }
    }
    text
}

fn json_report(
    player: &Player,
    levels: Levels,
    seed: u64,
    played: &[PolicyReturns<'_>],
) -> anyhow::Result<String> {
    let spec = &player.config.run;
    let mut policies = serde_json::json!({});
    for (name, returns) in played {
        let (mean, deviation) = mean_and_deviation(returns);
        policies[name] = serde_json::json!({ "mean_return": mean, "standard_deviation": deviation, "episodes": returns.len() });
    }
    let levels = levels.to_possible_value();
    let object = serde_json::json!({
        "world": spec.world,
        "agent": spec.agent,
        "updates": player.updates,
        "weights": player.config.learner.publish_dtype,
        "averaged": player.is_averaged,
        "arithmetic": player.config.actor.precision,
        "levels": levels.map(|it| it.get_name().to_owned()),
        "seed": seed,
        "epsilon": player.epsilon,
        "policies": policies,
    });
    Ok(serde_json::to_string(&object)? + "\n")
}

fn progress(policy: &str, returns: &[f64], of: usize) -> String {
    let mean = match returns {
        [] => String::new(),
        _ => format!(", mean return {:.3}", mean_and_deviation(returns).0),
    };
    let of = count(of, "episode");
    format!("{policy}: {} of {of}{mean}", returns.len())
}
