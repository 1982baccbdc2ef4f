//! The backward pass of a loss, with the gradients of weights summed where they are made.
//! It computes no gradient itself and takes no step.
//!
//! candle adds every gradient, also a weight's only one, to fresh zeros on a single thread. Layers that know this sink add theirs
//! in place instead, with their products.

use std::cell::RefCell;
use std::collections::HashMap;

use candle_core::{Result, Tensor, TensorId, Var, backprop::GradStore};

thread_local! {
    /// The sums of the backward pass that runs on this thread, if it is one of [`Backward::of`].
    static SUMS: RefCell<Option<HashMap<TensorId, Vec<f32>>>> = const { RefCell::new(None) };
}

/// The gradients of one loss.
#[derive(Debug)]
pub struct Backward {
    store: GradStore,
    sums: HashMap<TensorId, Vec<f32>>,
}

impl Backward {
    /// Runs the backward pass of `loss`, a scalar.
    ///
    /// # Errors
    /// An operation without a gradient, or one that failed.
    pub fn of(loss: &Tensor) -> Result<Self> {
        SUMS.set(Some(HashMap::new()));
        let store = loss.backward();
        let sums = SUMS.take().unwrap_or_default();
        Ok(Self {
            store: store?,
            sums,
        })
    }

    /// Takes out the gradient of `var`, in its shape; `None` if the loss does not depend on it.
    ///
    /// # Errors
    /// A failing copy of a gradient that is not contiguous.
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

/// Adds to the gradient of `parameter` in place, if that is a variable and the backward pass is one of [`Backward::of`]; says whether.
///
/// `add` gets the sum, in the parameter's layout, and whether it holds anything yet; if not, it may overwrite it.
pub(crate) fn add_in_place(parameter: &Tensor, add: impl FnOnce(&mut [f32], bool)) -> bool {
    if !parameter.is_variable() {
        return false;
    }
    SUMS.with_borrow_mut(|sums| {
        let Some(sums) = sums else { return false };
        let mut there = true;
        let sum = sums.entry(parameter.id()).or_insert_with(|| {
            there = false;
            vec![0.0; parameter.elem_count()]
        });
        add(sum, there);
        true
    })
}
