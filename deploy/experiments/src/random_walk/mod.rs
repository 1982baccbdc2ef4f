//! Fig. 1: InfoNCE on a biased random walk learns T / rho; does it converge as the spectral gap says?
//! Closed forms are in `chain`, learning in `training`, pictures in `figures`; here the grid and the page.

mod chain;
mod figures;
mod training;

use driml_learner::AdamSettings;
use serde::{Deserialize, Serialize};

use self::{
    chain::Chain,
    training::{Learnt, Sampling, train},
};
use super::{
    Page, Session, command_line, settings,
    statistics::{Spread, rank_correlation},
};
use crate::flags::ExperimentFlags;

const NAME: &str = "random-walk";

/// `deploy/experiments/src/random_walk/*.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    /// States of the chain.
    states: usize,
    /// Probabilities of a step up.
    alphas: Vec<f64>,
    /// The one of the matrices; among `alphas`.
    figure_alpha: f64,
    /// Seeds 1 to this. No piece depends on it, so that more can be added later.
    #[serde(skip_serializing)]
    seeds: u32,
    /// Updates of a training.
    updates: u64,
    /// Pairs in a batch, each with all others as negatives.
    batch_rows: usize,
    /// Width of the heads.
    rkhs: usize,
    /// Rows sampled per transition of a single walker.
    replay_ratio: f64,
    /// Bound of the scores' soft clip.
    tanh_clip: f64,
    /// Global 2-norm to which gradients are clipped.
    max_grad_norm: f64,
    /// Error of the next state's law at which a training counts as converged, a probability.
    #[serde(skip_serializing)]
    tv_reached: f64,
    /// Share of the mutual information that is still missed when a training counts as converged.
    #[serde(skip_serializing)]
    share_reached: f64,
    /// The optimiser's numbers.
    adam: AdamSettings,
}

/// One piece of the grid.
struct Trained {
    chain: Chain,
    sampling: Sampling,
    seed: u32,
    learnt: Learnt,
}

impl Trained {
    fn final_tv(&self) -> f64 {
        self.learnt.tv.last().copied().unwrap_or(f64::NAN)
    }

    fn final_excess(&self) -> f64 {
        self.learnt.excess.last().copied().unwrap_or(f64::NAN)
    }
}

/// All trainings, and what was asked for.
struct Results {
    settings: Settings,
    trained: Vec<Trained>,
}

impl Results {
    /// Those of one sampling and bias, over seeds.
    fn of(&self, sampling: Sampling, alpha: f64) -> impl Iterator<Item = &Trained> {
        let all = self.trained.iter();
        all.filter(move |one| one.sampling == sampling && one.chain.alpha == alpha)
    }

    fn chain(&self, alpha: f64) -> Chain {
        Chain {
            states: self.settings.states,
            alpha,
        }
    }

    /// Updates until a training's error is small; none where it never was.
    fn time(&self, one: &Trained, measure: Measure) -> Option<u64> {
        let learnt = &one.learnt;
        match measure {
            Measure::Tv => learnt.updates_to(&learnt.tv, self.settings.tv_reached),
            Measure::Share => {
                let all = one.chain.mutual_information();
                learnt.updates_to(&learnt.excess, self.settings.share_reached * all)
            }
        }
    }

    /// Of each seed, the rank correlation over alpha between 1 / gap and the updates until the error is small.
    ///
    /// A training that never got there counts as one update more than the longest.
    fn gap_correlations(&self, sampling: Sampling, measure: Measure) -> Option<Spread> {
        let of_seed = |seed: u32| {
            let one = self.trained.iter();
            let pairs: Vec<(f64, f64)> = one
                .filter(|one| one.sampling == sampling && one.seed == seed)
                .map(|one| {
                    let time = self.time(one, measure);
                    let time = time.unwrap_or(self.settings.updates + 1);
                    (1.0 / one.chain.spectral_gap(), time as f64)
                })
                .collect();
            rank_correlation(&pairs)
        };
        Spread::of((1..=self.settings.seeds).filter_map(of_seed))
    }
}

/// When a training counts as converged.
#[derive(Clone, Copy, PartialEq)]
enum Measure {
    /// The law of the next state is near the true one, however near a blind guess is.
    Tv,
    /// Most of what there is to learn is learnt, however little that is.
    Share,
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
    let pieces = settings.alphas.len() * Sampling::ALL.len() * settings.seeds as usize;
    let units = pieces as u64 * settings.updates;
    let mut session = Session::open(NAME, flags, &settings, units)?;

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
    let command = command_line(NAME, flags, session.folder());
    session.finish(&page(&results, command, flags.smoke))
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
    session.csv("ratio", &header, entries)?;

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
    session.csv("convergence", &header, times)?;

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
    session.csv("curves", &header, curves)
}

fn page(results: &Results, command: String, smoke: bool) -> Page {
    let settings = &results.settings;
    let alpha = settings.figure_alpha;
    let chain = results.chain(alpha);
    let (t, rho) = (chain.transitions(), chain.stationary());
    let k = settings.states;
    let at_figure = || results.of(Sampling::Stationary, alpha);
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
        Spread::of(at_figure().map(values)).map_or("none".to_owned(), |spread| spread.to_string())
    };
    let mut got = vec![
        format!(
            "Learnt against true ratio at alpha = {alpha} (b against a): mean absolute error {}, largest {}; the true \
             entries are 0 to {largest:.2}.",
            spread(&|one| error(one).0),
            spread(&|one| error(one).1),
        ),
        format!(
            "The law of the next state that follows from it is off by {} in total variation.",
            spread(&|one| one.final_tv())
        ),
    ];
    let time_at = |alpha: f64, sampling: Sampling, measure: Measure| {
        let times = results.of(sampling, alpha);
        let times = times.filter_map(|one| results.time(one, measure));
        Spread::of(times.map(|time| time as f64))
            .map_or("never".to_owned(), |spread| format!("{:.0}", spread.mean))
    };
    let ends = [settings.alphas.first(), settings.alphas.last()];
    let [first, last] = ends.map(|end| end.copied().unwrap_or(alpha));
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
            got.push(format!(
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
    got.push(verdict(results));
    Page {
        title: "The transition ratio of a biased random walk (Fig. 1)".into(),
        claim: "InfoNCE on successive states of a biased random walk learns the matrix T / rho; and it converges the \
                faster the larger the spectral gap of T is, which is smallest near alpha = 0.5, where the walk is \
                least predictable."
            .into(),
        command,
        expected: vec![
            "The learnt matrix looks like the true one: a band of two diagonals.".into(),
            "Closed form and linear algebra agree for the mutual information and the gap (a test holds them to 1e-9)."
                .into(),
            "If the claim holds: a rank correlation near 1 between the inverse gap and the updates needed, also where \
             the error is taken in proportion to what there is to learn."
                .into(),
        ],
        got,
        tables: Vec::new(),
        differences: differences(&chain),
        setup: vec![
            format!(
                "{k} states; Psi_4 and Phi_4 of the project's network on one-hot states (residual blocks, width {}); \
                 InfoNCE over {} pairs, Adam at {}, {} updates; {} seeds.",
                settings.rkhs, settings.batch_rows, settings.adam.lr, settings.updates, settings.seeds
            ),
            "`stationary`: independent pairs, the first state from rho. `from-one-end`: as many walkers as rows, all \
             started in state 1, update t on their t-th step, as in the paper's proposition. `one-walker`: a single \
             walker fills a replay from which batches are drawn, as in a run."
                .into(),
            "Errors are measured from the scores of all pairs of states, so they have no sampling noise: the total \
             variation between true and learnt law of the next state, and the loss above its minimum with ever so many \
             negatives, both in the mean over rho."
                .into(),
        ],
        figures: vec![
            (
                "fig1".into(),
                "The paper's four panels: true and learnt ratio, mutual information and inverse spectral gap".into(),
            ),
            (
                "convergence".into(),
                "How fast the ratio is learnt, against the spectral gap".into(),
            ),
        ],
        data: vec![
            ("alpha".into(), "panels c and d".into()),
            ("ratio".into(), "panels a and b".into()),
            ("convergence".into(), "one row a training".into()),
            ("curves".into(), "errors on the way, stationary".into()),
        ],
        smoke,
    }
}

/// What the correlations say of the claim.
fn verdict(results: &Results) -> String {
    let of = |measure| {
        let found = results.gap_correlations(Sampling::Stationary, measure);
        found.map_or(0.0, |spread| spread.mean)
    };
    let (absolute, relative) = (of(Measure::Tv), of(Measure::Share));
    match (absolute > 0.5, relative > 0.5) {
        (true, true) => "So the claim holds here: the smaller the gap, the slower, by either measure.".into(),
        (true, false) => "So the claim holds in absolute error only, and for another reason than mixing: with a small gap \
                          there is more to learn, and pairs drawn independently, which have nothing to mix, show the same. \
                          In proportion to what there is to learn, a small gap does not make it slower."
            .into(),
        (false, _) => "So the claim does not hold here: a smaller gap does not make it slower.".into(),
    }
}

/// What follows from the closed forms alone, at any length of the experiment.
fn differences(chain: &Chain) -> Vec<String> {
    let at = |alpha: f64| Chain {
        states: chain.states,
        alpha,
    };
    let (even, biased) = (at(0.5), at(0.9));
    vec![
        format!(
            "The paper's Fig. 1c has the mutual information lowest near alpha = 0.5. For the chain it describes it is \
             *highest* there: I = H(rho) - h(alpha) is {:.3} nats at 0.5 and {:.3} at 0.9, as a strong bias keeps the \
             walk in a corner, where there is little left to tell. Lowest at 0.5 is the same walk without ends (a ring: ln K - \
             h(alpha), {:.3} and {:.3} nats). The appendix's double sum, taken as printed, dips at 0.5 as well ({:.1}, {:.1} \
             at 0.3), but is far above the {:.2} nats that {} states can hold, so it is no mutual information.",
            even.mutual_information(),
            biased.mutual_information(),
            even.mutual_information_of_a_ring(),
            biased.mutual_information_of_a_ring(),
            even.mutual_information_as_printed(),
            at(0.3).mutual_information_as_printed(),
            (chain.states as f64).ln(),
            chain.states,
        ),
        "So near alpha = 0.5 the gap is smallest *and* there is most to learn. Slower learning there is no evidence for \
         mixing as its cause: `stationary` has nothing to mix and is the control."
            .into(),
        "The paper takes alpha = 0.499 as T were not invertible at 0.5. T's eigenvalues are 1 and 2 sqrt(alpha (1 - \
         alpha)) cos(pi j / K): with an even number of states T is singular for every alpha, with an odd number for \
         none. What fails at 0.5 is the formula for rho, 0 / 0. InfoNCE needs neither."
            .into(),
        "The heads are the project's own, residual blocks whose dot product is the score; the paper's have a hidden \
         layer for the score as well. The number of states is not in the paper."
            .into(),
    ]
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
