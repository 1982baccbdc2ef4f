//! Slow copies of the online network, such as the target network: how they follow it.
//! When they do is for `update` to say.

use candle_core::{CpuStorage, InplaceOp2, Layout, bail};
use driml_model::{Kernels, Parameters};

use crate::{
    error::UpdateError,
    tensors::{slice, slice_mut},
};

/// Names of the parameters that only the auxiliary loss uses begin so.
pub const AUXILIARY_PREFIX: &str = "dim.";

/// Moves `target` towards `online`, in place: `target <- tau * online + (1 - tau) * target`.
///
/// `tau` in (0, 1]; at 1 the copy is exact.
///
/// # Errors
/// A parameter of the target that the online network lacks.
pub fn follow(
    target: &Parameters,
    online: &Parameters,
    tau: f64,
    kernels: Kernels,
) -> Result<(), UpdateError> {
    for (name, var) in target.iter() {
        let Some(source) = online.get(name) else {
            return Err(UpdateError::State(format!(
                "the online network has no {name}"
            )));
        };
        match kernels {
            Kernels::Fused(_) => var.inplace_op2(source, &Follow { tau: tau as f32 })?,
            Kernels::Candle => {
                let (kept, taken) = (var.affine(1.0 - tau, 0.0)?, source.affine(tau, 0.0)?);
                var.set(&(kept + taken)?)?;
            }
        }
    }
    Ok(())
}

struct Follow {
    tau: f32,
}

impl InplaceOp2 for Follow {
    fn name(&self) -> &'static str {
        "follow"
    }

    fn cpu_fwd(
        &self,
        target: &mut CpuStorage,
        l1: &Layout,
        online: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<()> {
        let (target, online) = (slice_mut(target, l1)?, slice(online, l2)?);
        if target.len() != online.len() {
            bail!(
                "a target of {} values follows {}",
                target.len(),
                online.len()
            );
        }
        let keep = 1.0 - self.tau;
        for (target, &online) in target.iter_mut().zip(online) {
            *target = self.tau * online + keep * *target;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Result, Var};

    use super::*;

    #[test]
    fn it_moves_by_tau() -> Result<()> {
        let target = Var::new(&[1.0f32, -2.0], &Device::Cpu)?;
        let online = Var::new(&[3.0f32, 2.0], &Device::Cpu)?;
        target.inplace_op2(&online, &Follow { tau: 0.75 })?;
        assert_eq!(target.to_vec1::<f32>()?, [2.5, 1.0]);
        assert_eq!(online.to_vec1::<f32>()?, [3.0, 2.0]);
        Ok(())
    }
}
