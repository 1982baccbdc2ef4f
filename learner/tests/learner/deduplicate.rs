//! Equal states of a batch that are computed once: what an update gives with it and without.

use driml_learner::{Agent, AuxiliaryKind, Compute, Evaluation, Lambda, OwnedBatch, Precision};
use driml_model::Kernels;

use crate::agents::{GLOBAL, curl_table};
use crate::synthetic::{
    ALL_DIM, CANDLE, CPC, CURL, DIM, NO_DIM, made, model, random_batch, settings,
};

const ROWS: usize = 40;

fn agent(
    compute: &Compute,
    (auxiliary_loss, lambda): (AuxiliaryKind, Lambda),
    double_dqn: bool,
    deduplicate: bool,
) -> Agent {
    let mut settings = settings(lambda);
    (settings.auxiliary_loss, settings.double_dqn) = (auxiliary_loss, double_dqn);
    if auxiliary_loss == CURL {
        settings.condition_on_action = false;
        settings.own = curl_table(Some(0.5));
    }
    let mut model = model(lambda);
    model.dim = settings.dim_heads(model.num_actions);
    made(model, settings, compute, 1).with_deduplication(deduplicate)
}

/// Which planes hold states that repeat others.
#[derive(Clone, Copy, PartialEq)]
enum Repeat {
    Nowhere,
    Later,
    Everywhere,
}

/// Random rows; where states repeat, every third is an earlier one of s_t, as where a scene stands still.
fn rows(repeat: Repeat) -> OwnedBatch {
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

fn gradients(evaluation: &Evaluation, agent: &Agent) -> Vec<(String, Vec<f32>)> {
    let of = |(name, _): (&str, _)| {
        let gradient = evaluation.gradients.get(name)?;
        Some((
            name.to_owned(),
            gradient.flatten_all().unwrap().to_vec1().unwrap(),
        ))
    };
    agent.online().iter().filter_map(of).collect()
}

fn forward(it: &Evaluation) -> (Vec<f32>, Vec<f32>, Vec<u8>, Vec<f32>) {
    let mut losses = vec![it.c51_kl, it.total];
    losses.extend(it.losses.iter().map(|(_, loss)| loss));
    losses.extend(&it.row_kls);
    let logits = it.taken_logits.flatten_all().unwrap().to_vec1().unwrap();
    (
        losses,
        logits,
        it.next_greedy_action.clone(),
        it.target_projection.clone(),
    )
}

#[test]
fn leaving_repeats_out_changes_no_result_and_sums_gradients_in_another_order_alone() {
    for precision in [Precision::F32, Precision::Bf16] {
        for (auxiliary_loss, lambda) in [
            (AuxiliaryKind::NONE, NO_DIM),
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
                let rows = rows(repeat);
                let mut batch = rows.batch();
                let weights: Vec<f32> = (1..=batch.rows).map(|row| 1.0 / row as f32).collect();
                batch.importance_weight = is_weighted.then_some(&weights);
                if auxiliary_loss == CURL {
                    batch.anchors = Some(&rows.states_k);
                    batch.states_k = &rows.states_n;
                }
                let case = format!("{precision} {auxiliary_loss:?}");
                let [each, once] = [false, true].map(|deduplicate| {
                    let compute = Compute::cpu(precision);
                    let agent = agent(&compute, (auxiliary_loss, lambda), double_dqn, deduplicate);
                    let evaluation = agent.evaluate(&batch).unwrap();
                    (forward(&evaluation), gradients(&evaluation, &agent))
                });
                assert!(each.0 == once.0, "{case}: the same bits forward");
                // Views of states never count as equal, and a target has no gradient.
                if repeat != Repeat::Everywhere || auxiliary_loss == CURL {
                    assert!(each.1 == once.1, "{case}: the same bits of gradients");
                    continue;
                }
                assert!(each.1 != once.1, "{case}: nothing was left out");
                assert_eq!(each.1.len(), once.1.len());
                // A sum of gradients is rounded to bf16 once, not each of them.
                let tolerance = match precision {
                    Precision::F32 => 1e-6,
                    Precision::Bf16 => 1e-2,
                };
                for ((name, each), (_, once)) in each.1.iter().zip(&once.1) {
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
    let rows = rows(Repeat::Everywhere);
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| {
            let agent = agent(&Compute::CPU, (DIM, ALL_DIM), false, true);
            let evaluation = agent.evaluate(&rows.batch()).unwrap();
            gradients(&evaluation, &agent)
        })
    };
    let one = with_threads(1);
    assert!(
        [2, 3, 7]
            .into_iter()
            .all(|count| with_threads(count) == one)
    );
}

#[test]
fn candle_s_own_operations_compute_each_state() {
    assert_eq!(CANDLE.kernels, Kernels::Candle);
    let rows = rows(Repeat::Everywhere);
    let [each, once] = [false, true].map(|deduplicate| {
        let agent = agent(&CANDLE, (DIM, ALL_DIM), false, deduplicate);
        let evaluation = agent.evaluate(&rows.batch()).unwrap();
        (forward(&evaluation), gradients(&evaluation, &agent))
    });
    assert!(each == once);
}
