//! Tests whether counts follow a law: Pearson's chi-square test.

/// The probability that a correct sampler fails one of these tests. Seeds are fixed, so results do not change.
pub(crate) const SIGNIFICANCE: f64 = 1e-4;
/// The quantile of the standard normal for [`SIGNIFICANCE`], one-sided.
const Z: f64 = 3.719;

/// Pearson's statistic, summed over independent experiments.
#[derive(Default)]
pub(crate) struct ChiSquare {
    statistic: f64,
    degrees: f64,
}

impl ChiSquare {
    /// Adds one experiment: `counts` against `probabilities`, which sum to 1. Pools cells with expected counts below 5.
    pub(crate) fn add(&mut self, counts: &[u64], probabilities: &[f64]) {
        assert_eq!(counts.len(), probabilities.len());
        assert!(
            (probabilities.iter().sum::<f64>() - 1.0).abs() < 1e-5,
            "{probabilities:?}"
        );
        let total = counts.iter().sum::<u64>() as f64;
        let (mut pooled, mut cells) = ((0.0, 0.0), vec![]);
        for (&count, p) in counts.iter().zip(probabilities) {
            assert!(*p > 0.0 || count == 0, "{count} where the law has none");
            if total * p < 5.0 {
                pooled = (pooled.0 + count as f64, pooled.1 + total * p);
            } else {
                cells.push((count as f64, total * p));
            }
        }
        if pooled.1 >= 5.0 {
            cells.push(pooled);
        }
        let terms = cells
            .iter()
            .map(|(have, want)| (have - want).powi(2) / want);
        self.statistic += terms.sum::<f64>();
        self.degrees += cells.len().saturating_sub(1) as f64;
    }

    /// Panics if the counts do not follow the law, at [`SIGNIFICANCE`]. Quantile by Wilson and Hilferty.
    pub(crate) fn check(&self, what: &str) {
        let (x, d) = (self.statistic, self.degrees);
        assert!(d > 0.0, "{what}: nothing to compare");
        let limit = d * (1.0 - 2.0 / (9.0 * d) + Z * (2.0 / (9.0 * d)).sqrt()).powi(3);
        assert!(
            x < limit,
            "{what}: chi-square {x:.1} above {limit:.1} with {d} degrees, p < {SIGNIFICANCE}"
        );
    }
}

#[test]
fn a_wrong_law_is_found() {
    let mut chi = ChiSquare::default();
    chi.add(&[520, 480], &[0.5, 0.5]);
    chi.check("a fair coin");
    chi.add(&[600, 400], &[0.5, 0.5]);
    assert!(std::panic::catch_unwind(|| chi.check("a loaded coin")).is_err());
}
