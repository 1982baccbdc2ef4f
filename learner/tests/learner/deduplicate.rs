//! Equal states of a batch that are computed once: compares the update with and without this.

use candle_core::Tensor;
use driml_learner::{AuxiliaryKind, Batch, Compute, Lambda, OwnedBatch, Precision};
use driml_model::Kernels;

use crate::agents::{GLOBAL, configs};
use crate::synthetic::{
    ALL_DIM, CANDLE, CPC, CURL, DIM, NO_DIM, NONE, new_agent, pool, random_batch,
};

const ROWS: usize = 40;

/// Losses, logits, next actions and targets of a batch, and its gradients.
#[derive(PartialEq)]
struct UpdateResult {
    forward: (Vec<f32>, Vec<f32>, Vec<u8>, Vec<f32>),
    gradients: Vec<(String, Vec<f32>)>,
}

fn found(
    compute: &Compute,
    (auxiliary_loss, lambda): (AuxiliaryKind, Lambda),
    double_dqn: bool,
    deduplicate: bool,
    batch: &Batch<'_>,
) -> UpdateResult {
    let (model, mut settings) = configs(auxiliary_loss, lambda);
    settings.double_dqn = double_dqn;
    let agent = new_agent(model, settings, compute, 1).with_deduplication(deduplicate);
    let it = agent.gradients(batch).unwrap();
    let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let names = agent.online().iter().map(|(name, _)| name);
    let gradient = |name: &str| Some((name.to_owned(), values(it.gradients.get(name)?)));
    let gradients = names.filter_map(gradient).collect();
    let mut losses = vec![it.losses.c51_kl, it.losses.total];
    losses.extend(it.losses.auxiliary.iter().map(|(_, loss)| loss));
    losses.extend(&it.losses.row_kls);
    let logits = values(&it.taken_logits);
    let forward = (losses, logits, it.next_greedy_action, it.target_projection);
    UpdateResult { forward, gradients }
}

/// Which columns hold states that repeat others.
#[derive(Clone, Copy, PartialEq)]
enum Repeat {
    Nowhere,
    Later,
    Everywhere,
}

/// Random rows. If states repeat, every third one is an earlier s_t, as when a scene stands still.
fn rows_with(repeat: Repeat) -> OwnedBatch {
    let mut rows = random_batch(ROWS, 3);
    let len = rows.states_t.len() / ROWS;
    for row in (2..ROWS).step_by(3) {
        let other = rows.states_t[(row / 2) * len..][..len].to_vec();
        let mut planes = [&mut rows.states_t, &mut rows.states_k, &mut rows.states_n];
        for plane in &mut planes[match repeat {
            Repeat::Nowhere => 3..,
            Repeat::Later => 2..,
            Repeat::Everywhere => 0..,
        }] {
            plane[row * len..][..len].copy_from_slice(&other);
        }
    }
    if repeat == Repeat::Later {
        let (from, to) = (len, 4 * len);
        rows.states_n.copy_within(from..from + len, to);
    }
    rows
}

#[test]
fn leaving_repeats_out_changes_no_result_and_sums_gradients_in_another_order_alone() {
    for compute in [Compute::CPU, Compute::cpu(Precision::Bf16), CANDLE] {
        for (auxiliary_loss, lambda) in [
            (NONE, NO_DIM),
            (DIM, ALL_DIM),
            (CPC, ALL_DIM),
            (CURL, GLOBAL),
        ] {
            for (repeat, double_dqn, is_weighted) in [
                (Repeat::Nowhere, false, false),
                (Repeat::Later, true, true),
                (Repeat::Everywhere, false, false),
                (Repeat::Everywhere, false, true),
                (Repeat::Everywhere, true, false),
            ] {
                let rows = rows_with(repeat);
                let mut batch = rows.batch();
                let weights: Vec<f32> = (1..=batch.rows).map(|row| 1.0 / row as f32).collect();
                batch.importance_weight = is_weighted.then_some(&weights);
                if auxiliary_loss == CURL {
                    batch.anchors = Some(&rows.states_k);
                    batch.states_k = &rows.states_n;
                }
                let case = format!("{:?} {auxiliary_loss:?}", compute.kernels);
                let auxiliary = (auxiliary_loss, lambda);
                let [each, once] = [false, true]
                    .map(|deduplicate| found(&compute, auxiliary, double_dqn, deduplicate, &batch));
                assert!(each.forward == once.forward, "{case}: bits forward");
                let (each, once) = (each.gradients, once.gradients);
                // Augmented states are never shared, and a target has no gradient. Candle's own operations compute each state.
                let is_candle = compute.kernels == Kernels::Candle;
                if repeat != Repeat::Everywhere || auxiliary_loss == CURL || is_candle {
                    assert!(each == once, "{case}: the same bits of gradients");
                    continue;
                }
                assert!(each != once, "{case}: nothing was left out");
                assert_eq!(each.len(), once.len());
                // The sum of gradients is rounded to bf16 once, instead of each gradient.
                let tolerance = match compute.kernels {
                    Kernels::Fused(Precision::Bf16) => 1e-2,
                    _ => 1e-6,
                };
                for ((name, each), (_, once)) in each.iter().zip(&once) {
                    let norm = |values: &mut dyn Iterator<Item = f32>| {
                        values.map(|x| f64::from(x).powi(2)).sum::<f64>().sqrt()
                    };
                    let error = norm(&mut each.iter().zip(once).map(|(a, b)| a - b));
                    let size = norm(&mut each.iter().copied());
                    assert!(
                        error <= tolerance * size,
                        "{case} {name}: {error} of {size}"
                    );
                }
            }
        }
    }
}

#[test]
fn gradients_have_the_same_bits_for_any_number_of_threads() {
    let rows = rows_with(Repeat::Everywhere);
    let with_threads = |threads| {
        pool(threads).install(|| {
            let found = found(&Compute::CPU, (DIM, ALL_DIM), false, true, &rows.batch());
            found.gradients
        })
    };
    let one = with_threads(1);
    for threads in [2, 3, 7] {
        assert!(with_threads(threads) == one, "{threads} threads");
    }
}
