//! Fig. 2: on a patch of an Ising model in noise, local DIM gives high scores where the future can be predicted.
//! `training` learns and measures; this module has the seeds, the figures and the page.

mod training;

use driml_envs::WorldConfig;
use driml_figure::{Axis, Chart, Field, Figure, GREY, Heat, Lattice, Mark, Panel, Rect, Series};
use driml_launch::metrics::rounded;
use driml_machine::{error::usage, resources::Machine};
use driml_settings::flags::resolve_names;
use minijinja::{Value, context};

use self::training::{Episodes, Measurement, Outcome, ReceptiveFields, Settings, Task, train};
use crate::{
    cache::Session,
    flags::{self, ExperimentFlags},
    plot::{Band, Curve},
    stats::Spread,
};

const SETTINGS: &str = include_str!("config.toml");
/// The number of updates over which the drawn loss is averaged.
const LOSS_WINDOW: usize = 10;

/// Returns the world, the network and the optimiser as a run would have them.
fn new_task(settings: &Settings) -> anyhow::Result<Task> {
    let sets: Vec<_> = settings.sets.iter().map(String::as_str).collect();
    // `driml-fix` gives DIM with k = 1. Nothing else of the agent is used here.
    let config = resolve_names("paper", "ising", "driml-fix", &sets, &Machine::detect())?;
    // The experiment steps the world directly, and the world has full-size frames.
    let config = config.with_whole_frames()?;
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

pub(crate) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let settings: Settings = flags::read_settings(SETTINGS, args);
    let task = new_task(&settings)?;
    let units = u64::from(settings.seeds) * settings.updates;
    let mut session = Session::open("ising", args, &task, units, false)?;
    let mut trained = Vec::new();
    for seed in 1..=settings.seeds {
        let piece =
            session.load_or_compute("", &format!("seed{seed}"), settings.updates, |progress| {
                train(&task, seed.into(), progress)
            })?;
        trained.push(piece);
    }
    write_data(&session, &trained)?;
    session.save_figure("fig2", &fig2(&task, &trained[0])?)?;
    session.save_figure("learning", &learning_figure(&task, &trained))?;
    session.write_page(include_str!("page.md.j2"), page_values(&task, &trained))
}

fn write_data(session: &Session, trained: &[Outcome]) -> anyhow::Result<()> {
    let seeds = || (1u32..).zip(trained);
    let checks = seeds().flat_map(|(seed, one)| {
        one.checks.iter().map(move |(update, it)| {
            let of_check = [it.auc, it.auc_raw, it.auc_clear, it.auc_pairs, it.loss];
            (seed, *update, of_check.map(rounded))
        })
    });
    let columns = "seed,updates,auc,auc_raw_score,auc_clear,auc_pairs,loss_nats";
    session.write_csv("auc", columns, checks)?;
    let losses = seeds().flat_map(|(seed, one)| {
        window_means(&one.loss).map(move |(update, loss)| (seed, update as u64, rounded(loss)))
    });
    session.write_csv("loss", "seed,updates,loss_nats", losses)?;
    let maps = (1u32..).zip(&trained[0].maps).flat_map(|(episode, map)| {
        let scores = map.iter().enumerate();
        scores.map(move |(at, score)| (episode, at, rounded(*score)))
    });
    session.write_csv("maps", "episode,location,score_nats", maps)
}

/// Returns (update, mean loss) for each window of `LOSS_WINDOW` updates; the update is the last of its window.
fn window_means(loss: &[f32]) -> impl Iterator<Item = (f64, f64)> + '_ {
    loss.chunks(LOSS_WINDOW).enumerate().map(|(index, chunk)| {
        let mean = chunk.iter().copied().map(f64::from).sum::<f64>() / chunk.len() as f64;
        ((index * LOSS_WINDOW + chunk.len()) as f64, mean)
    })
}

fn fig2(task: &Task, first: &Outcome) -> anyhow::Result<Figure> {
    let settings = &task.settings;
    let early_t = settings.from_t + 1;
    let played = Episodes::play_measured(task, settings.late_t.max(early_t))?;
    let (side, patch) = (task.world.lattice_size, task.world.patch_size);
    let shown = first.maps.len();
    let outline = |episode: usize| {
        let (top, left) = played.origins[episode];
        let [left, top, side] = [left, top, patch].map(|it| it as f64);
        Rect::new(left, top, side, side)
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
    let shown_scores = Spread::of(first.maps.iter().flatten().copied());
    let shown_scores = shown_scores.filter(|it| it.min < it.max);
    let range = shown_scores.map_or((0.0, 1.0), |it| (it.min, it.max));
    let fields = ReceptiveFields::of(&task.model);
    let title = format!("Scores, t = {} to {early_t}", settings.from_t);
    let scores = |episode: usize| {
        Panel::Heat(Heat {
            unit: "score [nats]".into(),
            range,
            field: Some(Field {
                side: side as f64,
                first: (fields.side - fields.step) as f64 / 2.0,
                cell: fields.step as f64,
            }),
            outline: Some(outline(episode)),
            ..Heat::new(&title, fields.columns, first.maps[episode].clone())
        })
    };
    let panels = (0..shown)
        .map(|episode| lattice(episode, early_t))
        .chain((0..shown).map(|episode| lattice(episode, settings.late_t)))
        .chain((0..shown).map(scores));
    let (rows, places) = (settings.batch_size, fields.columns * fields.columns);
    Ok(Figure {
        title: format!("Local DIM on a {patch} x {patch} Ising patch in noise"),
        notes: vec![format!(
            "Seed 1; episodes that were not trained on; the patch is outlined. Score: log-softmax of the true pair among \
             {rows} episodes, plus ln {rows}, at each of the {places} places of the last convolution.",
        )],
        columns: shown,
        panel_size: (336.0, 280.0),
        panels: panels.collect(),
    })
}

/// Draws the loss, and how well the scores tell patch from noise, over updates.
fn learning_figure(task: &Task, trained: &[Outcome]) -> Figure {
    let auc_series = |name: &str, index: usize, value: fn(&Measurement) -> f64| {
        let checks = trained[0].checks.iter().enumerate();
        let means = checks.map(|(at, (update, _))| {
            let values = trained.iter().map(|one| value(&one.checks[at].1));
            (*update as f64, values.collect())
        });
        Curve::from_values(means, Band::Range).series(name, index)
    };
    let ends = vec![(0.0, 0.5), (task.settings.updates as f64, 0.5)];
    let chance = Series::line("chance", 0, ends).with_colour(GREY);
    let pairs = auc_series("in the patch: true pair or other", 1, |it| it.auc_pairs);
    let areas = vec![
        chance.with_mark(Mark::Dashed),
        auc_series("patch or noise", 0, |it| it.auc),
        auc_series("patch or noise, clear places", 2, |it| it.auc_clear),
        pairs.with_mark(Mark::Dashed),
    ];
    let losses = trained.iter().enumerate().map(|(seed, one)| {
        let name = format!("seed {}", seed + 1);
        Series::line(&name, seed, window_means(&one.loss).collect())
    });
    let updates = || Axis::linear("updates");
    let loss = Axis::linear("InfoNCE [nats]");
    let area = Axis::linear("area under the ROC curve").covering(&[0.5, 1.0]);
    let (left, right) = ("Local DIM loss (3t3), training", "What the scores tell");
    Figure {
        title: "What local DIM learns of the Ising world".into(),
        notes: vec![format!(
            "Left: means of {LOSS_WINDOW} updates. Right: mean and range over seeds; {} episodes on the way, {} at the end.",
            task.settings.check_episodes, task.settings.episodes
        )],
        columns: 2,
        panel_size: (430.0, 330.0),
        panels: vec![
            Panel::Chart(Chart::new(left, updates(), loss, losses.collect())),
            Panel::Chart(Chart::new(right, updates(), area, areas)),
        ],
    }
}

fn page_values(task: &Task, trained: &[Outcome]) -> Value {
    let last = trained.iter().map(|one| one.checks.last());
    let last: Vec<_> = last.flatten().map(|check| check.1).collect();
    let untrained: Vec<_> = trained.iter().map(|one| one.checks[0].1.auc).collect();
    context! {
        task,
        settings => task.settings,
        seeds => trained.len(),
        view => ReceptiveFields::of(&task.model).side,
        last,
        untrained,
        blind_loss => (task.settings.batch_size as f64).ln(),
        loss_window => LOSS_WINDOW,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flags::tests::parse;

    pub(super) fn smoke() -> Settings {
        flags::read_settings(SETTINGS, &parse("--smoke"))
    }

    #[test]
    fn both_lengths_read_and_ask_for_local_dim_alone() {
        for length in ["", "--smoke"] {
            let settings = flags::read_settings(SETTINGS, &parse(length));
            let task = new_task(&settings).unwrap();
            // From the paper's table of parameters.
            let local = [true, false, false, false];
            assert_eq!(task.learner.lambda.active_pairs(), local);
            assert_eq!((task.world.lattice_size, task.world.patch_size), (84, 42));
            assert!(!task.model.dim.action);
        }
    }
}
