//! No auxiliary loss: the agent learns the return alone, without a second pass and without heads.

use super::{
    loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
    positives::Positives,
    settings::{AuxiliarySettings, PAIRS},
};
use crate::error::{Result, UpdateError};

/// The menu item for no auxiliary loss.
pub const NONE: MenuItem = MenuItem {
    name: "none",
    positives: Positives::None,
    loss_names: &[],
    make,
};

fn make(settings: &AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>> {
    settings.check_no_own_table()?;
    if settings.condition_on_action {
        return Err(UpdateError::AuxiliaryLoss(
            "auxiliary_loss = none has no Psi to condition on the action: set condition_on_action to false, or take another agent".into(),
        ));
    }
    let active = settings.lambda.active_pairs();
    match PAIRS.iter().zip(active).find(|(_, active)| *active) {
        Some((pair, _)) => Err(UpdateError::AuxiliaryLoss(format!(
            "auxiliary_loss = none computes no auxiliary loss, but lambda.{pair} is above 0: set it to 0, or take another agent"
        ))),
        None => Ok(Box::new(NoAuxiliaryLoss)),
    }
}

#[derive(Debug)]
struct NoAuxiliaryLoss;

impl AuxiliaryLoss for NoAuxiliaryLoss {
    fn passes(&self, _positives: usize, _augmented: bool) -> Passes {
        Passes::default()
    }

    fn losses(&self, _inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>> {
        Ok(Vec::new())
    }
}
