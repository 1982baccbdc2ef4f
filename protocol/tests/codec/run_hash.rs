//! The hash by which processes of one run recognize each other.
//! `damaged` tests that messages with another hash are rejected.

use std::collections::HashSet;

use driml_protocol::{Horizon, RunSpec, TimeoutRule};

/// A change of any field changes the hash.
#[test]
fn the_hash_knows_every_field() {
    let spec = RunSpec {
        world: "procgen/bigfish".into(),
        agent: "driml-ada".into(),
        seed: 1,
        frame_height: 64,
        frame_width: 64,
        frame_channels: 3,
        frame_stack: 1,
        num_actions: 15,
        n_step: 7,
        gamma: 0.99,
        horizon: Horizon::Nhg { k_max: 5 },
        timeout: TimeoutRule::Terminal,
    };
    let changes: [fn(&mut RunSpec); 16] = [
        |it| it.world = "procgen/maze".into(),
        |it| it.agent = "c51".into(),
        |it| it.seed = 2,
        |it| it.frame_height = 32,
        |it| it.frame_width = 32,
        |it| it.frame_channels = 1,
        |it| it.frame_stack = 4,
        |it| it.num_actions = 14,
        |it| it.n_step = 1,
        |it| it.gamma = 0.9,
        |it| it.horizon = Horizon::Nhg { k_max: 4 },
        |it| it.horizon = Horizon::Uniform { k_max: 5 },
        |it| it.horizon = Horizon::Fixed { k: 5 },
        |it| it.horizon = Horizon::All { k_max: 5 },
        |it| it.horizon = Horizon::None {},
        |it| it.timeout = TimeoutRule::Bootstrap,
    ];
    let changed = changes.iter().map(|change| {
        let mut other = spec.clone();
        change(&mut other);
        other.hash()
    });
    let hashes: HashSet<u64> = changed.chain([spec.hash()]).collect();
    assert_eq!(hashes.len(), changes.len() + 1);
    assert_eq!(spec.hash(), spec.clone().hash());
    // Checkpoints contain this hash: with another one, they could not be resumed.
    assert_eq!(format!("{:016x}", spec.hash()), "0c6c6069564f3984");
}
