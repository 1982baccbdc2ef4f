//! Compares an inspection with what a learner builds and sends.

use driml_learner::{Compute, Learner, LearnerConfig};
use driml_protocol::{Batch, BatchHeader, Buffer, RowScalars};
use driml_settings::presets::AGENTS;
use expect_test::expect_file;

use super::*;
use crate::testing::config;

fn find<'a>(lines: &'a [Line], what: &str) -> &'a Line {
    lines.iter().find(|line| line.what.trim() == what).unwrap()
}

#[test]
fn the_paper_s_agent_is_described_in_a_table_and_in_a_line_of_sums() {
    let inspection =
        Inspection::new(&config("paper", "procgen:bigfish", "driml-ada", &[])).unwrap();
    expect_file!["../../tests/snapshots/inspect.txt"].assert_eq(&inspection.describe());
    let json = serde_json::to_value(&inspection).unwrap();
    assert_eq!(json["bytes"][0]["what"], "a transition in a chunk");

    let text = describe_worlds(&[inspection.clone(), inspection]);
    assert_eq!(text.matches("\nprocgen:bigfish ").count(), 2, "{text}");
    assert!(text.lines().all(|line| line.len() <= 80), "{text}");
    for sum in ["3,633,018", "14,270,464,000", "7,779,328", "8,297,472"] {
        assert_eq!(text.matches(sum).count(), 2, "{sum} in {text}");
    }
}

/// Every agent in every kind of world: of a small network what is built, and at the paper's sizes no more than everything.
#[test]
fn what_is_counted_is_what_is_built_and_no_more_than_everything() {
    let small = [
        "model.hidden=16",
        "model.embedding_dim=8",
        "learner.batch_size=4",
    ];
    for world in ["procgen:bigfish", "mspacman", "ising", "chain"] {
        for agent in AGENTS.iter().map(|agent| agent.name) {
            let it = Inspection::new(&config("paper", world, agent, &[])).unwrap();
            for line in [it.parameters, it.update_flops, it.decision_flops, it.bytes].concat() {
                assert!(line.is <= line.everything, "{agent} on {world}: {line:?}");
            }
            let config = config("smoke", world, agent, &small);
            let inspection = Inspection::new(&config).unwrap();
            let settings = LearnerConfig::from_toml(&config.to_toml()).unwrap();
            let mut learner = Learner::new(settings, &Compute::CPU).unwrap();
            let networks = learner.agent();
            let scalars = |it: &driml_model::Parameters| -> usize {
                it.iter().map(|(_, var)| var.elem_count()).sum()
            };
            let key = networks.key_encoder().map_or(0, scalars);
            let built = scalars(networks.online()) + scalars(networks.target()) + key;
            let said: u64 = inspection.parameters.iter().map(|line| line.is).sum();
            assert_eq!(said, built as u64, "{agent} on {world}");
            assert_eq!(find(&inspection.parameters, "key encoder").is, key as u64);

            let weights = learner.export_weights().unwrap().safetensors.len();
            assert_eq!(find(&inspection.bytes, "a broadcast").is, weights as u64);
            // Rows with every state that a row may have.
            let header = BatchHeader::largest(&config.run, config.learner.batch_size)
                .with_sampling(&config.replay.sampling);
            let row = RowScalars {
                action: 0,
                next_action: 0,
                n_step_return: 0.0,
                bootstrap_discount: 1.0,
                positives: header.positives,
                k_first: 1,
            };
            let rows = vec![row; header.rows as usize];
            let batch = Batch::from_rows(header, &rows, Buffer::zeroed);
            let states = [batch.states_t(), batch.states_n(), batch.states_k()];
            let states = states.map(|states| states.len());
            let (_, payload) = batch.into_payload();
            let said = |what| find(&inspection.bytes, what).is as usize;
            assert_eq!(said("a batch"), payload.len());
            let said_states = [said("s_t and s_{t+n}"), said("s_{t+k}")];
            match header.stacked {
                None => assert_eq!(said_states, [states[0] + states[1], states[2]]),
                Some(stacked) => {
                    // For each frame of a state, four bytes say which frame it is.
                    let frames = stacked.frames as usize * config.run.frame_bytes();
                    let stacks = states.iter().sum::<usize>() / config.run.frame_bytes() * 4;
                    assert_eq!(said_states.iter().sum::<usize>(), frames + stacks);
                }
            }
        }
    }
}
