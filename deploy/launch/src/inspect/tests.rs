//! Compares an inspection with what a learner builds and sends.

use driml_learner::{Compute, Learner, LearnerConfig};
use driml_protocol::{Batch, BatchHeader, Buffer, RowScalars};
use driml_settings::presets::AGENTS;
use expect_test::expect;

use super::*;
use crate::testing::config;

fn find<'a>(lines: &'a [Line], what: &str) -> &'a Line {
    lines.iter().find(|line| line.what.trim() == what).unwrap()
}

#[test]
fn the_paper_s_agent_is_described_in_a_table_and_in_a_line_of_sums() {
    let inspection =
        Inspection::new(&config("paper", "procgen:bigfish", "driml-ada", &[])).unwrap();
    expect![[r#"
        driml-ada on procgen:bigfish

        builds: parameters                      is      everything
        torso.conv1                          6,176           6,176
        torso.conv2                         32,832          32,832
        torso.conv3                         36,928          36,928
        torso.fc                           524,800         524,800
        head                               392,445         837,216
        dim.action                           6,208           6,208
        dim.psi3                                 0         394,240
        dim.phi3                                 0         328,704
        dim.psi4                           852,992         852,992
        dim.phi4                           787,456         787,456
        target network                     993,181       1,437,952
        key encoder                              0       1,453,728
        all                              3,633,018       6,699,232

        computes: FLOPs an update               is      everything
        s_t, torso                   4,756,340,736   4,938,792,960
        s_t, C51 head                   40,108,032     601,620,480
        s_{t+n}, target network      1,991,507,968   2,082,734,080
        s_{t+n}, online network                  0   2,082,734,080
        more states, torso           4,756,340,736  29,632,757,760
        states, key encoder                      0   2,318,401,536
        psi and phi                  2,524,839,936  55,775,723,520
        scores                         201,326,592  32,883,343,360
        all                         14,270,464,000 130,316,107,776

        computes: FLOPs a decision              is      everything
        torso.conv1                      2,408,448       2,764,800
        torso.conv2                      2,359,296       2,359,296
        torso.conv3                      1,179,648       1,179,648
        torso.fc                         1,048,576       1,048,576
        head                               783,360         783,360
        all                              7,779,328       8,135,680

        holds and sends: bytes                  is      everything
        a transition in a chunk             10,806          12,294
        a transition in the replay          10,832          12,320
        a batch                          8,297,472      22,025,216
          s_t and s_{t+n}                5,529,600       6,291,456
          s_{t+k}                        2,764,800      15,728,640
          numbers                            3,072           5,120
        a broadcast                      3,973,556      15,233,880

        everything: all that the agents of the menu have, at once: five heads of DIM and a key encoder, a dueling head of noisy layers, four pairs of levels at five positives a row, augmented, double DQN, all weights broadcast as f32; frames whole, stacked and enlarged where they are made
    "#]].assert_eq(&inspection.describe());
    let json = serde_json::to_value(&inspection).unwrap();
    assert_eq!(json["bytes"][0]["what"], "a transition in a chunk");

    let text = describe_worlds(&[inspection.clone(), inspection]);
    assert_eq!(text.matches("\nprocgen:bigfish ").count(), 2, "{text}");
    for sum in [
        "3,633,018 (6,699,232)",
        "14,270,464,000 (130,316,107,776)",
        "7,779,328 (8,135,680)",
        "8,297,472 (22,025,216)",
    ] {
        assert_eq!(text.matches(sum).count(), 2, "{sum} in {text}");
    }
}

/// Every agent in every kind of world, with a small network.
#[test]
fn what_is_counted_is_what_is_built() {
    let small = [
        "model.hidden=16",
        "model.embedding_dim=8",
        "learner.batch_size=4",
    ];
    for world in ["procgen:bigfish", "mspacman", "ising", "chain"] {
        for agent in AGENTS.iter().map(|agent| agent.name) {
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

#[test]
fn no_agent_has_more_than_everything() {
    for world in ["procgen:bigfish", "mspacman", "ising", "chain"] {
        for agent in AGENTS.iter().map(|agent| agent.name) {
            let double = ["learner.update.double_dqn=true"];
            let sets = if agent == "c51" { &double[..] } else { &[] };
            let it = Inspection::new(&config("paper", world, agent, sets)).unwrap();
            for line in [it.parameters, it.update_flops, it.decision_flops, it.bytes].concat() {
                assert!(line.is <= line.everything, "{agent} on {world}: {line:?}");
            }
        }
    }
}
