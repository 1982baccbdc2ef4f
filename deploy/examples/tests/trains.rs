//! The example's program trains in its own world, with its own loss, in processes as well as in lockstep.

#![allow(clippy::unwrap_used)]

use std::{fs, path::Path, process::Command};

/// Runs the program in `folder`; gives stdout.
fn run(folder: &Path, args: &str) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_driml-with-island"))
        .args(args.split(' '))
        .current_dir(folder)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

fn summary(folder: &Path) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(folder.join("summary.json")).unwrap()).unwrap()
}

#[test]
fn the_world_and_the_loss_train_as_built_in_ones_do() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let flags =
        "--env island --agent predictive --preset smoke --frames 1280 --set replay.replay_ratio=8";
    run(folder, &format!("local {flags} --actors 2 --run-dir run"));
    let trained = summary(&folder.join("run"));
    assert_eq!(trained["updates"], 540, "{trained}");
    assert!(trained["episodes"].as_u64().unwrap() > 10, "{trained}");
    let metrics = fs::read_to_string(folder.join("run/metrics.csv")).unwrap();
    let mut rows = metrics
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>());
    let column = rows.next().unwrap();
    let column = column
        .iter()
        .position(|&name| name == "prediction")
        .unwrap();
    let last: f64 = rows.next_back().unwrap()[column].parse().unwrap();
    assert!(last.is_finite() && last >= 0.0, "{last}");

    // The settings hold all that another run needs.
    for (name, args) in [("first", flags), ("again", "--config first/config.toml")] {
        run(folder, &format!("local --lockstep {args} --run-dir {name}"));
    }
    let hash = |name: &str| summary(&folder.join(name))["weights_sha256"].clone();
    assert_eq!(hash("first"), hash("again"));
    let said = run(folder, "evaluate --run run --episodes 4");
    assert!(said.starts_with("island as trained on"), "{said}");
    let menu = run(folder, "presets");
    assert!(
        menu.contains("predictive") && menu.contains("island"),
        "{menu}"
    );
}
