//! The figures of the random walk.
//! They show numbers that `mod` has, and compute means over seeds alone.

use driml_figure::{Axis, Chart, Figure, GREY, Heat, Mark, Panel, Series};

use super::{
    chain::{Chain, mutual_information_numerically, spectral_gap_numerically},
    results::{Measure, Results, SHARE, TV, Trained},
    training::Sampling,
};
use crate::plot::Curve;

/// The paper's four panels.
pub(super) fn fig1(results: &Results) -> Figure {
    let settings = &results.settings;
    let alpha = settings.figure_alpha;
    let k = settings.states;
    let (truth, learnt) = (results.true_ratio(), results.learnt_ratio());
    let high = truth.iter().copied().fold(0.0, f64::max) * 1.1;
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
            learnt.iter().map(|it| Some(it.mean)).collect(),
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

fn by_alpha() -> Axis {
    Axis::linear("\u{3b1}, probability of a step up").showing(&[0.0, 1.0])
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
        (alpha, mutual_information_numerically(&t, k))
    });
    let learnt = alphas.iter().map(|&alpha| {
        let all = results.chain(alpha).mutual_information();
        let each = results.of(Sampling::Stationary, alpha);
        (alpha, each.map(|one| all - one.final_excess()).collect())
    });
    Chart::new(
        "(c) Mutual information of successive states",
        by_alpha(),
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
            Curve::of_means(learnt)
                .series("learnt", 1)
                .marked(Mark::Bars),
        ],
    )
}

fn inverse_gap(results: &Results) -> Chart {
    let k = results.settings.states;
    let numerical = results.settings.alphas.iter().map(|&alpha| {
        let t = results.chain(alpha).transitions();
        (alpha, 1.0 / spectral_gap_numerically(&t, k))
    });
    Chart::new(
        "(d) Inverse spectral gap",
        by_alpha(),
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
    let times = |title: &str, measure: Measure| {
        let by_gap = Axis::log("1 / (1 - \u{3bb}\u{2082}) [steps]");
        let series = Sampling::ALL.iter().enumerate();
        let series = series.map(|(index, &sampling)| {
            let value = |one: &Trained| measure(one).map(|time| time as f64);
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
                TV,
            )),
            Panel::Chart(times(
                &format!(
                    "Updates until {:.0}% of I(S, S') is learnt",
                    100.0 * (1.0 - settings.share_reached)
                ),
                SHARE,
            )),
            Panel::Chart(Chart::new(
                &format!("Error after {} updates", settings.updates),
                by_alpha(),
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
    let means = results.settings.alphas.iter().map(|&alpha| {
        let values = results.of(sampling, alpha).filter_map(&value);
        (x(&results.chain(alpha)), values.collect())
    });
    let curve = Curve::of_means(means).series(sampling.name(), index);
    curve.marked(Mark::Bars)
}

fn curves(results: &Results) -> Chart {
    let shown = results.shown().into_iter().enumerate();
    let series = shown.map(|(index, alpha)| {
        let gap = results.chain(alpha).spectral_gap();
        let name = format!("\u{3b1} = {alpha}, gap {gap:.2}");
        results.tv_curve(alpha).series(&name, index)
    });
    Chart::new(
        "Error on the way, stationary",
        Axis::log("updates"),
        Axis::log("total variation [probability]"),
        series.collect(),
    )
}
