//! Mean, standard deviation and Student's interval: the statistics of returns that evaluations and experiments share.
//! What compares several samples is in `driml-experiments`.

/// 0.975 quantiles of Student's t with 1, 2, .. degrees of freedom. Source: the tables of any textbook.
const T: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160,
    2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056,
    2.052, 2.048, 2.045, 2.042,
];

/// The 0.975 quantile of Student's t for this many degrees of freedom, at least 1. Beyond the table it is expanded in 1 / `freedom`
/// (Fisher and Cornish 1960), within 0.001.
pub fn student_quantile(freedom: usize) -> f64 {
    let in_table = T.get(freedom.max(1) - 1);
    let freedom = freedom as f64;
    in_table
        .copied()
        .unwrap_or_else(|| 1.960 + 2.372 / freedom + 2.822 / freedom.powi(2))
}

/// Mean and sample standard deviation (n - 1); the deviation of a single value is 0, the mean of no value NaN.
pub fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = match values.len() {
        0 | 1 => 0.0,
        _ => (squares / (count - 1.0)).sqrt(),
    };
    (mean, deviation)
}

/// The ends of the interval in which the mean lies with 95% confidence if values are normal: Student's. None of fewer than two values,
/// which do not tell how far others would spread.
pub fn interval(values: &[f64]) -> Option<(f64, f64)> {
    let (mean, deviation) = mean_and_deviation(values);
    let freedom = values.len().checked_sub(1).filter(|&it| it > 0)?;
    let by = student_quantile(freedom) * deviation / (values.len() as f64).sqrt();
    Some((mean - by, mean + by))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The quantiles are those of any textbook's table.
    #[test]
    fn the_interval_is_student_s() {
        for (freedom, quantile) in [(0, 12.706), (1, 12.706), (9, 2.262), (30, 2.042)] {
            assert_eq!(student_quantile(freedom), quantile);
        }
        for (freedom, quantile) in [(31, 2.0395), (40, 2.0211), (99, 1.9842), (1_000, 1.9623)] {
            let found = student_quantile(freedom);
            assert!((found - quantile).abs() < 1e-3, "{freedom}: {found}");
        }
        // By hand: mean 2, standard deviation 1, 4.303 / sqrt(3) = 2.484.
        let (low, high) = interval(&[1.0, 2.0, 3.0]).unwrap();
        assert!((low + 0.484).abs() < 1e-3 && (high - 4.484).abs() < 1e-3);
        assert_eq!([interval(&[]), interval(&[4.0])], [None; 2]);
    }

    #[test]
    fn the_deviation_is_the_samples() {
        assert_eq!(mean_and_deviation(&[1.0, 3.0]), (2.0, 2.0_f64.sqrt()));
        assert_eq!(mean_and_deviation(&[4.0]), (4.0, 0.0));
    }
}
