//! The C51 projection: one Bellman step of a return distribution, projected back onto the atoms.
//! It does not choose the action, and it does not check for NaN: its callers do.

/// Largest difference between the sums of a row before and after its projection: half a unit in the last place of each probability,
/// if all these errors have the same sign.
pub const MASS_ERROR: f64 = 6.1e-8;

/// Largest error of a projected probability on this support: 1e-7, plus the f64 rounding of a return's position. The rounding matters
/// if the support is far from 0 compared with its width.
pub fn entry_error(atoms: usize, v_min: f32, v_max: f32) -> f64 {
    let (v_min, v_max) = (f64::from(v_min), f64::from(v_max));
    let far = v_min.abs().max(v_max.abs()) / (v_max - v_min);
    1e-7 + 1e-15 * atoms as f64 * far
}

/// Moves return distributions one Bellman step and back onto the atoms.
///
/// With atoms `z_i = v_min + i * (v_max - v_min) / (N - 1)`, atom i of a row moves to
/// `b = (clamp(reward + discount * z_i, v_min, v_max) - v_min) / (z_1 - z_0)` atoms, and its probability is split
/// between `floor(b)` and the next atom in proportion to nearness. If `b` is a whole number, atom `b` gets all of it.
///
/// `probs` [B, N], rows sum to 1; `reward` [B], in units of return; `discount` [B], 0 where the episode ended.
/// `out` [B, N] is overwritten; its rows have the same sums as those of `probs`, within [`MASS_ERROR`], and no entry is negative.
/// Positions are computed in f64: an entry is accurate to [`entry_error`] for finite and infinite rewards.
/// Source: Bellemare et al. 2017, algorithm 1.
///
/// # Panics
/// If the lengths disagree, or `v_min < v_max` does not hold, or N < 2: the caller has checked its batch by then.
pub fn project(
    probs: &[f32],
    reward: &[f32],
    discount: &[f32],
    v_min: f32,
    v_max: f32,
    out: &mut [f32],
) {
    let rows = reward.len();
    assert!(rows > 0, "no rows");
    assert_eq!(discount.len(), rows, "one reward and one discount a row");
    let atoms = probs.len() / rows;
    assert!(atoms >= 2, "two atoms or more");
    assert_eq!(probs.len(), rows * atoms, "whole rows");
    assert_eq!(probs.len(), out.len(), "the result has the shape of probs");
    assert!(v_min < v_max, "a support from {v_min} to {v_max}");

    let (v_min, v_max) = (f64::from(v_min), f64::from(v_max));
    let last = (atoms - 1) as f64;
    let spacing = (v_max - v_min) / last;
    let mut row_out = vec![0f64; atoms];
    let rows_in = probs.chunks_exact(atoms).zip(reward.iter().zip(discount));
    for ((row_in, (&reward, &discount)), out) in rows_in.zip(out.chunks_exact_mut(atoms)) {
        let (reward, discount) = (f64::from(reward), f64::from(discount));
        row_out.fill(0.0);
        for (i, &p) in row_in.iter().enumerate() {
            let moved = reward + discount * (v_min + i as f64 * spacing);
            // Rounding must not move a position beyond the last atom.
            let b = ((moved.clamp(v_min, v_max) - v_min) / spacing).clamp(0.0, last);
            let low = b.floor();
            let (index, above) = (low as usize, b - low);
            row_out[index] += f64::from(p) * (1.0 - above);
            if above > 0.0 {
                row_out[index + 1] += f64::from(p) * above;
            }
        }
        for (out, &p) in out.iter_mut().zip(&row_out) {
            *out = p as f32;
        }
    }
}

/// Share of the rows whose moved distribution has a mean beyond the atoms, by more than a thousandth of their range: C51 cannot represent
/// the value of such a state. A row of which only some probability lies there does not count. The arguments are those of [`project`].
pub fn share_beyond(
    probs: &[f32],
    reward: &[f32],
    discount: &[f32],
    v_min: f32,
    v_max: f32,
) -> f64 {
    let atoms = probs.len() / reward.len();
    let (v_min, v_max) = (f64::from(v_min), f64::from(v_max));
    let (spacing, margin) = ((v_max - v_min) / (atoms - 1) as f64, (v_max - v_min) * 1e-3);
    let mut beyond = 0;
    for (row, (&reward, &discount)) in probs.chunks_exact(atoms).zip(reward.iter().zip(discount)) {
        let probs = row.iter().enumerate();
        let atom: f64 = probs.map(|(i, &p)| i as f64 * f64::from(p)).sum();
        let mean = f64::from(reward) + f64::from(discount) * (v_min + atom * spacing);
        beyond += usize::from(mean < v_min - margin || mean > v_max + margin);
    }
    beyond as f64 / reward.len() as f64
}

#[cfg(test)]
mod tests {
    use super::share_beyond;

    #[test]
    fn a_row_is_beyond_the_atoms_if_its_mean_is() {
        for (probs, reward, discount, expected) in [
            ([0.0, 0.0, 1.0], 0.0, 1.0, 0.0),
            ([0.0, 0.0, 1.0], 0.1, 0.9, 0.0),
            ([0.0, 0.0, 1.0], 0.2, 0.9, 1.0),
            // A quarter of the probability is beyond.
            ([0.25, 0.5, 0.25], 0.9, 0.9, 0.0),
            ([1.0, 0.0, 0.0], -0.2, 0.9, 1.0),
            ([1.0, 0.0, 0.0], 1.5, 0.0, 1.0),
        ] {
            let found = share_beyond(&probs, &[reward], &[discount], -1.0, 1.0);
            assert_eq!(found, expected, "{probs:?}, {reward}, {discount}");
        }
    }
}
