//! The backward pass of a loss, with the gradients of weights summed where they are made.
//! It computes no gradient itself and takes no step.
//!
//! candle adds every gradient, also a weight's only one, to fresh zeros on a single thread. Layers that know this sink add theirs
//! in place instead, with their products.

use std::cell::RefCell;
use std::collections::HashMap;

use candle_core::{Result, Tensor, TensorId, Var, backprop::GradStore, bail};

type Sums = HashMap<TensorId, Vec<f32>>;

thread_local! {
    /// The sums of the backward pass that runs on this thread, if it is one of [`Backward::of`].
    ///
    /// A thread of the pool that waits for its products may take up another learner's whole update: a pass that begins here
    /// therefore puts the sums of the one below it aside and restores them, and the cell is never borrowed while other work may run.
    static SUMS: RefCell<Option<Sums>> = const { RefCell::new(None) };
}

/// Gives the pass below its sums back, also when this one panics.
struct PassBelow(Option<Sums>);

impl Drop for PassBelow {
    fn drop(&mut self) {
        SUMS.set(self.0.take());
    }
}

/// The gradients of one loss.
#[derive(Debug)]
pub struct Backward {
    store: GradStore,
    sums: Sums,
}

impl Backward {
    /// Runs the backward pass of `loss`, a scalar.
    pub fn of(loss: &Tensor) -> Result<Self> {
        let _below = PassBelow(SUMS.replace(Some(Sums::new())));
        let store = loss.backward();
        let sums = SUMS.take().unwrap_or_default();
        Ok(Self {
            store: store?,
            sums,
        })
    }

    /// Takes out the gradient of `var`, in its shape; `None` if the loss does not depend on it.
    pub fn remove(&mut self, var: &Var) -> Result<Option<Tensor>> {
        let sum = self.sums.remove(&var.id());
        let sum = sum.map(|sum| Tensor::from_vec(sum, var.shape(), var.device()));
        // candle leaves some gradients tied to the pass they come from; moments made of them would keep every pass.
        let stored = self.store.remove(var);
        let stored = stored.map(|gradient| gradient.contiguous()).transpose()?;
        match (sum.transpose()?, stored.map(|gradient| gradient.detach())) {
            (Some(sum), Some(stored)) => (sum + stored).map(Some),
            (one, other) => Ok(one.or(other)),
        }
    }
}

/// The gradient of `parameter` that `add` makes; none where it is not wanted or [`add_in_place`] added it to a variable's sum.
pub(crate) fn summed(
    parameter: &Tensor,
    add: impl Fn(Option<Vec<f32>>) -> Vec<f32>,
) -> Option<Vec<f32>> {
    let is_wanted = parameter.track_op() && !add_in_place(parameter, &add);
    is_wanted.then(|| add(None))
}

/// Adds to the gradient of a parameter; a parameter that is not a variable has none.
pub(crate) fn sum_in_place(
    parameter: &Tensor,
    add: impl FnOnce(Option<Vec<f32>>) -> Vec<f32>,
) -> Result<()> {
    if parameter.is_variable() && !add_in_place(parameter, add) {
        bail!("a backward pass through these layers has to be one of Backward::of");
    }
    Ok(())
}

/// Adds to the gradient of `parameter` in place, if that is a variable and the backward pass is one of [`Backward::of`]; says whether.
///
/// `add` gets the sum so far, in the parameter's layout, and gives back the sum with its part.
fn add_in_place(parameter: &Tensor, add: impl FnOnce(Option<Vec<f32>>) -> Vec<f32>) -> bool {
    if !parameter.is_variable() {
        return false;
    }
    let kept = SUMS.with_borrow_mut(|sums| Some(sums.as_mut()?.remove(&parameter.id())));
    let Some(kept) = kept else { return false };
    let sum = add(kept);
    SUMS.with_borrow_mut(|sums| {
        if let Some(sums) = sums {
            sums.insert(parameter.id(), sum);
        }
    });
    true
}
