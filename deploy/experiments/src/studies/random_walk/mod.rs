//! Fig. 1: InfoNCE on a biased random walk learns T / rho. Does it converge as fast as the spectral gap predicts?
//! `chain` has the closed forms, `training` learns, `results` has what follows from several trainings; this module has the grid, the data, the
//! figures and the page.

mod chain;
mod results;
mod training;

use driml_figure::{Axis, Chart, Figure, GREY, Heat, Mark, Panel, Series};
use driml_launch::metrics::rounded;
use driml_machine::units::count;
use minijinja::{Value, context};

use self::{
    chain::Chain,
    results::{Results, TO_SHARE, TO_TV, Trained, UpdatesTo},
    training::{Sampling, Settings, train},
};
use crate::{
    cache::Session,
    flags::{self, ExperimentFlags},
    plot::{Band, Curve},
    stats::{Spread, mean},
};

const SETTINGS: &str = include_str!("config.toml");

pub(crate) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let settings: Settings = flags::read_settings(SETTINGS, args);
    let pieces = settings.alphas.len() * Sampling::ALL.len() * settings.seeds as usize;
    let units = pieces as u64 * settings.updates;
    let mut session = Session::open("random-walk", args, &settings, units, false)?;

    let mut trained = Vec::with_capacity(pieces);
    let grid = Sampling::ALL.into_iter().flat_map(|sampling| {
        let alphas = settings.alphas.iter();
        alphas.flat_map(move |&alpha| (1..=settings.seeds).map(move |seed| (sampling, alpha, seed)))
    });
    for (sampling, alpha, seed) in grid {
        let chain = Chain::new(settings.states, alpha);
        let key = format!("{}-alpha{alpha}-seed{seed}", sampling.name());
        let learnt = session.load_or_compute("", &key, settings.updates, |progress| {
            train(&chain, &settings, sampling, seed.into(), progress)
        })?;
        let share = settings.share_reached * chain.mutual_information();
        trained.push(Trained {
            updates_to_tv: learnt.updates_to(&learnt.tv, settings.tv_reached),
            updates_to_share: learnt.updates_to(&learnt.excess, share),
            chain,
            sampling,
            seed,
            learnt,
        });
    }
    let results = Results { settings, trained };
    write_data(&session, &results)?;
    session.save_figure("fig1", &fig1(&results))?;
    session.save_figure("convergence", &convergence_figure(&results))?;
    session.write_page(include_str!("page.md.j2"), page_values(&results))
}

fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let k = results.settings.states;
    let laws = results.settings.alphas.iter().map(|&alpha| {
        let chain = results.chain(alpha);
        let learnt = mean(&results.learnt_information(alpha));
        let of_chain = [
            chain.mutual_information(),
            chain.mutual_information_numerically(),
            learnt.expect("each bias has a seed"),
            chain.mutual_information_of_a_ring(),
            chain.mutual_information_as_printed(),
            chain.spectral_gap(),
            chain.spectral_gap_numerically(),
        ];
        (alpha, of_chain.map(rounded))
    });
    let columns = "alpha,mi_nats,mi_numerical_nats,mi_learnt_nats,mi_ring_nats,mi_as_printed_nats,gap,gap_numerical";
    session.write_csv("alpha", columns, laws)?;

    let (truth, learnt) = (results.true_ratio(), results.learnt_ratio());
    let entries = truth.iter().zip(&learnt).enumerate();
    let entries = entries.map(|(at, (truth, learnt))| {
        let sd = (learnt.count > 1).then(|| rounded(learnt.sd));
        let means = [*truth, learnt.mean].map(rounded);
        (at / k + 1, at % k + 1, means, sd)
    });
    let columns = "state,next,true_ratio,learnt_mean,learnt_sd";
    session.write_csv("ratio", columns, entries)?;

    let times = results.trained.iter().map(|one| {
        let gap = rounded(one.chain.spectral_gap());
        let of = (one.sampling.name(), one.chain.alpha, one.seed, gap);
        let last = [one.final_tv(), one.final_excess()].map(rounded);
        (of, TO_TV(one), TO_SHARE(one), last)
    });
    let columns =
        "sampling,alpha,seed,gap,updates_to_tv,updates_to_share,final_tv,final_excess_nats";
    session.write_csv("convergence", columns, times)?;

    let curves = results.shown_alphas().into_iter().flat_map(|alpha| {
        let Curve { points, band } = results.tv_curve(alpha);
        let rows = points.into_iter().zip(band);
        rows.map(move |((updates, mean), (_, min, max))| {
            (alpha, updates as u64, [mean, min, max].map(rounded))
        })
    });
    session.write_csv("curves", "alpha,updates,tv_mean,tv_min,tv_max", curves)
}

fn page_values(results: &Results) -> Value {
    let settings = &results.settings;
    let truth = results.true_ratio();
    let of_seed = |one: &Trained| {
        let pairs = one.learnt.ratio.iter().zip(&truth);
        Spread::of(pairs.map(|(learnt, truth)| (learnt - truth).abs()))
    };
    let at_figure = || results.select(Sampling::Stationary, settings.figure_alpha);
    let errors: Vec<Spread> = at_figure().filter_map(of_seed).collect();
    let of_errors = |part: fn(&Spread) -> f64| errors.iter().map(part).collect::<Vec<_>>();
    let holds = |measure: UpdatesTo| {
        let found = results.gap_correlations(Sampling::Stationary, measure);
        mean(&found).is_some_and(|mean| mean > 0.5)
    };
    let samplings = Sampling::ALL.map(|sampling| {
        let trained = results.trained.iter().filter(|it| it.sampling == sampling);
        let [tv, share] = [TO_TV, TO_SHARE].map(|it| results.gap_correlations(sampling, it));
        context! {
            name => sampling.name(),
            trained => trained.collect::<Vec<_>>(),
            correlations => context! { tv, share },
        }
    });
    // These values follow from the closed forms alone, whatever the length of the experiment.
    let closed_forms = [0.5, 0.9, 0.3].map(|alpha| {
        let chain = results.chain(alpha);
        context! {
            mi => chain.mutual_information(),
            ring => chain.mutual_information_of_a_ring(),
            printed => chain.mutual_information_as_printed(),
        }
    });
    context! {
        settings,
        seeds => settings.seeds,
        mean_errors => of_errors(|it| it.mean),
        largest_errors => of_errors(|it| it.max),
        largest_ratio => truth.iter().copied().fold(0.0, f64::max),
        final_tv => at_figure().map(Trained::final_tv).collect::<Vec<_>>(),
        samplings,
        missed => 1.0 - settings.share_reached,
        tv_reached => settings.tv_reached,
        absolute => holds(TO_TV),
        relative => holds(TO_SHARE),
        closed_forms,
        most => (settings.states as f64).ln(),
    }
}

fn fig1(results: &Results) -> Figure {
    let settings = &results.settings;
    let k = settings.states;
    let (truth, learnt) = (results.true_ratio(), results.learnt_ratio());
    let high = truth.iter().copied().fold(0.0, f64::max) * 1.1;
    let heat = |title: String, values: Vec<f64>| {
        Panel::Heat(Heat {
            names: (1..=k).map(|state| state.to_string()).collect(),
            labels: ("next state".into(), "state".into()),
            unit: "T / \u{3c1} [ratio]".into(),
            range: (0.0, high),
            decimals: Some(1),
            ..Heat::new(&title, k, values)
        })
    };
    let of_truth = format!("(a) True ratio, \u{3b1} = {}", settings.figure_alpha);
    let of_learnt = format!(
        "(b) Learnt ratio, mean of {}",
        count(settings.seeds, "seed")
    );
    Figure {
        title: format!("InfoNCE on a biased random walk over {k} states"),
        notes: vec![format!(
            "Learnt: {} updates of {} independent pairs; stationary sampling.",
            settings.updates, settings.batch_size
        )],
        columns: 2,
        panel_size: (430.0, 380.0),
        panels: vec![
            heat(of_truth, truth),
            heat(of_learnt, learnt.iter().map(|it| it.mean).collect()),
            information_panel(results),
            inverse_gap_panel(results),
        ],
    }
}

fn alpha_axis() -> Axis {
    Axis::linear("\u{3b1}, probability of a step up").covering(&[0.0, 1.0])
}

/// Draws a closed form over many biases, so that its curve is smooth.
fn closed_form_series(results: &Results, name: &str, value: impl Fn(&Chain) -> f64) -> Series {
    let fine = (1..=97).map(|i| 0.02 + f64::from(i - 1) * 0.01);
    let points = fine.map(|alpha| (alpha, value(&results.chain(alpha))));
    Series::line(name, 0, points.collect())
}

/// Draws a numerical result as a ring at each alpha of the settings.
fn numerical_series(results: &Results, value: impl Fn(&Chain) -> f64) -> Series {
    let alphas = results.settings.alphas.iter();
    let points = alphas.map(|&alpha| (alpha, value(&results.chain(alpha))));
    Series::line("numerical", 0, points.collect()).with_mark(Mark::Rings)
}

fn information_panel(results: &Results) -> Panel {
    let alphas = results.settings.alphas.iter();
    let learnt = alphas.map(|&alpha| (alpha, results.learnt_information(alpha)));
    let learnt = Curve::from_values(learnt, Band::Range).series("learnt", 1);
    let of_a_ring = Chain::mutual_information_of_a_ring;
    let ring = closed_form_series(results, "a ring, no ends", of_a_ring).with_colour(GREY);
    let series = vec![
        ring.with_mark(Mark::Dashed),
        closed_form_series(results, "closed form", Chain::mutual_information),
        numerical_series(results, Chain::mutual_information_numerically),
        learnt.with_mark(Mark::Bars),
    ];
    let title = "(c) Mutual information of successive states";
    let y = Axis::linear("I(S, S') [nats]").covering(&[0.0]);
    Panel::Chart(Chart::new(title, alpha_axis(), y, series))
}

fn inverse_gap_panel(results: &Results) -> Panel {
    let series = vec![
        closed_form_series(results, "closed form", |it| 1.0 / it.spectral_gap()),
        numerical_series(results, |it| 1.0 / it.spectral_gap_numerically()),
    ];
    let y = Axis::linear("1 / (1 - \u{3bb}\u{2082}) [steps]").covering(&[0.0]);
    let title = "(d) Inverse spectral gap";
    Panel::Chart(Chart::new(title, alpha_axis(), y, series))
}

fn convergence_figure(results: &Results) -> Figure {
    let settings = &results.settings;
    let times = |mut title: String, measure: UpdatesTo| {
        // A training that never comes that far has no point.
        let never = results.trained.iter().filter(|it| measure(it).is_none());
        let never = never.count();
        if never > 0 {
            title += &format!("; never by {}", count(never, "training"));
        }
        let at = |chain: &Chain, x_offset: f64| (1.0 + 0.035 * x_offset) / chain.spectral_gap();
        let series = sampling_series(results, at, |one| measure(one).map(|time| time as f64));
        let x = Axis::log("1 / (1 - \u{3bb}\u{2082}) [steps]");
        Panel::Chart(Chart::new(&title, x, Axis::log("updates"), series))
    };
    let at = |chain: &Chain, x_offset: f64| chain.alpha + 0.012 * x_offset;
    let last = sampling_series(results, at, |one| Some(one.final_tv()));
    let of_tv = format!("Updates until the law is within {}", settings.tv_reached);
    let share = 100.0 * (1.0 - settings.share_reached);
    let of_share = format!("Updates until {share:.0}% of I(S, S') is learnt");
    let of_last = format!("Error after {} updates", settings.updates);
    let y = Axis::linear("total variation [probability]").covering(&[0.0]);
    Figure {
        title: "Does InfoNCE converge as the spectral gap says?".into(),
        notes: vec![format!(
            "Points: means of {}; bars and bands: smallest to largest; samplings stand a little apart. What is near enough from the start, at 0 updates, has no place on a logarithmic axis.",
            count(settings.seeds, "seed")
        )],
        columns: 2,
        panel_size: (430.0, 350.0),
        panels: vec![
            curves_panel(results),
            times(of_tv, TO_TV),
            times(of_share, TO_SHARE),
            Panel::Chart(Chart::new(&of_last, alpha_axis(), y, last)),
        ],
    }
}

/// Returns for each sampling the mean and range over seeds at each alpha. `x` receives an offset in -1..=1, so that no point hides another.
fn sampling_series(
    results: &Results,
    x: impl Fn(&Chain, f64) -> f64,
    value: impl Fn(&Trained) -> Option<f64>,
) -> Vec<Series> {
    let of = |(index, &sampling): (usize, &Sampling)| {
        let means = results.settings.alphas.iter().map(|&alpha| {
            let values = results.select(sampling, alpha).filter_map(&value);
            let x = x(&results.chain(alpha), index as f64 - 1.0);
            (x, values.collect())
        });
        let curve = Curve::from_values(means, Band::Range).series(sampling.name(), index);
        curve.with_mark(Mark::Bars)
    };
    Sampling::ALL.iter().enumerate().map(of).collect()
}

fn curves_panel(results: &Results) -> Panel {
    let shown = results.shown_alphas().into_iter().enumerate();
    let series = shown.map(|(index, alpha)| {
        let gap = results.chain(alpha).spectral_gap();
        let name = format!("\u{3b1} = {alpha}, gap {gap:.2}");
        results.tv_curve(alpha).series(&name, index)
    });
    let title = "Error on the way, stationary";
    let y = Axis::log("total variation [probability]");
    Panel::Chart(Chart::new(title, Axis::log("updates"), y, series.collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flags::tests::parse;

    #[test]
    fn both_lengths_read_and_have_the_figure_s_alpha() {
        for length in ["", "--smoke"] {
            let settings: Settings = flags::read_settings(SETTINGS, &parse(length));
            assert!(settings.alphas.contains(&settings.figure_alpha));
            assert!(settings.alphas.iter().all(|a| 0.0 < *a && *a < 1.0));
            assert!(settings.states >= 2 && settings.seeds > 0 && settings.updates > 0);
        }
    }
}
