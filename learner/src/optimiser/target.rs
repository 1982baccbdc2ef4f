//! Moves slow copies of the online network, such as the target network, towards it.
//! `agent` decides when they move.

use driml_model::{Kernels, Parameters};

use crate::{
    error::{Result, UpdateError},
    tensors::modify_in_place,
};

/// Largest size of a parameter for which a copy can follow: the difference of two parameters is then finite.
pub const FOLLOWED_MAX: f32 = f32::MAX / 2.0;

/// Largest error of a target parameter compared with f64 after any number of moves, relative to the largest size that it, or the online
/// one, ever had (at least 1.2e-38). Each move rounds by half a unit in the last place, and 1 / tau moves add up. 0 for a tau of 1.
pub fn follow_error(tau: f64) -> f64 {
    if tau >= 1.0 {
        return 0.0;
    }
    6e-8 / tau + 3e-7
}

/// Moves `target` towards `online`, in place: `target <- target + tau * (online - target)`.
///
/// `tau` in (0, 1]; at 1 the copy is exact. `1 - tau` is not used, as f32 rounds it for a small tau. If the online network stands still,
/// the target stops within half a unit in the last place of a parameter divided by tau: [`follow_error`]. Parameters are within
/// [`FOLLOWED_MAX`]; beyond it, a target is infinite, and the next update rejects the target network's distribution.
pub fn follow(target: &Parameters, online: &Parameters, tau: f64, kernels: Kernels) -> Result<()> {
    for (name, var) in target.iter() {
        let Some(source) = online.get(name) else {
            return Err(UpdateError::State(format!(
                "the online network has no {name}"
            )));
        };
        match kernels {
            Kernels::Fused(_) => modify_in_place(var, source, |target, online| {
                let tau = tau as f32;
                if tau >= 1.0 {
                    target.copy_from_slice(online);
                    return Ok(());
                }
                for (target, &online) in target.iter_mut().zip(online) {
                    *target += tau * (online - *target);
                }
                Ok(())
            })?,
            Kernels::Candle if tau >= 1.0 => var.set(source)?,
            Kernels::Candle => {
                let step = (source.as_tensor() - var.as_tensor())?.affine(tau, 0.0)?;
                var.set(&(var.as_tensor() + step)?)?;
            }
        }
    }
    Ok(())
}
