//! Turns a received batch into one that an update reads: enlarges and augments states, and computes importance weights.
//! It trains nothing.

use std::borrow::Cow;

use driml_model::{ModelError, Resizer};
use driml_protocol::Batch as WireBatch;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::{
    augment::Augmenter, auxiliary::positives::Positives, batch::Batch, config::LearnerConfig,
    deduplicate::concatenate, importance::importance_weights,
};

/// The columns of a received batch that need a conversion before an update can read them.
pub(crate) struct Columns<'a> {
    batch: &'a WireBatch,
    /// s_t, s_{t+k} and s_{t+n}. Their stacks of frames are assembled here, once per update.
    states: [Cow<'a, [u8]>; 3],
    returns: Vec<f32>,
    discounts: Vec<f32>,
    /// The probability with which each row was drawn; `None` if rows were equally likely.
    pub(crate) probabilities: Option<Vec<f32>>,
    weights: Option<Vec<f32>>,
    /// `positive_valid` if the positive is another view of s_t: 1 for every row.
    all_valid: Vec<u8>,
}

impl<'a> Columns<'a> {
    /// Converts the columns of `batch`; `beta` is the exponent of importance weights.
    pub(crate) fn new(batch: &'a WireBatch, beta: f64) -> Self {
        let probabilities = batch.probabilities();
        let weights = probabilities.as_ref();
        Self {
            batch,
            states: [batch.states_t(), batch.states_k(), batch.states_n()],
            returns: batch.n_step_returns(),
            discounts: batch.bootstrap_discounts(),
            weights: weights.map(|it| importance_weights(it, beta)),
            probabilities,
            all_valid: vec![1; batch.rows()],
        }
    }
}

/// Prepares the states of batches, in buffers that are reused for each batch.
pub(crate) struct Preparation {
    positives: Positives,
    state_bytes: usize,
    enlarge: Option<Resizer>,
    /// States at the network's input size, if they have to be enlarged.
    enlarged: [Vec<u8>; 3],
    augment: Option<Augmenter>,
    /// Augmented states for the auxiliary loss.
    augmented: [Vec<u8>; 2],
}

impl Preparation {
    pub(crate) fn new(config: &LearnerConfig) -> Result<Self, ModelError> {
        let (spec, model) = (&config.spec, &config.model);
        let size = (model.height, model.width, model.input_channels);
        let channels = spec.frame_channels as usize;
        let augment = config.learner.augment;
        Ok(Self {
            positives: config.learner.update.auxiliary_loss.positives(),
            state_bytes: model.frame_len(),
            enlarge: config.input.resizer(spec.frame_size(), model)?,
            enlarged: Default::default(),
            augment: augment.map(|settings| Augmenter::new(settings, size, channels)),
            augmented: Default::default(),
        })
    }

    /// Returns the batch of `columns` in the form that an update reads; augmentation draws from `rng`.
    pub(crate) fn prepare<'a>(
        &'a mut self,
        columns: &'a Columns<'_>,
        rng: &mut ChaCha8Rng,
    ) -> Batch<'a> {
        let mut frames = columns.states.each_ref().map(|states| &states[..]);
        if let Some(enlarge) = &self.enlarge {
            for (states, larger) in frames.iter_mut().zip(&mut self.enlarged) {
                enlarge_all(enlarge, states, larger);
                *states = larger;
            }
        }
        let [states_t, states_k, states_n] = frames;
        let received = columns.batch;
        let mut batch = Batch {
            rows: received.rows(),
            states_t,
            anchors: None,
            positives: received.positives(),
            states_k,
            states_n,
            action: received.actions(),
            next_action: received.next_actions(),
            n_step_return: &columns.returns,
            bootstrap_discount: &columns.discounts,
            positive_valid: received.positive_valid(),
            importance_weight: columns.weights.as_deref(),
        };
        if let Some(augment) = &self.augment {
            if self.positives == Positives::OtherView {
                // Two views of the same state.
                batch.states_k = states_t;
                batch.positives = 1;
                batch.positive_valid = &columns.all_valid;
            }
            let [augmented_t, augmented_k] = &mut self.augmented;
            augment.apply(states_t, augmented_t, rng);
            // Draws for missing positives too, so that a run's augmentations do not depend on which positives are missing.
            if batch.states_k.len() < batch.positive_valid.len() * self.state_bytes {
                let each = batch.positive_states(self.state_bytes).into_iter();
                augment.apply(&concatenate(each, self.state_bytes), augmented_k, rng);
            } else {
                augment.apply(batch.states_k, augmented_k, rng);
            }
            batch.anchors = Some(augmented_t);
            batch.states_k = augmented_k;
        }
        batch
    }
}

/// Enlarges all `states` into `larger`, in parallel.
fn enlarge_all(enlarge: &Resizer, states: &[u8], larger: &mut Vec<u8>) {
    let (from, to) = (enlarge.input_bytes(), enlarge.output_bytes());
    larger.resize(states.len() / from * to, 0);
    larger
        .par_chunks_exact_mut(to)
        .zip(states.par_chunks_exact(from))
        .for_each(|(larger, state)| enlarge.apply(state, larger));
}
