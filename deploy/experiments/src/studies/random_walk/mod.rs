//! Fig. 1: InfoNCE on a biased random walk learns T / rho; does it converge as the spectral gap says?
//! Closed forms are in `chain`, learning in `training`, pictures in `figures`; here the grid and the page.

pub(crate) mod chain;
mod figures;
mod results;
mod settings;
mod training;

use self::{
    chain::Chain,
    results::{Measure, Results, Trained},
    settings::Settings,
    training::{Sampling, train},
};
use crate::{
    cache::Session,
    flags::{self, ExperimentFlags, this_command},
    page::{Page, Table, Values},
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
    for sampling in Sampling::ALL {
        for &alpha in &settings.alphas {
            let chain = Chain {
                states: settings.states,
                alpha,
            };
            for seed in 1..=settings.seeds {
                let key = format!("{}-alpha{alpha}-seed{seed}", sampling.name());
                let learnt = session.piece(&key, settings.updates, |progress| {
                    train(&chain, &settings, sampling, seed.into(), progress)
                })?;
                trained.push(Trained {
                    chain: chain.clone(),
                    sampling,
                    seed,
                    learnt,
                });
            }
        }
    }
    let results = Results { settings, trained };
    write_data(&session, &results)?;
    session.figure("fig1", &figures::fig1(&results))?;
    session.figure("convergence", &figures::convergence(&results))?;
    let command = this_command();
    session.finish(&page(&results, &command, args.smoke))
}

fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let k = results.settings.states;
    let number = |value: f64| format!("{value:.6}");
    let laws = results.settings.alphas.iter().map(|&alpha| {
        let chain = results.chain(alpha);
        let t = chain.transitions();
        let learnt = results.of(Sampling::Stationary, alpha);
        let learnt = Spread::of(learnt.map(|one| chain.mutual_information() - one.final_excess()));
        let learnt = learnt.map_or(String::new(), |spread| number(spread.mean));
        let mut row = vec![alpha.to_string()];
        row.extend([
            number(chain.mutual_information()),
            number(chain::mutual_information_numerically(&t, k)),
            learnt,
            number(chain.mutual_information_of_a_ring()),
            number(chain.mutual_information_as_printed()),
            number(chain.spectral_gap()),
            number(chain::spectral_gap_numerically(&t, k)),
        ]);
        row
    });
    session.csv(
        "alpha",
        &Table::new(
            &[
                "alpha",
                "mi_nats",
                "mi_numerical_nats",
                "mi_learnt_nats",
                "mi_ring_nats",
                "mi_as_printed_nats",
                "gap",
                "gap_numerical",
            ],
            laws,
        ),
    )?;

    let alpha = results.settings.figure_alpha;
    let chain = results.chain(alpha);
    let (t, rho) = (chain.transitions(), chain.stationary());
    let learnt: Vec<_> = results.of(Sampling::Stationary, alpha).collect();
    let entries = (0..k * k).map(|at| {
        let learnt = Spread::of(learnt.iter().map(|one| one.learnt.ratio[at]));
        let (mean, sd) = learnt.map_or((f64::NAN, f64::NAN), |spread| (spread.mean, spread.sd));
        let states = [at / k + 1, at % k + 1].map(|state| state.to_string());
        let numbers = [t[at] / rho[at % k], mean, sd].map(number);
        states.into_iter().chain(numbers).collect()
    });
    let header = ["state", "next", "true_ratio", "learnt_mean", "learnt_sd"];
    session.csv("ratio", &Table::new(&header, entries))?;

    let times = results.trained.iter().map(|one| {
        let time = |measure| {
            let time = results.time(one, measure);
            time.map_or(String::new(), |updates| updates.to_string())
        };
        vec![
            one.sampling.name().to_owned(),
            one.chain.alpha.to_string(),
            one.seed.to_string(),
            number(one.chain.spectral_gap()),
            time(Measure::Tv),
            time(Measure::Share),
            number(one.final_tv()),
            number(one.final_excess()),
        ]
    });
    let header = [
        "sampling",
        "alpha",
        "seed",
        "gap",
        "updates_to_tv",
        "updates_to_share",
        "final_tv",
        "final_excess_nats",
    ];
    session.csv("convergence", &Table::new(&header, times))?;

    let curves = figures::shown(results).into_iter().flat_map(|alpha| {
        let points = figures::tv_curve(results, alpha);
        points.into_iter().map(move |(updates, spread)| {
            let numbers = [spread.mean, spread.min, spread.max];
            let head = [alpha.to_string(), updates.to_string()];
            let numbers = numbers.map(|number| format!("{number:.5}"));
            head.into_iter().chain(numbers).collect()
        })
    });
    let header = ["alpha", "updates", "tv_mean", "tv_min", "tv_max"];
    session.csv("curves", &Table::new(&header, curves))
}

fn page(results: &Results, command: &str, smoke: bool) -> Page {
    let settings = &results.settings;
    let alpha = settings.figure_alpha;
    let chain = results.chain(alpha);
    let (t, rho) = (chain.transitions(), chain.stationary());
    let k = settings.states;
    let error = |one: &Trained| {
        let each = one.learnt.ratio.iter().enumerate();
        let each = each.map(|(at, ratio)| (ratio - t[at] / rho[at % k]).abs());
        (
            each.clone().sum::<f64>() / (k * k) as f64,
            each.fold(0.0, f64::max),
        )
    };
    let largest = (0..k * k).map(|at| t[at] / rho[at % k]).fold(0.0, f64::max);
    let spread = |values: &dyn Fn(&Trained) -> f64| {
        let at_figure = results.of(Sampling::Stationary, alpha);
        Spread::of(at_figure.map(values)).map_or("none".to_owned(), |spread| spread.to_string())
    };
    let mut values = Values::default();
    values
        .set("alpha", alpha)
        .set("mean_error", spread(&|one| error(one).0))
        .set("largest_error", spread(&|one| error(one).1))
        .set("largest_ratio", format!("{largest:.2}"))
        .set("final_tv", spread(&|one| one.final_tv()))
        .items("convergence", convergence(results));
    let holds = |measure| {
        let found = results.gap_correlations(Sampling::Stationary, measure);
        found.is_some_and(|spread| spread.mean > 0.5)
    };
    let (absolute, relative) = (holds(Measure::Tv), holds(Measure::Share));
    values
        .when("holds", absolute && relative)
        .when("holds_in_absolute_error_only", absolute && !relative)
        .when("fails", !absolute);
    closed_forms(k, &mut values);
    values
        .set("rkhs", settings.rkhs)
        .set("batch_size", settings.batch_size)
        .set("lr", settings.adam.lr)
        .set("updates", settings.updates)
        .set("seeds", settings.seeds);
    Page::new(include_str!("page.md"), values, command, smoke)
}

/// How long each sampling takes, by either measure.
fn convergence(results: &Results) -> Vec<String> {
    let settings = &results.settings;
    let alpha = settings.figure_alpha;
    let time_at = |alpha: f64, sampling: Sampling, measure: Measure| {
        let times = results.of(sampling, alpha);
        let times = times.filter_map(|one| results.time(one, measure));
        Spread::of(times.map(|time| time as f64))
            .map_or("never".to_owned(), |spread| format!("{:.0}", spread.mean))
    };
    let ends = [settings.alphas.first(), settings.alphas.last()];
    let [first, last] = ends.map(|end| end.copied().unwrap_or(alpha));
    let mut lines = Vec::new();
    for (measure, what) in [
        (
            Measure::Tv,
            format!("the total variation is {}", settings.tv_reached),
        ),
        (
            Measure::Share,
            format!(
                "{:.0}% of the mutual information is learnt",
                100.0 * (1.0 - settings.share_reached)
            ),
        ),
    ] {
        for sampling in Sampling::ALL {
            let late = results
                .trained
                .iter()
                .filter(|one| one.sampling == sampling && results.time(one, measure).is_none());
            let late = match late.count() {
                0 => String::new(),
                late => format!(" ({late} trainings never got there)"),
            };
            lines.push(format!(
                "Updates until {what}, `{}`: {} at alpha = {first}, {} at {alpha}, {} at {last}{late}. Rank correlation \
                 over alpha with the inverse spectral gap: {}.",
                sampling.name(),
                time_at(first, sampling, measure),
                time_at(alpha, sampling, measure),
                time_at(last, sampling, measure),
                results
                    .gap_correlations(sampling, measure)
                    .map_or("none".to_owned(), |spread| format!("{spread:.2}")),
            ));
        }
    }
    lines
}

/// What follows from the closed forms alone, at any length of the experiment.
fn closed_forms(states: usize, values: &mut Values) {
    let at = |alpha: f64| Chain { states, alpha };
    let (even, biased) = (at(0.5), at(0.9));
    let nats = |value: f64| format!("{value:.3}");
    let printed = |alpha: f64| format!("{:.1}", at(alpha).mutual_information_as_printed());
    values
        .set("mi_even", nats(even.mutual_information()))
        .set("mi_biased", nats(biased.mutual_information()))
        .set("ring_even", nats(even.mutual_information_of_a_ring()))
        .set("ring_biased", nats(biased.mutual_information_of_a_ring()))
        .set("printed_even", printed(0.5))
        .set("printed_at_03", printed(0.3))
        .set("most", format!("{:.2}", (states as f64).ln()))
        .set("states", states);
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
