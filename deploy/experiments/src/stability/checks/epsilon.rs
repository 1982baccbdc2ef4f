//! The schedule of epsilon.

use driml_actor::Schedule;

use crate::stability::property::*;

const FRAMES: &str = "decay over 0, 1, 1e5, 1e10, 2^32, 2^53, 2^64 - 1 frames, from before the first to after the last";

pub(super) fn properties() -> Vec<Property> {
    vec![
        Property::new("epsilon", "any counts of frames; start and end 0 to 1")
            .promise("epsilon; never back or beyond its ends", Schedule::ERROR)
            .check(FRAMES, Listed, epsilon)
            .check("drawn", Drawn(1.0), epsilon),
    ]
}

fn draw_count(rng: &mut ChaCha8Rng) -> u64 {
    rng.random::<u64>() >> rng.random_range(0..64)
}

fn epsilon(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let ends = [
        (1.0, 0.0),
        (0.1, 0.01),
        (1.0, 0.999_999_9),
        (0.05, 0.05),
        (0.0, 1.0),
    ];
    let (start, end) = cases.listed_or(&ends, |rng| (rng.random(), rng.random()));
    let decays = [0, 1, 100_000, 10_000_000_000, 1 << 32, 1 << 53, u64::MAX];
    let decay_frames = cases.listed_or(&decays, draw_count);
    let hundredths = (0..=100u32).map(|i| (u128::from(decay_frames) * u128::from(i) / 100) as u64);
    let neighbours = hundredths.flat_map(|at| [at.saturating_sub(1), at, at.saturating_add(1)]);
    let listed: Vec<u64> = neighbours.chain([u64::MAX]).collect();
    let mut frames = cases.listed_or(&[listed], |rng| (0..4).map(|_| draw_count(rng)).collect());
    frames.sort_unstable();
    let schedule = Schedule {
        start,
        end,
        decay_frames,
    };
    let mut before: f64 = start;
    for frames in frames {
        let found = schedule.epsilon(frames);
        // The quotient of the two counts, exact to the last place: computed as an integer with 64 fractional bits.
        let share = match frames >= decay_frames {
            true => 1.0,
            false => ((u128::from(frames) << 64) / u128::from(decay_frames)) as f64 / 2f64.powi(64),
        };
        let is_between = (before.min(end)..=before.max(end)).contains(&found);
        let error = nan_unless(is_between, found - (start + (end - start) * share));
        let input = format_args!("{start} to {end} over {decay_frames}, after {frames}: {found}");
        cases.record_errors(input, [error])?;
        before = found;
    }
    Ok(())
}
