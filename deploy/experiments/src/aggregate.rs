//! Scores over games and seeds as the field reports them: interquartile mean and probability of improvement, each with a
//! stratified bootstrap interval. Source: Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the
//! Statistical Precipice". It normalises nothing. Besides, the score by which the paper sums up its table 1.

use std::fmt;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2_000;
/// Share of the resamples in an interval.
const COVERED: f64 = 0.95;

/// Scores by game and seed: `scores[game][seed]`, each game with at least one seed.
pub(super) type Scores = Vec<Vec<f64>>;

/// A number and the interval in which it lies with 95% confidence, over the choice of seeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Estimate {
    pub(super) value: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl fmt::Display for Estimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} [{:.3}, {:.3}]", self.value, self.low, self.high)
    }
}

/// Mean of the middle half of all scores, and its interval; none of no score.
pub(super) fn iqm(scores: &Scores) -> Option<Estimate> {
    estimate(&[scores], |it| interquartile_mean(it[0].iter().flatten()))
}

/// Probability that a run of `x` does better than one of `y` in a game drawn at random, and its interval; none of no game.
///
/// `1/M sum_m 1/(N_x N_y) sum_ij [x_mi > y_mj] + [x_mi = y_mj] / 2` over the M games; both have the same games.
pub(super) fn improvement(x: &Scores, y: &Scores) -> Option<Estimate> {
    assert_eq!(x.len(), y.len(), "the same games");
    estimate(&[x, y], |it| {
        let games = it[0].iter().zip(&it[1]);
        games.map(|(x, y)| better(x, y)).sum::<f64>() / it[0].len() as f64
    })
}

/// Mean over games of each agent's place between the game's worst agent, 0, and its best, 1, divided by the place of the
/// agent `baseline`: `games[game][agent]`, the same agents in each game. None if no agents differ in any game, or if the
/// baseline is the worst in all.
///
/// The paper does not define its "Norm.score"; this formula gives the last row of table 1 from its other rows. It depends on
/// which agents are compared.
pub(super) fn norm_scores(games: &[Vec<f64>], baseline: usize) -> Option<Vec<f64>> {
    let agents = games.first()?.len();
    let mut places = vec![0.0; agents];
    for scores in games {
        let worst = scores.iter().copied().fold(f64::INFINITY, f64::min);
        let best = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if best > worst {
            for (place, score) in places.iter_mut().zip(scores) {
                *place += (score - worst) / (best - worst);
            }
        }
    }
    let unit = places[baseline];
    (unit > 0.0).then(|| places.iter().map(|place| place / unit).collect())
}

/// Mean without the lowest and the highest quarter, each rounded down to whole scores.
fn interquartile_mean<'a>(scores: impl Iterator<Item = &'a f64>) -> f64 {
    let mut all: Vec<f64> = scores.copied().collect();
    all.sort_by(f64::total_cmp);
    let cut = all.len() / 4;
    let middle = &all[cut..all.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Share of the pairs in which x is larger; equal ones count half.
fn better(x: &[f64], y: &[f64]) -> f64 {
    let pairs = x.iter().flat_map(|x| y.iter().map(move |y| (x, y)));
    let wins = pairs.map(|(x, y)| match x.total_cmp(y) {
        std::cmp::Ordering::Greater => 1.0,
        std::cmp::Ordering::Equal => 0.5,
        std::cmp::Ordering::Less => 0.0,
    });
    wins.sum::<f64>() / (x.len() * y.len()) as f64
}

/// `of` the groups, and the percentiles of `of` their resamples: seeds drawn with replacement within each game.
fn estimate(groups: &[&Scores], of: impl Fn(&[Scores]) -> f64) -> Option<Estimate> {
    if groups.iter().any(|scores| scores.is_empty()) {
        return None;
    }
    let whole: Vec<Scores> = groups.iter().map(|&scores| scores.clone()).collect();
    let value = of(&whole);
    // One fixed seed: the same runs give the same page.
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut drawn = whole.clone();
    let mut values: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            for (to, from) in drawn.iter_mut().flatten().zip(whole.iter().flatten()) {
                to.iter_mut()
                    .for_each(|score| *score = from[rng.random_range(0..from.len())]);
            }
            of(&drawn)
        })
        .collect();
    values.sort_by(f64::total_cmp);
    let outside = (1.0 - COVERED) / 2.0;
    let at = |share: f64| values[(share * (RESAMPLES - 1) as f64).round() as usize];
    Some(Estimate {
        value,
        low: at(outside),
        high: at(1.0 - outside),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interquartile_mean_leaves_out_both_ends() {
        // As in scipy.stats.trim_mean(_, 0.25): of ten values two are dropped at each end.
        let scores: Vec<f64> = (0..10).map(|i| f64::from(i * i)).collect();
        let expected = (4.0 + 9.0 + 16.0 + 25.0 + 36.0 + 49.0) / 6.0;
        assert_eq!(interquartile_mean(scores.iter()), expected);
        assert_eq!(interquartile_mean([7.0].iter()), 7.0);
    }

    #[test]
    fn the_probability_of_improvement_counts_pairs_by_game() {
        let x = vec![vec![1.0, 3.0], vec![5.0]];
        let y = vec![vec![2.0, 3.0], vec![4.0]];
        // First game: 1 < 2, 1 < 3, 3 > 2, 3 = 3: 1.5 of 4. Second: 1.
        let found = improvement(&x, &y).unwrap();
        assert_eq!(found.value, (1.5 / 4.0 + 1.0) / 2.0);
        let other = improvement(&y, &x).unwrap();
        assert!((found.value + other.value - 1.0).abs() < 1e-12);
        assert!(found.low <= found.value && found.value <= found.high);
        assert_eq!(improvement(&vec![], &vec![]), None);
    }

    #[test]
    fn the_interval_covers_the_truth_about_as_often_as_it_says() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut covered, rounds) = (0, 200);
        for _ in 0..rounds {
            // Uniform scores around 0.5 in four games, twelve seeds each.
            let scores: Scores = (0..4)
                .map(|_| (0..12).map(|_| rng.random::<f64>()).collect())
                .collect();
            let found = iqm(&scores).unwrap();
            covered += usize::from((found.low..=found.high).contains(&0.5));
        }
        // 95% of 200 is 190; the bootstrap of a dozen seeds is a little narrow.
        assert!((170..=200).contains(&covered), "{covered} of {rounds}");
    }

    #[test]
    fn the_norm_score_is_relative_to_worst_best_and_baseline() {
        // Places: 1/2, 0, 1 and 1/2, 1, 0; the third game, where all are equal, says nothing.
        let games = [vec![2.0, 1.0, 3.0], vec![0.0, 5.0, -5.0], vec![4.0; 3]];
        assert_eq!(norm_scores(&games, 0), Some(vec![1.0, 1.0, 1.0]));
        assert_eq!(norm_scores(&games[..1], 0), Some(vec![1.0, 0.0, 2.0]));
        assert_eq!(norm_scores(&games[..1], 1), None);
        assert_eq!(norm_scores(&games[2..], 0), None);
        assert_eq!(norm_scores(&[], 0), None);
    }

    #[test]
    fn one_seed_each_has_no_spread() {
        let found = iqm(&vec![vec![0.1], vec![0.3]]).unwrap();
        assert_eq!((found.low, found.high), (found.value, found.value));
    }
}
