//! Expected returns of logits over the atoms, and the actions that are chosen by them.

use candle_core::{Device, Tensor};
use driml_model::{EXPECTED_RETURN_ERROR, Network, Parameters};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, finites, shown, support, widened},
    routines::policy,
    small,
};

const VALUES: Routine = Routine {
    name: "Q-value",
    range: "the expected return; logits finite, or some of them -inf; a support within 1e30",
};

/// Rows of as many logits.
struct Case {
    support: (f32, f32),
    rows: Vec<Vec<f32>>,
}

fn see(row: &mut Row, case: &Case) -> anyhow::Result<()> {
    let atoms = case.rows[0].len();
    let config = small::config(atoms, 1, case.support);
    let rng = &mut ChaCha8Rng::seed_from_u64(0);
    let network = Network::new(&config, &Parameters::init(&config, rng, &Device::Cpu)?)?;
    let logits = Tensor::from_vec(
        case.rows.concat(),
        (case.rows.len(), 1, atoms),
        &Device::Cpu,
    )?;
    let found = network.q_values(&logits)?.flatten_all()?.to_vec1::<f32>()?;
    let (low, high) = (f64::from(case.support.0), f64::from(case.support.1));
    for (found, logits) in found.iter().zip(&case.rows) {
        let x = widened(logits);
        let max = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = x.iter().map(|x| (x - max).exp()).collect();
        let total = exact_sum(weights.iter().copied());
        let place = |i: usize| i as f64 / (atoms - 1) as f64;
        let share = exact_sum(
            weights
                .iter()
                .enumerate()
                .map(|(i, w)| w / total * place(i)),
        );
        let expected = low + share * (high - low);
        let own = expected.abs().max(f32::MIN_POSITIVE.into()) / 2f64.powi(24);
        let error = (f64::from(*found) - expected).abs() - own;
        let error = if (case.support.0..=case.support.1).contains(found) {
            error.max(0.0) / (high - low)
        } else {
            f64::MAX
        };
        row.see(error, || {
            format!("support [{low:e}, {high:e}], logits {}", shown(logits))
        });
    }
    Ok(())
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let row = |extreme: &str| {
        Row::new(
            VALUES,
            extreme,
            "error beside the value's own last place, as a share of the support's width; never beyond the support",
            EXPECTED_RETURN_ERROR,
        )
    };
    let mut listed = row(
        "2, 51, 1,001 atoms; supports from 0, far from 0 ([1e6, 1e6 + 1], [1000, 1001]), 1 ulp and 2e30 wide; logits equal, +-1e38, one -inf",
    );
    for atoms in [2usize, 51, 1001] {
        let mut rows: Vec<Vec<f32>> = [0.0, 1e38, -1e38, f32::MAX, 1e-45]
            .map(|x| vec![x; atoms])
            .into();
        for scale in [1e-40f32, 1.0, 30.0, 1e4, 1e38] {
            let ramp = |i: usize| (i * 37 % atoms) as f32 / atoms as f32 * scale - scale / 2.0;
            rows.push((0..atoms).map(ramp).collect());
            let mut blocked: Vec<f32> = (0..atoms).map(ramp).collect();
            blocked[atoms / 2] = f32::NEG_INFINITY;
            rows.push(blocked);
        }
        for support in [
            (-10.0, 10.0),
            (0.0, 1.0),
            (1000.0, 1001.0),
            (1e6, 1e6 + 1.0),
            (1.0, 1.0f32.next_up()),
            (-1e30, 1e30),
            (0.0, 1e30),
            (0.0, 1e-45),
        ] {
            let rows = rows.clone();
            see(&mut listed, &Case { support, rows })?;
        }
    }
    let mut drawn = row("drawn");
    context.draw(0.05, |_, rng| {
        let atoms = rng.random_range(2..120);
        let rows = (0..20).map(|_| finites(atoms, rng)).collect();
        let support = support(rng);
        see(&mut drawn, &Case { support, rows })
    })?;
    let mut rows = vec![listed, drawn];
    rows.extend(policy::check(context)?);
    Ok(rows)
}
