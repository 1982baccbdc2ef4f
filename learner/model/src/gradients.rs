//! The backward pass of a loss, with a sink in which layers sum the gradients of their weights in place.
//! This module computes no gradient itself and takes no optimizer step.
//!
//! candle adds every gradient, even the only one of a weight, to fresh zeros on a single thread. Layers that
//! use this sink let their matrix products add to the sum in place instead.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};

use candle_core::{Result, Tensor, TensorId, Var, bail};

type Sums = HashMap<TensorId, Vec<f32>>;

thread_local! {
    /// The gradient sums of the backward pass on this thread, if [`backward`] runs it.
    ///
    /// A pool thread that waits for its products may steal another learner's whole update. A pass that starts here
    /// therefore sets the outer pass's sums aside and restores them. The cell is never borrowed while other work may run.
    static SUMS: RefCell<Option<Sums>> = const { RefCell::new(None) };
}

/// Restores the outer pass's sums, also if the inner pass panics.
struct RestoreOuterPass(Option<Sums>);

impl Drop for RestoreOuterPass {
    fn drop(&mut self) {
        SUMS.set(self.0.take());
    }
}

/// Runs the backward pass of `loss`, a scalar. Returns the gradients of `variables`, in their shapes, by their names. A variable on
/// which the loss does not depend has none.
pub fn backward<'a>(
    loss: &Tensor,
    variables: impl Iterator<Item = (&'a str, &'a Var)>,
) -> Result<BTreeMap<String, Tensor>> {
    let restore = RestoreOuterPass(SUMS.replace(Some(Sums::new())));
    let store = loss.backward();
    let mut sums = SUMS.take().unwrap_or_default();
    drop(restore);
    let (mut store, mut gradients) = (store?, BTreeMap::new());
    for (name, var) in variables {
        let sum = sums.remove(&var.id());
        let sum = sum.map(|sum| Tensor::from_vec(sum, var.shape(), var.device()));
        // candle leaves some gradients attached to their pass. Optimizer moments made of them would keep every pass alive.
        let stored = store.remove(var);
        let stored = stored.map(|gradient| gradient.contiguous()).transpose()?;
        let gradient = match (sum.transpose()?, stored.map(|gradient| gradient.detach())) {
            (Some(sum), Some(stored)) => Some((sum + stored)?),
            (one, other) => one.or(other),
        };
        gradients.extend(gradient.map(|it| (name.to_owned(), it)));
    }
    Ok(gradients)
}

/// Returns the gradient of `parameter` as `add` computes it. `None` if none is wanted, or if [`try_add_in_place`] added it to a sum.
pub(crate) fn accumulate(
    parameter: &Tensor,
    add: impl Fn(Option<Vec<f32>>) -> Vec<f32>,
) -> Option<Vec<f32>> {
    let is_wanted = parameter.track_op() && !try_add_in_place(parameter, &add);
    is_wanted.then(|| add(None))
}

/// Adds to the gradient of `parameter`. Does nothing if it is not a variable. Fails if [`backward`] does not run this pass.
pub(crate) fn accumulate_in_place(
    parameter: &Tensor,
    add: impl FnOnce(Option<Vec<f32>>) -> Vec<f32>,
) -> Result<()> {
    if parameter.is_variable() && !try_add_in_place(parameter, add) {
        bail!("a backward pass through these layers has to be one of `backward`");
    }
    Ok(())
}

/// Adds to the gradient of `parameter` in place if it is a variable and [`backward`] runs this pass. Returns whether it did.
///
/// `add` receives the sum so far, in the parameter's layout, and returns the sum including the new gradient.
fn try_add_in_place(parameter: &Tensor, add: impl FnOnce(Option<Vec<f32>>) -> Vec<f32>) -> bool {
    if !parameter.is_variable() {
        return false;
    }
    let so_far = SUMS.with_borrow_mut(|sums| Some(sums.as_mut()?.remove(&parameter.id())));
    let Some(so_far) = so_far else { return false };
    let sum = add(so_far);
    SUMS.with_borrow_mut(|sums| {
        if let Some(sums) = sums {
            sums.insert(parameter.id(), sum);
        }
    });
    true
}
