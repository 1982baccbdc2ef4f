//! The hash by which parts of one run know one another.
//! Messages that carry another are refused in `damaged`.

use driml_protocol::{Horizon, RunSpec, TimeoutRule};

/// Any change of a field, and of the protocol version, makes another run.
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
    let base = || spec.clone();
    let others = [
        RunSpec {
            world: "procgen/maze".into(),
            ..base()
        },
        RunSpec {
            agent: "c51".into(),
            ..base()
        },
        RunSpec { seed: 2, ..base() },
        RunSpec {
            frame_height: 32,
            ..base()
        },
        RunSpec {
            frame_width: 32,
            ..base()
        },
        RunSpec {
            frame_channels: 1,
            ..base()
        },
        RunSpec {
            frame_stack: 4,
            ..base()
        },
        RunSpec {
            num_actions: 14,
            ..base()
        },
        RunSpec {
            n_step: 1,
            ..base()
        },
        RunSpec {
            gamma: 0.9,
            ..base()
        },
        RunSpec {
            horizon: Horizon::Nhg { k_max: 4 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::Uniform { k_max: 5 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::Fixed { k: 5 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::All { k_max: 5 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::None,
            ..base()
        },
        RunSpec {
            timeout: TimeoutRule::Bootstrap,
            ..base()
        },
    ];
    let mut hashes: Vec<u64> = others.iter().map(RunSpec::hash).collect();
    hashes.push(spec.hash());
    assert_eq!(spec.hash(), base().hash());
    // Checkpoints hold it: with another hash they could not be resumed.
    assert_eq!(format!("{:016x}", spec.hash()), "0c6c6069564f3984");
    hashes.sort_unstable();
    hashes.dedup();
    assert_eq!(hashes.len(), others.len() + 1);
}
