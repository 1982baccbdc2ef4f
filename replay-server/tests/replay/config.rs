//! Settings that cannot work are refused, by key, with what to do.

use driml_protocol::{Horizon, RunSpec};
use driml_replay_server::{Compression, Config, ConfigError, Replay};

use crate::history::{spec, unlimited};

fn good() -> Config {
    Config {
        replay_ratio: 8.0,
        warmup_transitions: 1000,
        slack_transitions: 32,
        transitions_max: Some(1032),
        ..unlimited(10_000)
    }
}

fn refusal(config: &Config, spec: &RunSpec, batch_size: u32) -> String {
    let refused = Replay::new(spec, config, batch_size).map(drop);
    refused.unwrap_err().to_string()
}

#[test]
fn each_fault_names_its_key_and_a_way_out() {
    let spec = spec(3, 4, 7, Horizon::Nhg { k_max: 5 });
    assert!(Replay::new(&spec, &good(), 256).is_ok());
    type Spoil = fn(&mut Config);
    let cases: [(Spoil, &str); 11] = [
        (|it| it.replay_ratio = 0.0, "replay_ratio = 0"),
        (|it| it.replay_ratio = f64::NAN, "replay_ratio = NaN"),
        (|it| it.replay_ratio = f64::INFINITY, "replay_ratio = inf"),
        (|it| it.capacity_transitions = 10, "spans 11 transitions"),
        (|it| it.capacity_transitions = u64::MAX, "hold fewer"),
        (|it| it.capacity_transitions = 1 << 57, "hold fewer"),
        (
            |it| it.compressed_bytes_max = Some(1 << 30),
            "nothing is compressed",
        ),
        (
            |it| (it.compression, it.compressed_bytes_max) = (Compression::Lz4, Some(1 << 20)),
            "use at least 3146124",
        ),
        (
            |it| it.warmup_transitions = 10_001,
            "at most capacity_transitions = 10000",
        ),
        (|it| it.slack_transitions = 31, "256 / 8 = 32"),
        (|it| it.transitions_max = Some(1031), "= 1032"),
    ];
    for (spoil, expected) in cases {
        let mut config = good();
        spoil(&mut config);
        let text = refusal(&config, &spec, 256);
        assert!(text.starts_with("replay."), "{text}");
        assert!(text.contains(expected), "{text}");
    }
    assert!(refusal(&good(), &spec, 0).contains("learner.batch_size = 0"));
    assert!(refusal(&good(), &spec, u32::MAX).contains("a batch of this run has 1 to"));
    let broken = RunSpec { gamma: 2.0, ..spec };
    let refused = good().validate(&broken, 256).unwrap_err();
    assert!(matches!(refused, ConfigError::RunSpec(_)), "{refused}");
}

#[test]
fn unknown_and_missing_keys_are_refused() {
    let text = "capacity_transitions = 10\nshards = 1\nreplay_ratio = 8\nwarmup_transitions = 1\nslack_transitions = 2\n";
    let read = |text: &str| toml::from_str::<Config>(text);
    assert_eq!(read(text).unwrap().transitions_max, None);
    assert!(read(&format!("{text}slack = 3\n")).is_err());
    assert!(read(&text.replace("warmup_transitions = 1\n", "")).is_err());
}
