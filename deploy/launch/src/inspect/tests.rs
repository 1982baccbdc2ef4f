//! Whether what an inspection says is what a learner builds and sends.

use driml_learner::{Compute, Learner, LearnerConfig};
use driml_machine::resources::Machine;
use driml_protocol::{Batch, BatchHeader, Buffer, RowScalars};
use driml_settings::{
    presets::{AGENTS, PRESETS},
    resolve::{Flags, Source, resolve},
};
use expect_test::expect;

use super::*;

fn config(world: &str, agent: &'static str, preset: usize, sets: &[&str]) -> RunConfig {
    let machine = Machine {
        cores: 2,
        memory_bytes: 64 << 30,
        fast_bf16: false,
    };
    let source = Source::Layers(&PRESETS[preset], world.parse().unwrap(), agent);
    let flags = Flags {
        sets: sets.iter().map(|&set| set.into()).collect(),
        ..Flags::default()
    };
    resolve(&source, &flags, &machine).unwrap()
}

fn find<'a>(lines: &'a [Line], what: &str) -> &'a Line {
    lines.iter().find(|line| line.what.trim() == what).unwrap()
}

#[test]
fn the_paper_s_agent_is_described() {
    let inspection = Inspection::of(&config("procgen:bigfish", "driml-ada", 0, &[])).unwrap();
    expect![[r#"
        driml-ada on procgen:bigfish

        parameters                              is      everything  why
        torso.conv1                          6,176           6,176  60x60x3 to 14x14x32, kernel 8, stride 4
        torso.conv2                         32,832          32,832  14x14x32 to 6x6x64, kernel 4, stride 2
        torso.conv3                         36,928          36,928  6x6x64 to 4x4x64, kernel 3, stride 1
        torso.fc                           524,800         524,800  f4, 512 numbers of the last map
        head                               392,445         837,216  C51: 15 actions, 51 atoms each
        dim.action                           6,208           6,208  psi is given a_t (condition_on_action)
        dim.psi3                                 0         394,240  not built: lambda 3t3 and 3t4 are 0
        dim.phi3                                 0         328,704  not built: lambda 3t3 and 4t3 are 0
        dim.psi4                           852,992         852,992  lambda 4t4 above 0
        dim.phi4                           787,456         787,456  lambda 4t4 above 0
        target network                     993,181       1,437,952  torso and head again: s_{t+n} is judged by weights that stand still
        key encoder                              0       1,453,728  not built: the objective has no key encoder, only curl has
        all                              3,633,018       6,699,232  54% of everything

        FLOPs of an update                      is      everything  why
        s_t, torso                   4,756,340,736   4,938,792,960  256 rows forward and backward; at most, as equal states are computed once where it pays
        s_t, C51 head                   40,108,032     601,620,480  of the action taken alone: its loss reads no other
        s_{t+n}, target network      1,991,507,968   2,082,734,080  forward: what is bootstrapped; at most, as rows without a bootstrap are left out, and equal states but one
        s_{t+n}, online network                  0   2,082,734,080  not done: double_dqn = false
        more states, torso           4,756,340,736  29,632,757,760  one positive a row (run.horizon)
        states, key encoder                      0   2,318,401,536  not done: there is no key encoder
        psi and phi                  2,524,839,936  55,775,723,520  forward and backward
        scores                         201,326,592  32,883,343,360  each row with each, and their gradients
        all                         14,270,464,000 130,316,107,776  11% of everything

        FLOPs of a decision                     is      everything  why
        torso.conv1                      2,408,448       2,764,800  for 96.7% of states; in the others chance decides (epsilon)
        torso.conv2                      2,359,296       2,359,296
        torso.conv3                      1,179,648       1,179,648
        torso.fc                         1,048,576       1,048,576
        head                               783,360         783,360  Q of every action, of which the largest is taken
        all                              7,779,328       8,135,680  96% of everything

        bytes                                   is      everything  why
        a transition in a chunk             10,806          12,294  60x60x3 of a frame of 64x64x3: no convolution reads the rest; action, end and reward
        a transition in the replay          10,832          12,320  the same, and its place; stored once, however often it is read
        a batch                          8,297,472      22,025,216  256 rows that have every state; what a row does not have does not travel
          s_t and s_{t+n}                5,529,600       6,291,456  one frame each
          s_{t+k}                        2,764,800      15,728,640  1 a row: what driml-ada is served
          numbers                            3,072           5,120  returns, discounts, actions, k
        a broadcast                      3,973,556      15,233,880  torso and head, as f32: what acts has no other layer

        everything: all that the agents of the menu have, at once: five heads of DIM and a key encoder, a dueling head of noisy layers, four pairs of levels at five positives a row, augmented, double DQN, all weights broadcast as f32; frames whole, stacked and enlarged where they are made
    "#]].assert_eq(&inspection.describe());
    let json: serde_json::Value = serde_json::from_str(&inspection.json().unwrap()).unwrap();
    assert_eq!(json["bytes"][0]["what"], "a transition in a chunk");
}

/// Every agent in every kind of world, with a small network: what is said is what a learner builds and sends.
#[test]
fn what_is_counted_is_what_is_built() {
    let small = ["model.hidden=16", "model.rkhs=8", "learner.batch_size=4"];
    let smoke = PRESETS.iter().position(|it| it.name == "smoke").unwrap();
    for world in ["procgen:bigfish", "mspacman", "ising", "chain"] {
        for agent in AGENTS.iter().map(|agent| agent.name) {
            let config = config(world, agent, smoke, &small);
            let inspection = Inspection::of(&config).unwrap();
            let settings = LearnerConfig::from_toml(&config.to_toml()).unwrap();
            let mut learner = Learner::new(settings, &Compute::CPU).unwrap();
            let networks = learner.agent();
            let scalars = |parameters: &driml_model::Parameters| -> usize {
                parameters.iter().map(|(_, var)| var.elem_count()).sum()
            };
            let key = networks.key().map_or(0, scalars);
            let built = scalars(networks.online()) + scalars(networks.target()) + key;
            let said: u64 = inspection.parameters.iter().map(|line| line.is).sum();
            assert_eq!(said, built as u64, "{agent} on {world}");
            assert_eq!(find(&inspection.parameters, "key encoder").is, key as u64);

            let weights = learner.next_weights().unwrap().safetensors.len();
            assert_eq!(find(&inspection.bytes, "a broadcast").is, weights as u64);
            // Rows that have every state that a row may have.
            let header = BatchHeader::of(&config.run, config.learner.batch_size)
                .sampled_by(&config.replay.sampling);
            let row = RowScalars {
                action: 0,
                next_action: 0,
                n_step_return: 0.0,
                bootstrap_discount: 1.0,
                positives: header.positives,
                k_first: 1,
            };
            let rows = vec![row; header.rows as usize];
            let batch = Batch::of_rows(header, &rows, Buffer::zeroed);
            let states = [batch.states_t(), batch.states_n(), batch.states_k()];
            let states = states.map(|states| states.len());
            let (_, payload) = batch.into_payload();
            let said = |what| find(&inspection.bytes, what).is as usize;
            assert_eq!(said("a batch"), payload.len());
            let said_states = [said("s_t and s_{t+n}"), said("s_{t+k}")];
            match header.stacked {
                None => assert_eq!(said_states, [states[0] + states[1], states[2]]),
                Some(stacked) => {
                    // Four bytes say which frame each of a state is.
                    let frames = stacked.frames as usize * config.run.frame_bytes();
                    let stacks = states.iter().sum::<usize>() / config.run.frame_bytes() * 4;
                    assert_eq!(said_states.iter().sum::<usize>(), frames + stacks);
                }
            }
            for line in inspection.parameters.iter().chain(&inspection.bytes) {
                assert!(line.is <= line.everything, "{agent} on {world}: {line:?}");
                let is_absent = line.why.starts_with("not ");
                assert_eq!(
                    line.is == 0,
                    is_absent || line.why.starts_with("0 "),
                    "{line:?}"
                );
            }
        }
    }
}

#[test]
fn a_world_that_needs_nothing_is_played() {
    let smoke = PRESETS.iter().position(|it| it.name == "smoke").unwrap();
    let config = config("chain", "driml-ada", smoke, &["replay.transitions_max=600"]);
    let shares = Inspection::play(&config).unwrap();
    // Whole chunks of 32 frames; at a ratio of 1 as many rows as the 600 have after the warm-up, in whole batches of 16.
    assert_eq!((shares.frames, shares.rows), (608, 400));
    // Episodes are a few steps long, and the corridor has eight frames.
    assert!(shares.without_bootstrap > 0.2 && shares.without_positive > 0.02);
    assert!(shares.absent_bytes > 0.05 && shares.absent_bytes < 0.5);
    assert!(shares.repeated_online > 0.5 && shares.repeated_target > 0.0);
    let played = [(config, Some(shares))];
    let data = worlds::csv(&played).unwrap();
    let mut reader = csv::Reader::from_reader(data.as_bytes());
    let rows: Vec<csv::StringRecord> = reader.records().collect::<Result<_, _>>().unwrap();
    assert_eq!(rows.len(), 1);
    assert_eq!(
        (&rows[0][0], &rows[0][1], &rows[0][5]),
        ("chain", "12", "150")
    );
    assert_eq!(&rows[0][19], "400");
    let text = worlds::markdown(&played).unwrap();
    assert_eq!(text.lines().count(), 3);
    assert!(text.contains("| chain | 12x12 | 150 | "), "{text}");
}

#[test]
fn no_agent_has_more_than_everything() {
    for agent in AGENTS.iter().map(|agent| agent.name) {
        let sets: &[&str] = if agent == "c51" {
            &["learner.update.double_dqn=true"]
        } else {
            &[]
        };
        let inspection = Inspection::of(&config("procgen:bigfish", agent, 0, sets)).unwrap();
        for line in inspection
            .update_flops
            .iter()
            .chain(&inspection.decision_flops)
        {
            assert!(line.is <= line.everything, "{agent}: {line:?}");
        }
    }
}
