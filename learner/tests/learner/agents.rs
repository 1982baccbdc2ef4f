//! Agents with an auxiliary loss: too few positives, CPC's offsets, CURL's two views.
//! `parity` checks the arithmetic; `served` tests a learner of each agent.

use driml_learner::{
    Agent, AuxiliaryKind, Batch, Lambda, OwnedBatch, Positives, UpdateError, UpdateSettings,
    auxiliary::{curl::CURL as CURL_ITEM, loss::MenuItem},
};
use driml_model::{Compute, ModelConfig};
use driml_protocol::NO_ACTION;

use crate::synthetic::{
    ALL_DIM, CPC, CURL, DIM, NO_DIM, NONE, Values, check_says, model, new_agent, random_batch,
    settings, values,
};

pub(crate) const GLOBAL: Lambda = Lambda {
    l4t4: 1.0,
    ..NO_DIM
};
const POSITIVES: usize = 3;
/// A loss that a program adds, whose keys are later states.
const LATER_STATE_KEYS: AuxiliaryKind = AuxiliaryKind::from_item(&MenuItem {
    positives: Positives::One,
    ..CURL_ITEM
});
const KEY_TAU: f32 = 0.25;

pub(crate) fn configs(kind: AuxiliaryKind, lambda: Lambda) -> (ModelConfig, UpdateSettings) {
    let own = format!("curl.key_tau = {KEY_TAU}");
    let own = if kind == CURL { own.as_str() } else { "" };
    let settings = UpdateSettings {
        auxiliary_loss: kind,
        condition_on_action: kind == DIM || kind == CPC,
        own: own.parse().unwrap(),
        ..settings(lambda)
    };
    let model = ModelConfig {
        dim: settings.dim_heads(4),
        ..model(lambda)
    };
    (model, settings)
}

fn agent(kind: AuxiliaryKind, lambda: Lambda) -> Agent {
    let (model, settings) = configs(kind, lambda);
    new_agent(model, settings, &Compute::CPU, 1)
}

/// A batch of `rows` with `POSITIVES` positives per row.
fn cpc_batch<'a>(rows: &'a OwnedBatch, states_k: &'a [u8], valid: &'a [u8]) -> Batch<'a> {
    Batch {
        positives: POSITIVES,
        states_k,
        positive_valid: valid,
        ..rows.batch()
    }
}

fn later_states(rows: &OwnedBatch) -> Vec<u8> {
    [&rows.states_t[..], &rows.states_k, &rows.states_n].concat()
}

fn curl_batch(rows: &OwnedBatch) -> Batch<'_> {
    Batch {
        anchors: Some(&rows.states_k),
        states_k: &rows.states_n,
        ..rows.batch()
    }
}

fn present_states(states: &[u8], present: impl ExactSizeIterator<Item = bool>) -> Vec<u8> {
    let states = states.chunks_exact(states.len() / present.len());
    let present = states.zip(present).filter(|(_, present)| *present);
    present.flat_map(|(state, _)| state.to_vec()).collect()
}

#[test]
fn states_that_rows_do_not_have_may_be_left_out() {
    for (kind, lambda) in [
        (NONE, NO_DIM),
        (DIM, ALL_DIM),
        (CPC, ALL_DIM),
        (LATER_STATE_KEYS, GLOBAL),
    ] {
        let mut rows = random_batch(6, 4);
        rows.bootstrap_discount = vec![0.9, 0.0, 0.9, 0.9, 0.0, 0.9];
        rows.positive_valid = vec![0, 1, 0, 1, 1, 1];
        // A loss that masks nothing sees blank states in place of missing ones.
        let len = rows.states_k.len() / 6;
        for row in [0, 2] {
            rows.states_k[row * len..][..len].fill(0);
        }
        let several = later_states(&rows);
        let valid = [[0, 1, 1, 1, 1, 1], [0, 1, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1]].concat();
        let whole = if kind == CPC {
            cpc_batch(&rows, &several, &valid)
        } else {
            rows.batch()
        };
        let valid = whole.positive_valid.iter().map(|it| *it != 0);
        let states_k = present_states(whole.states_k, valid);
        let bootstraps = whole.bootstrap_discount.iter().map(|it| *it != 0.0);
        let states_n = present_states(whole.states_n, bootstraps);
        let parts = Batch {
            states_k: &states_k,
            states_n: &states_n,
            ..whole
        };
        assert!(states_k.len() < whole.states_k.len() && states_n.len() < whole.states_n.len());
        let learned = [whole, parts].map(|batch| {
            let mut agent = agent(kind, lambda);
            let reports = [agent.update(&batch).unwrap(), agent.update(&batch).unwrap()];
            (reports, values(agent.online()))
        });
        assert!(learned[0] == learned[1], "{kind:?}");
        let found = agent(kind, lambda).gradients(&parts).unwrap();
        let is_ended = parts.bootstrap_discount.iter().map(|it| *it == 0.0);
        let is_none = found.next_greedy_action.iter().map(|it| *it == NO_ACTION);
        assert!(is_none.eq(is_ended), "{kind:?}");
        // All rows have ended.
        let ended = Batch {
            bootstrap_discount: &[0.0; 6],
            states_n: &[],
            ..parts
        };
        let found = agent(kind, lambda).gradients(&ended).unwrap();
        assert_eq!(found.next_greedy_action, [NO_ACTION; 6], "{kind:?}");

        for (states_k, states_n, what) in [
            (&states_k[1..], &states_n[..], "states_k"),
            (&states_k, &states_n[1..], "states_n"),
        ] {
            let batch = Batch {
                states_k,
                states_n,
                ..whole
            };
            check_says(agent(kind, lambda).gradients(&batch).unwrap_err(), &[what]);
        }
    }
}

#[test]
fn without_two_positives_the_return_alone_is_learned() {
    let mut rows = random_batch(5, 5);
    let states_k = later_states(&rows);
    for valid_count in 0..2 {
        let mut valid = [0; 5 * POSITIVES];
        valid[..valid_count].fill(1);
        rows.positive_valid = valid[..5].to_vec();
        for (kind, lambda, batch) in [
            (CPC, GLOBAL, cpc_batch(&rows, &states_k, &valid)),
            (DIM, ALL_DIM, rows.batch()),
        ] {
            let losses = agent(kind, lambda).update(&batch).unwrap().losses;
            assert_eq!(losses.total, losses.c51_kl);
            let losses = losses.auxiliary;
            assert_eq!(losses.len(), if kind == CPC { 1 } else { 4 });
            assert!(losses.iter().all(|(_, loss)| *loss == 0.0), "{losses:?}");
        }
    }
}

/// The end of an episode does not affect either view. `parity` checks that the loss compares the views, and not the state.
#[test]
fn curl_masks_no_row() {
    let (agent, mut rows) = (agent(CURL, GLOBAL), random_batch(8, 7));
    let losses = |rows: &OwnedBatch| agent.gradients(&curl_batch(rows)).unwrap().losses.auxiliary;
    let before = losses(&rows);
    rows.positive_valid.fill(0);
    assert_eq!(losses(&rows), before);
}

/// The entries of `values` whose names pass `part`.
pub(crate) fn select(values: &Values, part: impl Fn(&str) -> bool) -> Values {
    let named = values.iter().filter(|(name, _)| part(name));
    named.map(|(name, v)| (name.clone(), v.clone())).collect()
}

/// Moves an average towards the online values of the same names.
pub(crate) fn average_in(average: &mut Values, online: &Values, rate: f32) {
    for (name, values) in average {
        for (value, online) in values.iter_mut().zip(&online[name]) {
            *value += rate * (online - *value);
        }
    }
}

#[track_caller]
pub(crate) fn assert_near(found: &Values, wanted: &Values) {
    assert_eq!(found.len(), wanted.len());
    for (name, found) in found {
        for (found, wanted) in found.iter().zip(&wanted[name]) {
            assert!((found - wanted).abs() < 1e-6, "{name}");
        }
    }
}

/// C51's target network is the same for every agent, so that a comparison of agents compares the auxiliary loss alone. It moves at every
/// third update; CURL's key encoder (torso and psi_4, and nothing else) moves at every update.
#[test]
fn each_slow_network_is_a_moving_average_with_a_period_of_its_own() {
    let rows = random_batch(6, 8);
    for (kind, lambda) in [(NONE, NO_DIM), (DIM, GLOBAL), (CPC, GLOBAL), (CURL, GLOBAL)] {
        let batch = match kind.name() {
            "none" => Batch {
                positives: 0,
                states_k: &[],
                positive_valid: &[],
                ..rows.batch()
            },
            "curl" => curl_batch(&rows),
            _ => rows.batch(),
        };
        let mut agent = agent(kind, lambda);
        assert_eq!(agent.key_encoder().is_some(), kind == CURL);
        let start = values(agent.online());
        let mut target = select(&start, |name| !name.starts_with("dim."));
        let is_in_key = |name: &str| name.starts_with("torso.") || name.starts_with("dim.psi4.");
        let mut key = select(&start, is_in_key);
        for update in 0..=4 {
            if update > 0 {
                agent.update(&batch).unwrap();
                average_in(&mut key, &values(agent.online()), KEY_TAU);
            }
            if update == 3 {
                average_in(&mut target, &values(agent.online()), 0.95);
            }
            assert_near(&values(agent.target()), &target);
            if let Some(encoder) = agent.key_encoder() {
                assert_near(&values(encoder), &key);
            }
        }
        assert_ne!(values(agent.online()), start);
    }
}

#[test]
fn batches_that_an_agent_cannot_use_are_refused() {
    let rows = random_batch(5, 9);
    let (states_k, valid) = (later_states(&rows), [1; 5 * POSITIVES]);
    let refuses = |kind, batch: Batch<'_>, words: &str| {
        let error = agent(kind, GLOBAL).gradients(&batch).unwrap_err();
        assert!(matches!(error, UpdateError::Batch(_)));
        check_says(error, &[words]);
    };
    let several = cpc_batch(&rows, &states_k, &valid);
    refuses(DIM, several, "3 positives a row; this agent needs one");
    refuses(CURL, rows.batch(), "needs two views of each state");
    let short = cpc_batch(&rows, &states_k, &valid[1..]);
    refuses(CPC, short, "positive_valid");
    let short = Batch {
        anchors: Some(&states_k[..8]),
        ..curl_batch(&rows)
    };
    refuses(CURL, short, "anchors");
}

/// The settings' snapshot of refusals has the answers to other settings of a loss that cannot work.
#[test]
fn a_table_that_the_loss_does_not_have_is_refused() {
    let with = |kind, lambda, own: &str| UpdateSettings {
        auxiliary_loss: kind,
        condition_on_action: false,
        own: own.parse().unwrap(),
        ..settings(lambda)
    };
    let check = |kind, lambda, own: &str, words: &str| {
        let error = with(kind, lambda, own).validate().unwrap_err();
        check_says(error, &[words]);
    };
    for (kind, lambda) in [(NONE, NO_DIM), (DIM, GLOBAL), (CPC, GLOBAL)] {
        let curl = "has no use for the table curl";
        check(kind, lambda, "curl.key_tau = 0.1", curl);
        let wanted = format!("take {} out of learner.update", kind.name());
        for own in ["= 0.01", "= { tanh_clip = 5.0 }", "= {}"] {
            check(kind, lambda, &format!("{} {own}", kind.name()), &wanted);
        }
    }
    check(CURL, GLOBAL, "", "--set learner.update.curl.key_tau=");
    let whole = with(CURL, GLOBAL, "curl.key_tau = 1.0");
    whole.validate().unwrap();
}
