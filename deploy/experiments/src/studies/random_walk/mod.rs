//! Fig. 1: InfoNCE on a biased random walk learns T / rho; does it converge as the spectral gap says?
//! Closed forms are in `chain`, learning in `training`, pictures in `figures`; here the grid and the page.

pub(crate) mod chain;
mod figures;
mod results;
mod settings;
mod training;

use serde_json::json;

use self::{
    chain::Chain,
    results::{Measure, Results, Trained},
    settings::Settings,
    training::{Sampling, train},
};
use crate::{
    cache::Session,
    flags::{self, ExperimentFlags, this_command},
    page::{Page, Table, Values, number},
    plot::Curve,
    stats::Spread,
};

const NAME: &str = "random-walk";

/// Runs the experiment.
pub(crate) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let mut settings: Settings = flags::settings(
        NAME,
        include_str!("config.toml"),
        include_str!("smoke.toml"),
        args,
    );
    settings.seeds = args.seeds.unwrap_or(settings.seeds);
    let pieces = settings.alphas.len() * Sampling::ALL.len() * settings.seeds as usize;
    let units = pieces as u64 * settings.updates;
    let mut session = Session::open(NAME, args, &settings, units)?;

    let mut trained = Vec::with_capacity(pieces);
    let grid = Sampling::ALL.into_iter().flat_map(|sampling| {
        let alphas = settings.alphas.iter();
        alphas.flat_map(move |&alpha| (1..=settings.seeds).map(move |seed| (sampling, alpha, seed)))
    });
    for (sampling, alpha, seed) in grid {
        let states = settings.states;
        let chain = Chain { states, alpha };
        let key = format!("{}-alpha{alpha}-seed{seed}", sampling.name());
        let learnt = session.piece(&key, settings.updates, |progress| {
            train(&chain, &settings, sampling, seed.into(), progress)
        })?;
        trained.push(Trained {
            chain,
            sampling,
            seed,
            learnt,
        });
    }
    let results = Results { settings, trained };
    write_data(&session, &results)?;
    session.figure("fig1", &figures::fig1(&results))?;
    session.figure("convergence", &figures::convergence(&results))?;
    session.finish(&page(&results, args.smoke))
}

/// A number of the data.
fn written(value: f64) -> String {
    format!("{value:.6}")
}

fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let k = results.settings.states;
    let laws = results.settings.alphas.iter().map(|&alpha| {
        let chain = results.chain(alpha);
        let t = chain.transitions();
        let numbers = [
            chain.mutual_information(),
            chain::mutual_information_numerically(&t, k),
            results.learnt_information(alpha).mean,
            chain.mutual_information_of_a_ring(),
            chain.mutual_information_as_printed(),
            chain.spectral_gap(),
            chain::spectral_gap_numerically(&t, k),
        ];
        let head = std::iter::once(alpha.to_string());
        head.chain(numbers.map(written)).collect()
    });
    let columns = "alpha,mi_nats,mi_numerical_nats,mi_learnt_nats,mi_ring_nats,mi_as_printed_nats,gap,gap_numerical";
    session.csv("alpha", &Table::of(columns, laws))?;

    let (truth, learnt) = (results.true_ratio(), results.learnt_ratio());
    let entries = truth.iter().zip(&learnt).enumerate();
    let entries = entries.map(|(at, (truth, learnt))| {
        let states = [at / k + 1, at % k + 1].map(|state| state.to_string());
        let numbers = [*truth, learnt.mean, learnt.sd].map(written);
        states.into_iter().chain(numbers).collect()
    });
    let columns = "state,next,true_ratio,learnt_mean,learnt_sd";
    session.csv("ratio", &Table::of(columns, entries))?;

    let times = results.trained.iter().map(|one| {
        let time = |measure| number(results.time(one, measure).map(|it| it as f64), 0);
        vec![
            one.sampling.name().to_owned(),
            one.chain.alpha.to_string(),
            one.seed.to_string(),
            written(one.chain.spectral_gap()),
            time(Measure::Tv),
            time(Measure::Share),
            written(one.final_tv()),
            written(one.final_excess()),
        ]
    });
    let columns =
        "sampling,alpha,seed,gap,updates_to_tv,updates_to_share,final_tv,final_excess_nats";
    session.csv("convergence", &Table::of(columns, times))?;

    let curves = results.shown().into_iter().flat_map(|alpha| {
        let Curve { points, band } = results.tv_curve(alpha);
        let rows = points.into_iter().zip(band);
        rows.map(move |((updates, mean), (_, min, max))| {
            let numbers = [mean, min, max].map(|it| format!("{it:.5}"));
            let head = [alpha.to_string(), updates.to_string()];
            head.into_iter().chain(numbers).collect()
        })
    });
    let columns = "alpha,updates,tv_mean,tv_min,tv_max";
    session.csv("curves", &Table::of(columns, curves))
}

fn page(results: &Results, smoke: bool) -> Page {
    let settings = &results.settings;
    let truth = results.true_ratio();
    let of_seed = |one: &Trained| {
        let pairs = one.learnt.ratio.iter().zip(&truth);
        Spread::of(pairs.map(|(learnt, truth)| (learnt - truth).abs()))
    };
    let at_figure = || results.of(Sampling::Stationary, settings.figure_alpha);
    let errors: Vec<Spread> = at_figure().filter_map(of_seed).collect();
    let holds = |measure| {
        let found = results.gap_correlations(Sampling::Stationary, measure);
        found.is_some_and(|spread| spread.mean > 0.5)
    };
    // What follows from the closed forms alone, at any length of the experiment.
    let states = settings.states;
    let closed_forms = [0.5, 0.9, 0.3].map(|alpha| {
        let chain = Chain { states, alpha };
        json!({
            "mi": chain.mutual_information(),
            "ring": chain.mutual_information_of_a_ring(),
            "printed": chain.mutual_information_as_printed(),
        })
    });
    let mut values = Values::default();
    values
        .set("settings", settings)
        .set("seeds", settings.seeds)
        .set(
            "mean_errors",
            errors.iter().map(|it| it.mean).collect::<Vec<_>>(),
        )
        .set(
            "largest_errors",
            errors.iter().map(|it| it.max).collect::<Vec<_>>(),
        )
        .set("largest_ratio", truth.iter().copied().fold(0.0, f64::max))
        .set(
            "final_tv",
            at_figure().map(Trained::final_tv).collect::<Vec<_>>(),
        )
        .set("convergence", convergence(results))
        .set("absolute", holds(Measure::Tv))
        .set("relative", holds(Measure::Share))
        .set("closed_forms", closed_forms)
        .set("most", (states as f64).ln());
    Page::new(include_str!("page.md"), values, &this_command(), smoke)
}

/// How long each sampling takes, by either measure.
fn convergence(results: &Results) -> Vec<String> {
    let settings = &results.settings;
    let alpha = settings.figure_alpha;
    let ends = [settings.alphas.first(), settings.alphas.last()];
    let [first, last] = ends.map(|end| end.copied().unwrap_or(alpha));
    let share = 100.0 * (1.0 - settings.share_reached);
    let measures = [
        (
            Measure::Tv,
            format!("the total variation is {}", settings.tv_reached),
        ),
        (
            Measure::Share,
            format!("{share:.0}% of the mutual information is learnt"),
        ),
    ];
    let all = measures
        .iter()
        .flat_map(|it| Sampling::ALL.map(|sampling| (it, sampling)));
    let line = |((measure, what), sampling): (&(Measure, String), Sampling)| {
        let time_at = |alpha: f64| {
            let times = results.of(sampling, alpha);
            let times = times.filter_map(|one| results.time(one, *measure));
            let mean = Spread::of(times.map(|time| time as f64));
            mean.map_or("never".to_owned(), |it| format!("{:.0}", it.mean))
        };
        let trained = results
            .trained
            .iter()
            .filter(|one| one.sampling == sampling);
        let late = trained.filter(|one| results.time(one, *measure).is_none());
        let late = match late.count() {
            0 => String::new(),
            late => format!(" ({late} trainings never got there)"),
        };
        let correlation = results.gap_correlations(sampling, *measure);
        format!(
            "Updates until {what}, `{}`: {} at alpha = {first}, {} at {alpha}, {} at {last}{late}. Rank correlation \
             over alpha with the inverse spectral gap: {}.",
            sampling.name(),
            time_at(first),
            time_at(alpha),
            time_at(last),
            correlation.map_or("none".to_owned(), |spread| format!("{spread:.2}")),
        )
    };
    all.map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_lengths_read_and_have_the_figure_s_alpha() {
        for text in [include_str!("config.toml"), include_str!("smoke.toml")] {
            let settings: Settings = toml::from_str(text).unwrap();
            assert!(settings.alphas.contains(&settings.figure_alpha));
            assert!(settings.alphas.iter().all(|a| 0.0 < *a && *a < 1.0));
            assert!(settings.states >= 2 && settings.seeds > 0 && settings.updates > 0);
        }
    }
}
