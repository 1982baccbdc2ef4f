//! The statistics of returns that evaluations and experiments share: mean, standard deviation and Student's interval.
//! Comparisons of several samples are in `driml-experiments`.

use std::fmt;

/// 0.975 quantiles of Student's t with 1, 2, .. degrees of freedom. Source: the tables of any textbook.
const STUDENT_T: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160,
    2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056,
    2.052, 2.048, 2.045, 2.042,
];

/// The 0.975 quantile of Student's t for this many degrees of freedom, at least 1. Beyond the table it is an expansion in
/// 1 / `freedom` (Fisher and Cornish 1960), within 0.001.
pub fn student_quantile(freedom: usize) -> f64 {
    let in_table = STUDENT_T.get(freedom.max(1) - 1).copied();
    let freedom = freedom as f64;
    in_table.unwrap_or_else(|| 1.960 + 2.372 / freedom + 2.822 / freedom.powi(2))
}

/// Mean and sample standard deviation (n - 1). A single value has no deviation; the mean of no values is NaN.
pub fn mean_and_deviation(values: &[f64]) -> (f64, Option<f64>) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (count > 1.0).then(|| (squares / (count - 1.0)).sqrt());
    (mean, deviation)
}

/// Describes the standard deviation after a mean; empty if there is none.
pub fn describe_deviation(deviation: Option<f64>) -> String {
    deviation.map_or(String::new(), |it| format!(", standard deviation {it:.3}"))
}

/// A mean and its 95% confidence interval, if the values are normally distributed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// The mean, in the unit of the values.
    pub mean: f64,
    /// The ends of the interval; none for a single value, which does not tell how far others would spread.
    pub ends: Option<(f64, f64)>,
}

/// Student's interval of the mean; none without values.
///
/// A bootstrap over as few values as there are seeds is too narrow: with three, its 95% interval contains the mean in 75% of cases.
pub fn interval(values: &[f64]) -> Option<Interval> {
    let freedom = values.len().checked_sub(1)?;
    let (mean, deviation) = mean_and_deviation(values);
    let half_width = |it| student_quantile(freedom) * it / (values.len() as f64).sqrt();
    let ends = deviation.map(half_width);
    let ends = ends.map(|it| (mean - it, mean + it));
    Some(Interval { mean, ends })
}

impl fmt::Display for Interval {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let decimals = f.precision().unwrap_or(2);
        let number = |it: f64| match f.sign_plus() {
            true => format!("{it:+.decimals$}"),
            false => format!("{it:.decimals$}"),
        };
        let mean = number(self.mean);
        match self.ends {
            None => write!(f, "{mean} (one seed)"),
            Some((low, high)) => write!(f, "{mean} [{}, {}]", number(low), number(high)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The quantiles are those in any textbook's table.
    #[test]
    fn the_interval_is_student_s_and_printed_with_its_mean() {
        for (freedom, quantile) in [(0, 12.706), (1, 12.706), (9, 2.262), (30, 2.042)] {
            assert_eq!(student_quantile(freedom), quantile);
        }
        for (freedom, quantile) in [(31, 2.0395), (40, 2.0211), (99, 1.9842), (1_000, 1.9623)] {
            let found = student_quantile(freedom);
            assert!((found - quantile).abs() < 1e-3, "{freedom}: {found}");
        }
        // By hand: mean 2, standard deviation 1, 4.303 / sqrt(3) = 2.484.
        let found = interval(&[1.0, 2.0, 3.0]).unwrap();
        let one = interval(&[3.0]).unwrap();
        assert_eq!((one.ends, interval(&[])), (None, None));
        let printed = format!("{one} {found:.1} {found:+.3}");
        let expected = "3.00 (one seed) 2.0 [-0.5, 4.5] +2.000 [-0.484, +4.484]";
        assert_eq!(printed, expected);
    }
}
