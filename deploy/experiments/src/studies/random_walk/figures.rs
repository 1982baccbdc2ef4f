//! The figures of the random walk.
//! They show numbers that `mod` has, and compute means over seeds alone.

use driml_figure::{Axis, Chart, Figure, GREY, Heat, Mark, Panel, Series};

use super::{
    chain::Chain,
    results::{Measure, Results, Trained},
    training::Sampling,
};
use crate::stats::Spread;

/// The paper's four panels.
pub(super) fn fig1(results: &Results) -> Figure {
    let settings = &results.settings;
    let alpha = settings.figure_alpha;
    let chain = results.chain(alpha);
    let (t, rho, k) = (chain.transitions(), chain.stationary(), settings.states);
    let truth: Vec<f64> = (0..k * k).map(|at| t[at] / rho[at % k]).collect();
    let high = truth.iter().copied().fold(0.0, f64::max) * 1.1;
    let learnt: Vec<_> = results.of(Sampling::Stationary, alpha).collect();
    let learnt = (0..k * k).map(|at| {
        let spread = Spread::of(learnt.iter().map(|one| one.learnt.ratio[at]));
        spread.map(|spread| spread.mean)
    });
    let heat = |title: &str, values: Vec<Option<f64>>| Heat {
        names: (1..=k).map(|state| state.to_string()).collect(),
        labels: ("next state".into(), "state".into()),
        unit: "T / \u{3c1} [ratio]".into(),
        range: Some((0.0, high)),
        decimals: Some(1),
        ..Heat::new(title, k, values)
    };
    let panels = vec![
        Panel::Heat(heat(
            &format!("(a) True ratio, \u{3b1} = {alpha}"),
            truth.iter().map(|ratio| Some(*ratio)).collect(),
        )),
        Panel::Heat(heat(
            &format!("(b) Learnt ratio, mean of {} seeds", settings.seeds),
            learnt.collect(),
        )),
        Panel::Chart(information(results)),
        Panel::Chart(inverse_gap(results)),
    ];
    Figure {
        title: format!("InfoNCE on a biased random walk over {k} states"),
        notes: vec![format!(
            "Learnt: {} updates of {} independent pairs; stationary sampling.",
            settings.updates, settings.batch_size
        )],
        columns: 2,
        panel_size: (430.0, 380.0),
        panels,
    }
}

/// Biases for smooth curves.
fn fine() -> impl Iterator<Item = f64> {
    (1..=97).map(|i| 0.02 + f64::from(i - 1) * 0.01)
}

fn curve(results: &Results, value: impl Fn(&Chain) -> f64) -> Vec<(f64, f64)> {
    let at = |alpha: f64| (alpha, value(&results.chain(alpha)));
    fine().map(at).collect()
}

fn information(results: &Results) -> Chart {
    let alphas = &results.settings.alphas;
    let k = results.settings.states;
    let numerical = alphas.iter().map(|&alpha| {
        let t = results.chain(alpha).transitions();
        (alpha, super::chain::mutual_information_numerically(&t, k))
    });
    let (mut learnt, mut band) = (Vec::new(), Vec::new());
    for &alpha in alphas {
        let all = results.chain(alpha).mutual_information();
        let each = results.of(Sampling::Stationary, alpha);
        if let Some(spread) = Spread::of(each.map(|one| all - one.final_excess())) {
            learnt.push((alpha, spread.mean));
            band.push((alpha, spread.min, spread.max));
        }
    }
    Chart::new(
        "(c) Mutual information of successive states",
        Axis::linear("\u{3b1}, probability of a step up").showing(&[0.0, 1.0]),
        Axis::linear("I(S, S') [nats]").showing(&[0.0]),
        vec![
            Series::line(
                "a ring, no ends",
                0,
                curve(results, Chain::mutual_information_of_a_ring),
            )
            .coloured(GREY)
            .marked(Mark::Dashed),
            Series::line("closed form", 0, curve(results, Chain::mutual_information)),
            Series::line("numerical", 0, numerical.collect()).marked(Mark::Rings),
            Series::line("learnt", 1, learnt)
                .banded(band)
                .marked(Mark::Bars),
        ],
    )
}

fn inverse_gap(results: &Results) -> Chart {
    let k = results.settings.states;
    let numerical = results.settings.alphas.iter().map(|&alpha| {
        let t = results.chain(alpha).transitions();
        (alpha, 1.0 / super::chain::spectral_gap_numerically(&t, k))
    });
    Chart::new(
        "(d) Inverse spectral gap",
        Axis::linear("\u{3b1}, probability of a step up").showing(&[0.0, 1.0]),
        Axis::linear("1 / (1 - \u{3bb}\u{2082}) [steps]").showing(&[0.0]),
        vec![
            Series::line(
                "closed form",
                0,
                curve(results, |chain| 1.0 / chain.spectral_gap()),
            ),
            Series::line("numerical", 0, numerical.collect()).marked(Mark::Rings),
        ],
    )
}

/// How fast it is learnt, against the gap.
pub(super) fn convergence(results: &Results) -> Figure {
    let settings = &results.settings;
    let times = |title: &str, measure| {
        let by_gap = Axis::log("1 / (1 - \u{3bb}\u{2082}) [steps]");
        let series = Sampling::ALL.iter().enumerate();
        let series = series.map(|(index, &sampling)| {
            let value = |one: &Trained| results.time(one, measure).map(|time| time as f64);
            // Moved by a few percent, so that no point hides another.
            let aside = 1.0 + 0.035 * (index as f64 - 1.0);
            let at = |chain: &Chain| aside / chain.spectral_gap();
            over_alphas(results, sampling, index, at, value)
        });
        Chart::new(title, by_gap, Axis::log("updates"), series.collect())
    };
    let last = Sampling::ALL.iter().enumerate().map(|(index, &sampling)| {
        let value = |one: &Trained| Some(one.final_tv());
        let aside = 0.012 * (index as f64 - 1.0);
        over_alphas(results, sampling, index, |chain| chain.alpha + aside, value)
    });
    Figure {
        title: "Does InfoNCE converge as the spectral gap says?".into(),
        notes: vec![format!(
            "Points: means of {} seeds; bars and bands: smallest to largest; samplings stand a little apart. What is near enough from the start, at 0 updates, has no place on a logarithmic axis.",
            settings.seeds
        )],
        columns: 2,
        panel_size: (430.0, 350.0),
        panels: vec![
            Panel::Chart(curves(results)),
            Panel::Chart(times(
                &format!("Updates until the law is within {}", settings.tv_reached),
                Measure::Tv,
            )),
            Panel::Chart(times(
                &format!(
                    "Updates until {:.0}% of I(S, S') is learnt",
                    100.0 * (1.0 - settings.share_reached)
                ),
                Measure::Share,
            )),
            Panel::Chart(Chart::new(
                &format!("Error after {} updates", settings.updates),
                Axis::linear("\u{3b1}, probability of a step up").showing(&[0.0, 1.0]),
                Axis::linear("total variation [probability]").showing(&[0.0]),
                last.collect(),
            )),
        ],
    }
}

/// Mean and range over seeds at each alpha.
fn over_alphas(
    results: &Results,
    sampling: Sampling,
    index: usize,
    x: impl Fn(&Chain) -> f64,
    value: impl Fn(&Trained) -> Option<f64>,
) -> Series {
    let (mut points, mut band) = (Vec::new(), Vec::new());
    for &alpha in &results.settings.alphas {
        let x = x(&results.chain(alpha));
        if let Some(spread) = Spread::of(results.of(sampling, alpha).filter_map(&value)) {
            points.push((x, spread.mean));
            band.push((x, spread.min, spread.max));
        }
    }
    Series::line(sampling.name(), index, points)
        .banded(band)
        .marked(Mark::Bars)
}

/// The biases of the curves: the strongest below 0.5, one between, and the figure's.
pub(super) fn shown(results: &Results) -> Vec<f64> {
    let alphas = &results.settings.alphas;
    let figure = alphas
        .iter()
        .position(|alpha| *alpha == results.settings.figure_alpha)
        .unwrap_or(0);
    let mut shown = vec![0, figure / 2, figure];
    shown.dedup();
    shown.into_iter().map(|at| alphas[at]).collect()
}

/// Total variation over updates, over the seeds of stationary sampling.
pub(super) fn tv_curve(results: &Results, alpha: f64) -> Vec<(u64, Spread)> {
    let each: Vec<_> = results.of(Sampling::Stationary, alpha).collect();
    let updates = each.first().map_or(&[][..], |one| &one.learnt.updates[..]);
    let points = updates.iter().enumerate();
    points
        .filter_map(|(i, update)| {
            let spread = Spread::of(each.iter().map(|one| one.learnt.tv[i]))?;
            Some((*update, spread))
        })
        .collect()
}

fn curves(results: &Results) -> Chart {
    let series = shown(results)
        .into_iter()
        .enumerate()
        .map(|(index, alpha)| {
            let curve = tv_curve(results, alpha);
            let at = |(update, spread): &(u64, Spread)| (*update as f64, spread.mean);
            let band = |(update, spread): &(u64, Spread)| (*update as f64, spread.min, spread.max);
            let gap = results.chain(alpha).spectral_gap();
            let name = format!("\u{3b1} = {alpha}, gap {gap:.2}");
            Series::line(&name, index, curve.iter().map(at).collect())
                .banded(curve.iter().map(band).collect())
        });
    Chart::new(
        "Error on the way, stationary",
        Axis::log("updates"),
        Axis::log("total variation [probability]"),
        series.collect(),
    )
}
