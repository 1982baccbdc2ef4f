//! Fig. 1: InfoNCE on a biased random walk learns T / rho. Does it converge as fast as the spectral gap predicts?
//! `chain` has the closed forms, `training` learns, `figures` draws; this module has the grid of trainings and the page.

mod chain;
mod figures;
mod results;
mod training;

use driml_launch::metrics::rounded;
use minijinja::{Value, context};

use self::{
    chain::Chain,
    results::{Results, TO_SHARE, TO_TV, Trained, UpdatesTo},
    training::{Sampling, Settings, train},
};
use crate::{
    cache::Session,
    flags::{self, ExperimentFlags},
    plot::Curve,
    stats::{Spread, mean},
};

const NAME: &str = "random-walk";
const SETTINGS: &str = include_str!("config.toml");

pub(crate) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let settings: Settings = flags::read_settings(NAME, SETTINGS, args);
    let pieces = settings.alphas.len() * Sampling::ALL.len() * settings.seeds as usize;
    let units = pieces as u64 * settings.updates;
    let mut session = Session::open(NAME, args, &settings, units, false)?;

    let mut trained = Vec::with_capacity(pieces);
    let grid = Sampling::ALL.into_iter().flat_map(|sampling| {
        let alphas = settings.alphas.iter();
        alphas.flat_map(move |&alpha| (1..=settings.seeds).map(move |seed| (sampling, alpha, seed)))
    });
    for (sampling, alpha, seed) in grid {
        let chain = Chain::new(settings.states, alpha);
        let key = format!("{}-alpha{alpha}-seed{seed}", sampling.name());
        let learnt = session.load_or_make("", &key, settings.updates, |progress| {
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
    session.save_figure("fig1", &figures::fig1(&results))?;
    session.save_figure("convergence", &figures::convergence_figure(&results))?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flags::tests::length;

    #[test]
    fn both_lengths_read_and_have_the_figure_s_alpha() {
        for smoke in [false, true] {
            let settings: Settings = flags::read_settings(NAME, SETTINGS, &length(smoke));
            assert!(settings.alphas.contains(&settings.figure_alpha));
            assert!(settings.alphas.iter().all(|a| 0.0 < *a && *a < 1.0));
            assert!(settings.states >= 2 && settings.seeds > 0 && settings.updates > 0);
        }
    }
}
