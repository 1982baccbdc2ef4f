//! Fig. 2: local DIM on a patch of an Ising model in noise scores high where the future can be predicted.
//! Learning and measuring are in `training`; here the seeds, the figures and the page.

mod training;

use driml_envs::{WorldConfig, WorldName};
use driml_figure::{Axis, Chart, Field, Figure, GREY, Heat, Lattice, Mark, Outline, Panel, Series};
use driml_machine::{error::usage, resources::Machine};
use driml_settings::{
    config::{self, Flags, Source},
    presets,
};
use serde::{Deserialize, Serialize};

use self::training::{Episodes, Measured, Task, Trained, View, train};
use super::{Page, Session, command_line, settings, statistics::Spread};
use crate::flags::ExperimentFlags;

const NAME: &str = "ising";
/// Updates over which the drawn loss is averaged.
const LOSS_WINDOW: usize = 10;

/// `deploy/experiments/src/ising/*.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    /// What differs from the settings of a run in this world, as `--set` has it.
    sets: Vec<String>,
    /// Seeds 1 to this. No piece depends on it, so that more can be added later.
    #[serde(skip_serializing)]
    seeds: u32,
    /// Updates of a training.
    updates: u64,
    /// Pairs in a batch, each with all others as negatives.
    batch_rows: usize,
    /// Measurements before the end.
    checks: u64,
    /// Episodes of each.
    check_episodes: usize,
    /// Episodes of the measurement at the end.
    episodes: usize,
    /// Scores are those from this environment step to the next.
    from_t: u32,
    /// The environment step of the late lattices.
    late_t: u32,
}

/// World, network and optimiser as a run has them.
///
/// # Errors
/// Settings that cannot work.
fn task(settings: &Settings) -> anyhow::Result<Task> {
    // DIM with k = 1; what else distinguishes the agents is not used here.
    let agent = "driml-fix";
    let world: WorldName = "ising".parse().expect("it is in the registry of worlds");
    let source = Source::Layers(&presets::PRESETS[0], world, agent);
    let flags = Flags {
        sets: settings.sets.clone(),
        ..Flags::default()
    };
    let config = config::resolve(&source, &flags, &Machine::this())?;
    let WorldConfig::Ising(world) = config.world else {
        return Err(usage!("the Ising world's settings are those of another world").into());
    };
    Ok(Task {
        world,
        model: config.model,
        learner: config.learner.update,
        settings: settings.clone(),
    })
}

/// Runs the experiment.
///
/// # Errors
/// A folder of other settings, an interrupt, a file system that refuses.
pub(super) fn run(flags: &ExperimentFlags) -> anyhow::Result<()> {
    let mut settings: Settings = settings(
        NAME,
        include_str!("config.toml"),
        include_str!("smoke.toml"),
        flags,
    );
    settings.seeds = flags.seeds.unwrap_or(settings.seeds);
    let task = task(&settings)?;
    let units = u64::from(settings.seeds) * settings.updates;
    let mut session = Session::open(NAME, flags, &task, units)?;
    let mut trained = Vec::new();
    for seed in 1..=settings.seeds {
        let key = format!("seed{seed}");
        trained.push(session.piece(&key, settings.updates, |progress| {
            train(&task, seed.into(), progress)
        })?);
    }
    write_data(&session, &trained)?;
    session.figure("fig2", &fig2(&task, &trained[0])?)?;
    session.figure("learning", &learning(&task, &trained))?;
    let command = command_line(NAME, flags, session.folder());
    session.finish(&page(&task, &trained, command, flags.smoke))
}

fn write_data(session: &Session, trained: &[Trained]) -> anyhow::Result<()> {
    let seeds = || trained.iter().enumerate();
    let checks = seeds().flat_map(|(seed, one)| {
        one.checks.iter().map(move |(update, measured)| {
            let numbers = [
                measured.auc,
                measured.auc_raw,
                measured.auc_clear,
                measured.auc_pairs,
                measured.loss,
            ];
            let head = [(seed + 1).to_string(), update.to_string()];
            let numbers = numbers.map(|number| format!("{number:.4}"));
            head.into_iter().chain(numbers).collect()
        })
    });
    let header = [
        "seed",
        "updates",
        "auc",
        "auc_raw_score",
        "auc_clear",
        "auc_pairs",
        "loss_nats",
    ];
    session.csv("auc", &header, checks)?;
    let losses = seeds().flat_map(|(seed, one)| {
        smoothed(&one.loss).map(move |(update, loss)| {
            vec![
                (seed + 1).to_string(),
                format!("{update:.0}"),
                format!("{loss:.4}"),
            ]
        })
    });
    session.csv("loss", &["seed", "updates", "loss_nats"], losses)?;
    let maps = trained[0].maps.iter().enumerate();
    let maps = maps.flat_map(|(episode, map)| {
        map.iter().enumerate().map(move |(location, score)| {
            vec![
                (episode + 1).to_string(),
                location.to_string(),
                format!("{score:.4}"),
            ]
        })
    });
    session.csv("maps", &["episode", "location", "score_nats"], maps)
}

/// Means of `LOSS_WINDOW` updates each, at their end.
fn smoothed(loss: &[f32]) -> impl Iterator<Item = (f64, f64)> + '_ {
    loss.chunks(LOSS_WINDOW).enumerate().map(|(index, chunk)| {
        let mean = chunk.iter().copied().map(f64::from).sum::<f64>() / chunk.len() as f64;
        ((index * LOSS_WINDOW + chunk.len()) as f64, mean)
    })
}

/// Lattices and scores of the first measured episodes.
fn fig2(task: &Task, first: &Trained) -> anyhow::Result<Figure> {
    let settings = &task.settings;
    let early_t = settings.from_t + 1;
    let steps = settings.late_t.max(early_t);
    let played = Episodes::measured(task, steps)?;
    let (side, patch) = (task.world.lattice_size, task.world.patch_size);
    let shown = first.maps.len();
    let outline = |episode: usize| {
        let (top, left) = played.origins[episode];
        Outline {
            left: left as f64,
            top: top as f64,
            side: patch as f64,
        }
    };
    let lattice = |episode: usize, t: u32| {
        let bytes = side * side;
        let frame = &played.frames[t as usize][episode * bytes..(episode + 1) * bytes];
        Panel::Lattice(Lattice {
            title: format!("Episode {}, t = {t}", episode + 1),
            side,
            dark: frame.iter().map(|&pixel| pixel == 0).collect(),
            outline: Some(outline(episode)),
        })
    };
    let values = || first.maps.iter().flatten().copied();
    let range = (
        values().fold(f64::INFINITY, f64::min),
        values().fold(f64::NEG_INFINITY, f64::max),
    );
    let view = View::of(&task.model);
    let scores = |episode: usize| {
        let map = first.maps[episode].iter().map(|score| Some(*score));
        Panel::Heat(Heat {
            unit: "score [nats]".into(),
            range: Some(range),
            field: Some(Field {
                side: side as f64,
                first: (view.side - view.step) as f64 / 2.0,
                cell: view.step as f64,
            }),
            outline: Some(outline(episode)),
            ..Heat::new(
                &format!("Scores, t = {} to {early_t}", settings.from_t),
                view.columns,
                map.collect(),
            )
        })
    };
    let panels = (0..shown)
        .map(|episode| lattice(episode, early_t))
        .chain((0..shown).map(|episode| lattice(episode, settings.late_t)))
        .chain((0..shown).map(scores));
    Ok(Figure {
        title: format!("Local DIM on a {patch} x {patch} Ising patch in noise"),
        notes: vec![format!(
            "Seed 1; episodes that were not trained on; the patch is outlined. Score: log-softmax of the true pair among \
             {} episodes, plus ln {}, at each of the {} places of the last convolution.",
            settings.batch_rows,
            settings.batch_rows,
            view.columns * view.columns,
        )],
        columns: shown,
        panel_size: (336.0, 280.0),
        panels: panels.collect(),
    })
}

/// Loss and what the scores tell, over updates.
fn learning(task: &Task, trained: &[Trained]) -> Figure {
    let over = |name: &str, index: usize, value: &dyn Fn(&Measured) -> f64| {
        let (mut points, mut band) = (Vec::new(), Vec::new());
        for (at, (update, _)) in trained[0].checks.iter().enumerate() {
            let values = trained.iter().map(|one| value(&one.checks[at].1));
            if let Some(spread) = Spread::of(values) {
                points.push((*update as f64, spread.mean));
                band.push((*update as f64, spread.min, spread.max));
            }
        }
        Series::line(name, index, points).banded(band)
    };
    let ends = vec![(0.0, 0.5), (task.settings.updates as f64, 0.5)];
    let areas = vec![
        Series::line("nothing told", 0, ends)
            .coloured(GREY)
            .marked(Mark::Dashed),
        over("patch or noise", 0, &|measured| measured.auc),
        over("patch or noise, clear places", 2, &|measured| {
            measured.auc_clear
        }),
        over("in the patch: true pair or other", 1, &|measured| {
            measured.auc_pairs
        })
        .marked(Mark::Dashed),
    ];
    let losses = trained.iter().enumerate().map(|(seed, one)| {
        Series::line(
            &format!("seed {}", seed + 1),
            seed,
            smoothed(&one.loss).collect(),
        )
    });
    Figure {
        title: "What local DIM learns of the Ising world".into(),
        notes: vec![format!(
            "Left: means of {LOSS_WINDOW} updates. Right: mean and range over seeds; {} episodes on the way, {} at the end.",
            task.settings.check_episodes, task.settings.episodes
        )],
        columns: 2,
        panel_size: (430.0, 330.0),
        panels: vec![
            Panel::Chart(Chart::new(
                "Local DIM loss (3t3), training",
                Axis::linear("updates"),
                Axis::linear("InfoNCE [nats]"),
                losses.collect(),
            )),
            Panel::Chart(Chart::new(
                "What the scores tell",
                Axis::linear("updates"),
                Axis::linear("area under the ROC curve").showing(&[0.5, 1.0]),
                areas,
            )),
        ],
    }
}

fn page(task: &Task, trained: &[Trained], command: String, smoke: bool) -> Page {
    let settings = &task.settings;
    let view = View::of(&task.model);
    let next_t = settings.from_t + 1;
    let last = |value: &dyn Fn(&Measured) -> f64| {
        Spread::of(trained.iter().map(|one| value(&one.last)))
            .map_or("none".to_owned(), |spread| spread.to_string())
    };
    let untrained = Spread::of(trained.iter().map(|one| one.checks[0].1.auc));
    let untrained = untrained.map_or("none".to_owned(), |spread| spread.to_string());
    Page {
        title: "An Ising patch in noise (Fig. 2)".into(),
        claim: format!(
            "Local DIM encodes regions of high temporal predictability: its scores from t = {} to t = {next_t} are higher \
             in the part of the lattice that follows an Ising model than in the noise around it.",
            settings.from_t
        ),
        command,
        expected: vec![
            "Heat maps that are bright inside the patch and dark outside; an area under the ROC curve well above 0.5, the \
             value of an untrained or blind score."
                .into(),
            format!(
                "Not 1: a location sees {0} x {0} pixels, so most see both patch and noise.",
                view.side
            ),
        ],
        got: vec![
            format!(
                "Score against membership in the patch, {} episodes that were not trained on: area under the ROC curve {}; \
                 by the raw score {}.",
                settings.episodes,
                last(&|measured| measured.auc),
                last(&|measured| measured.auc_raw),
            ),
            format!(
                "Among locations that see nothing but patch or nothing of it: {}.",
                last(&|measured| measured.auc_clear)
            ),
            format!("Before training: {untrained}."),
            format!(
                "Inside the patch, true pairs against pairs of two episodes whose patches both cover the location: {}. \
                 (At 0.5 the score would be a mere detector of patches; at 1 it tells *this* future from any other \
                 patch's.)",
                last(&|measured| measured.auc_pairs)
            ),
            format!(
                "Loss on the episodes of these measurements, at the end: {} nats, of ln {} = {:.2} for a blind score.",
                last(&|measured| measured.loss),
                settings.batch_rows,
                (settings.batch_rows as f64).ln()
            ),
        ],
        tables: Vec::new(),
        differences: vec![
            "The paper shows three heat maps and gives no number; the areas under the curve are ours.".into(),
            "The paper's appendix draws the patch's place anew at every time step, its main text once an episode. Ours \
             follows the main text: a patch that jumps has no future to predict."
                .into(),
            "One time step is one Metropolis sweep over the patch with periodic rim; the paper says neither. The sampler is \
             checked against exact enumeration, Kaufman's finite lattices and Onsager's solution in `actor/envs`."
                .into(),
            format!(
                "Batches of {} pairs, {} updates; the paper's length is \"10 epochs\" of a number of snapshots that it does \
                 not give.",
                settings.batch_rows, settings.updates
            ),
        ],
        setup: vec![
            format!(
                "{0} x {0} spins, patch {1} x {1}, temperature {2}; the project's torso and local heads (width {3}), \
                 lambda_3t3 = 1 alone, no action, Adam at {4}; {5} seeds. A row is another episode at its own t < {6}.",
                task.world.lattice_size,
                task.world.patch_size,
                task.world.temperature,
                task.model.rkhs,
                task.learner.adam.lr,
                trained.len(),
                task.world.episode_steps,
            ),
            format!(
                "Score: the positive's log-softmax among {} episodes, as in the paper's listing. A location belongs to the \
                 patch if the centre of its receptive field does.",
                settings.batch_rows
            ),
        ],
        figures: vec![
            (
                "fig2".into(),
                format!("Three episodes: the lattice at t = {next_t} and t = {}, and the scores", settings.late_t),
            ),
            ("learning".into(), "Loss and areas under the ROC curve".into()),
        ],
        data: vec![
            ("auc".into(), "each measurement of each seed".into()),
            ("loss".into(), format!("training loss, means of {LOSS_WINDOW} updates")),
            ("maps".into(), "the heat maps, row by row".into()),
        ],
        smoke,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn smoke() -> Settings {
        toml::from_str(include_str!("smoke.toml")).unwrap()
    }

    #[test]
    fn both_lengths_read_and_ask_for_local_dim_alone() {
        let full: Settings = toml::from_str(include_str!("config.toml")).unwrap();
        for settings in [smoke(), full] {
            let task = task(&settings).unwrap();
            assert_eq!(
                task.learner.lambda.wanted(),
                [true, false, false, false],
                "the paper's table of parameters"
            );
            assert_eq!((task.world.lattice_size, task.world.patch_size), (84, 42));
            assert!(!task.model.dim.action);
        }
    }
}
