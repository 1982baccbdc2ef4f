//! Scores over games and seeds as the field reports them: interquartile mean and probability of improvement. Source: Agarwal et al.
//! 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice". Their bootstrap intervals need more seeds than runs of
//! days allow, so these are Student's. Nothing is normalised.

use crate::stats::{Interval, auc, interval};

/// Scores by game and seed: `scores[game][seed]`. Results are `None` without games, or if a game has no score.
pub(crate) type Scores = Vec<Vec<f64>>;

/// Returns the interquartile mean (the mean of the middle half of all scores) and its interval.
pub(crate) fn iqm(scores: &Scores) -> Option<Interval> {
    jackknife(&[scores], |it| interquartile_mean(it[0].iter().flatten()))
}

/// Returns the probability that a run of `x` scores higher than a run of `y` in a game drawn at random, and its interval.
///
/// `1/M sum_m 1/(N_x N_y) sum_ij [x_mi > y_mj] + [x_mi = y_mj] / 2` over the M games, which `x` and `y` share.
pub(crate) fn improvement_chance(x: &Scores, y: &Scores) -> Option<Interval> {
    assert_eq!(x.len(), y.len(), "the same games");
    let found = jackknife(&[x, y], |it| {
        let games = it[0].iter().zip(&it[1]);
        games.filter_map(|(x, y)| auc(x, y)).sum::<f64>() / it[0].len() as f64
    })?;
    let ends = found.ends.map(|(low, high)| (low.max(0.0), high.min(1.0)));
    Some(Interval { ends, ..found })
}

/// Returns the mean without the lowest and the highest quarter, each rounded down to whole scores.
fn interquartile_mean<'a>(scores: impl Iterator<Item = &'a f64>) -> f64 {
    let mut all: Vec<f64> = scores.copied().collect();
    all.sort_by(f64::total_cmp);
    let cut = all.len() / 4;
    let middle = &all[cut..all.len() - cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Returns `statistic(groups)` and its interval over seeds by the jackknife: Student's interval of pseudo-values `p_i = n v - (n - 1) v_i`.
/// `v` uses all scores, `v_i` those without seed i of each game; n is the smallest number of seeds in a game, and a game with more leaves
/// out seeds i, i + n, .. together. A game with one seed leaves no ends. For a mean over games of n seeds each this is Student's interval
/// itself. Sources: Tukey 1958; for groups of seeds Kott 2001.
fn jackknife(groups: &[&Scores], statistic: impl Fn(&[Scores]) -> f64) -> Option<Interval> {
    let all: Vec<Scores> = groups.iter().map(|&scores| scores.clone()).collect();
    let seeds = all.iter().flatten().map(Vec::len).min();
    let seeds = seeds.filter(|seeds| *seeds > 0)?;
    let mean = statistic(&all);
    let pseudo_value = |seed: usize| {
        let mut others = all.clone();
        others.iter_mut().flatten().for_each(|scores| {
            let mut index = 0..;
            scores.retain(|_| index.next().is_some_and(|it: usize| it % seeds != seed));
        });
        seeds as f64 * mean - (seeds - 1) as f64 * statistic(&others)
    };
    let found = interval(&(0..seeds).map(pseudo_value).collect::<Vec<_>>())?;
    let shifted = |end: f64| mean + end - found.mean;
    let ends = found.ends.map(|(low, high)| (shifted(low), shifted(high)));
    Some(Interval { mean, ends })
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

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
        let found = improvement_chance(&x, &y).unwrap();
        assert_eq!(found.mean, (1.5 / 4.0 + 1.0) / 2.0);
        let other = improvement_chance(&y, &x).unwrap();
        assert!((found.mean + other.mean - 1.0).abs() < 1e-12);
        assert_eq!(found.ends, None, "of one game there is one seed");
        let one_each = iqm(&vec![vec![0.1], vec![0.3]]).unwrap();
        assert_eq!((one_each.mean, one_each.ends), (0.2, None));
        assert_eq!(improvement_chance(&vec![], &vec![]), None);
        // In one game no run has finished an episode.
        assert_eq!(improvement_chance(&vec![vec![], vec![1.0]], &y), None);
    }

    #[test]
    fn the_interval_has_the_truth_about_as_often_as_it_says() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let rounds = 1_000;
        // The last has more seeds in some games.
        for seeds in [[3; 4], [4; 4], [12; 4], [3, 12, 3, 12]] {
            let (mut of_iqm, mut of_improvement) = (0, 0);
            for _ in 0..rounds {
                // Uniform scores around 0.5 in four games: both agents are equally good.
                let mut scores = || -> Scores {
                    let game = |count: usize| (0..count).map(|_| rng.random::<f64>()).collect();
                    seeds.into_iter().map(game).collect()
                };
                let (x, y) = (scores(), scores());
                let has = |found: Option<Interval>| {
                    let (low, high) = found.unwrap().ends.unwrap();
                    u32::from((low..=high).contains(&0.5))
                };
                of_iqm += has(iqm(&x));
                of_improvement += has(improvement_chance(&x, &y));
            }
            for count in [of_iqm, of_improvement] {
                let share = f64::from(count) / f64::from(rounds);
                assert!((0.92..0.98).contains(&share), "{seeds:?} seeds: {share}");
            }
        }
    }

    #[test]
    fn of_one_game_without_a_cut_the_interval_is_students() {
        let values = vec![1.0, 2.0, 4.0];
        let (found, expected) = (iqm(&vec![values.clone()]), interval(&values));
        let numbers = |it: Option<Interval>| {
            let it = it.unwrap();
            [it.mean, it.ends.unwrap().0, it.ends.unwrap().1]
        };
        let pairs = numbers(found).into_iter().zip(numbers(expected));
        pairs.for_each(|(found, expected)| assert!((found - expected).abs() < 1e-12));
    }
}
