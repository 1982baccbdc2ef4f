//! The target network on its way to the online network.

use driml_learner::{
    Kernels,
    optimiser::target::{FOLLOWED_MAX, follow, follow_error},
};
use driml_model::ModelConfig;
use rand::Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{finites, shown},
    routines::losses::worse,
    small,
};

const TARGET: Routine = Routine {
    name: "target network",
    range: "tau 1e-5 to 1; parameters within 1.7e38",
};

/// Parameters of both networks, in f64 for the target, and how large any of them ever was.
struct Pair {
    config: ModelConfig,
    target: driml_model::Parameters,
    exact: Vec<f64>,
    largest: Vec<f64>,
}

impl Pair {
    fn new(config: ModelConfig, target: &[f32]) -> anyhow::Result<Self> {
        Ok(Self {
            target: small::parameters(&config, target)?,
            exact: target.iter().map(|&x| x.into()).collect(),
            largest: target.iter().map(|x| x.abs().into()).collect(),
            config,
        })
    }

    /// Moves so often towards these parameters.
    fn follow(&mut self, online: &[f32], tau: f64, moves: u64) -> anyhow::Result<()> {
        let source = small::parameters(&self.config, online)?;
        for _ in 0..moves {
            follow(&self.target, &source, tau, Kernels::FUSED)?;
        }
        // All moves at once: what is left of the distance is (1 - tau)^moves.
        let left = if tau >= 1.0 {
            0.0
        } else {
            (moves as f64 * (-tau).ln_1p()).exp()
        };
        for ((exact, largest), &online) in self.exact.iter_mut().zip(&mut self.largest).zip(online)
        {
            let online = f64::from(online);
            *exact = online + left * (*exact - online);
            *largest = largest.max(online.abs());
        }
        Ok(())
    }

    /// The largest error, as a share of the largest size.
    fn error(&self) -> anyhow::Result<f64> {
        let found = small::values(&self.config, &self.target)?;
        let each = found.iter().zip(&self.exact).zip(&self.largest);
        let each = each.map(|((found, exact), largest)| {
            (f64::from(*found) - exact).abs() / largest.max(f32::MIN_POSITIVE.into())
        });
        Ok(each.fold(0.0, worse))
    }
}

fn row(extreme: &str) -> Row {
    Row::new(
        TARGET,
        extreme,
        "error, as a share of (6e-8 / tau + 3e-7) of the largest that either ever was",
        1.0,
    )
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let config = small::least();
    let len = small::len(&config);
    let mut long = row(
        "3 / tau moves towards a network that stands still; tau 0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5",
    );
    for tau in [0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5] {
        let moves = (3.0 / tau) as u64;
        if moves > context.settings.follow_moves {
            continue;
        }
        let start = [-0.4f32, -1.1, 0.6, 2.6, 0.0, 1e-45, -1e30, 1.0, 0.3, -0.3];
        let end = [
            0.7f32, -1.3, 0.011, 2.5, 1e-38, 1e-40, 1e30, -1.0, 1e-20, 7e6,
        ];
        let at = |values: &[f32]| -> Vec<f32> { (0..len).map(|i| values[i % 10]).collect() };
        let mut pair = Pair::new(config.clone(), &at(&start))?;
        pair.follow(&at(&end), tau, moves)?;
        long.see(pair.error()? / follow_error(tau), || {
            format!("tau {tau}, {moves} moves")
        });
        context.progress.advance(0)?;
    }
    let mut drawn = row("drawn, up to 30 moves towards a network that moves");
    let mut copied = Row::new(
        TARGET,
        "tau 1, drawn",
        "parameters whose bits are not those of the online network",
        0.0,
    );
    context.draw(0.02, |_, rng| {
        let within = |rng: &mut _| -> Vec<f32> {
            let mut values = finites(len, rng);
            values
                .iter_mut()
                .for_each(|x| *x = x.clamp(-FOLLOWED_MAX, FOLLOWED_MAX));
            values
        };
        let start = within(rng);
        let mut pair = Pair::new(config.clone(), &start)?;
        let tau = 10f64.powf(rng.random_range(-5.0..0.0));
        for _ in 0..rng.random_range(1..8) {
            let moves = rng.random_range(1..5);
            pair.follow(&within(rng), tau, moves)?;
        }
        drawn.see(pair.error()? / follow_error(tau), || {
            format!("tau {tau:e}, from {}", shown(&start))
        });
        let online = finites(len, rng);
        pair.follow(&online, 1.0, 1)?;
        for (found, online) in small::values(&config, &pair.target)?.iter().zip(&online) {
            copied.must(found.to_bits() == online.to_bits(), || {
                format!("{online:e}")
            });
        }
        Ok(())
    })?;
    Ok(vec![long, drawn, copied])
}
