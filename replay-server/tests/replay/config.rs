//! Settings that cannot work are refused, by key, with what to do.
//! It does not test the effects of settings.

use driml_protocol::{Horizon, RunSpec, Sampling};
use driml_replay_server::{Compression, Config, ConfigError, Replay};

use crate::history::spec;

fn good() -> Config {
    Config {
        capacity_transitions: 10_000,
        shards: 1,
        compression: Compression::None,
        compressed_bytes_max: None,
        sampling: Sampling::Uniform,
        disk_bytes_max: None,
        fsync_ms: None,
        since: None,
        reproduced_bug: None,
        replay_ratio: 8.0,
        warmup_transitions: 1000,
        slack_transitions: 32,
        transitions_max: Some(1032),
    }
}

fn refusal(config: &Config, spec: &RunSpec, batch_size: u32) -> String {
    Replay::new(spec, config, batch_size)
        .map(|_| ())
        .unwrap_err()
        .to_string()
}

#[test]
fn each_fault_names_its_key_and_a_way_out() {
    let spec = spec(3, 4, 7, Horizon::Nhg { k_max: 5 });
    assert!(Replay::new(&spec, &good(), 256).is_ok());
    let cases = [
        (
            Config {
                replay_ratio: 0.0,
                ..good()
            },
            "replay_ratio = 0",
        ),
        (
            Config {
                replay_ratio: f64::NAN,
                ..good()
            },
            "replay_ratio = NaN",
        ),
        (
            Config {
                replay_ratio: f64::INFINITY,
                ..good()
            },
            "replay_ratio = inf",
        ),
        (
            Config {
                capacity_transitions: 10,
                ..good()
            },
            "spans 11 transitions",
        ),
        (
            Config {
                capacity_transitions: u64::MAX,
                ..good()
            },
            "hold fewer",
        ),
        (
            Config {
                capacity_transitions: 1 << 57,
                ..good()
            },
            "hold fewer",
        ),
        (
            Config {
                compressed_bytes_max: Some(1 << 30),
                ..good()
            },
            "nothing is compressed",
        ),
        (
            Config {
                compression: Compression::Lz4,
                compressed_bytes_max: Some(1 << 20),
                ..good()
            },
            "use at least 3146124",
        ),
        (
            Config {
                warmup_transitions: 10_001,
                ..good()
            },
            "at most capacity_transitions = 10000",
        ),
        (
            Config {
                slack_transitions: 31,
                ..good()
            },
            "256 / 8 = 32",
        ),
        (
            Config {
                transitions_max: Some(1031),
                ..good()
            },
            "= 1032",
        ),
    ];
    for (config, expected) in cases {
        let text = refusal(&config, &spec, 256);
        assert!(
            text.starts_with("replay.") && text.contains(expected),
            "{text}"
        );
    }
    assert!(refusal(&good(), &spec, 0).contains("learner.batch_size = 0"));
    assert!(refusal(&good(), &spec, u32::MAX).contains("a batch of this run has 1 to"));
    let broken = RunSpec { gamma: 2.0, ..spec };
    assert!(matches!(
        Replay::new(&broken, &good(), 256),
        Err(ConfigError::RunSpec(_))
    ));
}

#[test]
fn unknown_and_missing_keys_are_refused() {
    let text = "capacity_transitions = 10\nshards = 1\nreplay_ratio = 8\nwarmup_transitions = 1\nslack_transitions = 2\n";
    assert_eq!(
        toml::from_str::<Config>(text).unwrap().transitions_max,
        None
    );
    assert!(toml::from_str::<Config>(&format!("{text}slack = 3\n")).is_err());
    assert!(toml::from_str::<Config>(&text.replace("warmup_transitions = 1\n", "")).is_err());
}
