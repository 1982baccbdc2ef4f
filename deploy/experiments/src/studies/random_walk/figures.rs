//! The figures of the random walk.
//! They show the numbers of `Results`, and compute nothing but means over seeds.

use driml_figure::{Axis, Chart, Figure, GREY, Heat, Mark, Panel, Series};
use driml_machine::units::count;

use super::{
    chain::Chain,
    results::{Results, TO_SHARE, TO_TV, Trained, UpdatesTo},
    training::Sampling,
};
use crate::plot::{Band, Curve};

pub(super) fn fig1(results: &Results) -> Figure {
    let settings = &results.settings;
    let k = settings.states;
    let (truth, learnt) = (results.true_ratio(), results.learnt_ratio());
    let high = truth.iter().copied().fold(0.0, f64::max) * 1.1;
    let heat = |title: String, values: Vec<Option<f64>>| {
        Panel::Heat(Heat {
            names: (1..=k).map(|state| state.to_string()).collect(),
            labels: ("next state".into(), "state".into()),
            unit: "T / \u{3c1} [ratio]".into(),
            range: Some((0.0, high)),
            decimals: Some(1),
            ..Heat::new(&title, k, values)
        })
    };
    let of_truth = format!("(a) True ratio, \u{3b1} = {}", settings.figure_alpha);
    let of_learnt = format!(
        "(b) Learnt ratio, mean of {}",
        count(settings.seeds, "seed")
    );
    let learnt = learnt.iter().map(|it| Some(it.mean));
    Figure {
        title: format!("InfoNCE on a biased random walk over {k} states"),
        notes: vec![format!(
            "Learnt: {} updates of {} independent pairs; stationary sampling.",
            settings.updates, settings.batch_size
        )],
        columns: 2,
        panel_size: (430.0, 380.0),
        panels: vec![
            heat(of_truth, truth.into_iter().map(Some).collect()),
            heat(of_learnt, learnt.collect()),
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

pub(super) fn convergence_figure(results: &Results) -> Figure {
    let settings = &results.settings;
    let times = |title: String, measure: UpdatesTo| {
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
