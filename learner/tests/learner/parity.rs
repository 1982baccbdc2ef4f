//! Compares the project's update with updates computed elsewhere in float64, and tests the check with broken files.
//! It makes no cases.

use std::{fs, path::PathBuf};

use driml_learner::{
    Compute, Precision,
    parity::{ParityReport, check_file},
};

use crate::synthetic::CANDLE;

fn cases() -> Vec<PathBuf> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/parity");
    let entries = fs::read_dir(&folder).unwrap_or_else(|why| panic!("{}: {why}", folder.display()));
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|it| it == "safetensors"));
    files.sort();
    files
}

fn check_all(compute: &Compute) -> Vec<ParityReport> {
    let check = |file: &PathBuf| check_file(file, compute).unwrap();
    let reports: Vec<_> = cases().iter().map(check).collect();
    assert!(reports.len() >= 10, "the open cases are in tests/parity");
    for report in &reports {
        assert!(report.passed(), "{compute:?}: {report}");
    }
    reports
}

#[test]
fn every_open_case_is_within_tolerance() {
    check_all(&Compute::CPU);
}

/// These are the operations of a GPU in the same order, computed on the CPU.
#[test]
fn so_it_is_with_candle_s_own_operations() {
    check_all(&CANDLE);
}

/// bf16 has its own tolerances. It would fail those of f32, so the difference matters.
#[test]
fn so_it_is_in_bf16() {
    let report = check_all(&Compute::cpu(Precision::Bf16)).swap_remove(0);
    let farther = report.lines.iter().filter(|line| line.error > 2e-5).count();
    assert!(farther > 5, "products were not rounded: {report}");
}

/// Bytes of a case, bytes of the same length to put in their place, and words of the error.
const BROKEN: &str = r#"
"config" => "confix" => config
\"atoms\": 51 => \"atoms\": -1 => config
\"atoms\": 51 => \"atoms\": 50 => head
\"atoms\": 51 => \"atoms\":  0 => atoms
\"tanh_clip\": 20.0 => \"tanh_clip\":  0.0 => tanh_clip
input.action => input.axtion => input.action
online.head.bias => online.bead.bias => head.bias
target.head.bias => target.bead.bias => head.bias
expect.grad.head.bias => expect.grad.bead.bias => head.bias
expect.loss.total => expect.loss.totle => expect.loss.total
"#;

#[test]
fn a_broken_file_is_a_clear_error() {
    let folder = tempfile::tempdir().unwrap();
    let whole = fs::read(&cases()[0]).unwrap();
    let error_of = |bytes: &[u8]| {
        let file = folder.path().join("broken.safetensors");
        fs::write(&file, bytes).unwrap();
        let error = check_file(&file, &Compute::CPU).expect_err("broken");
        let error = format!("{error:#}");
        assert!(error.contains("broken.safetensors"), "{error}");
        error
    };
    for length in [0, 5, 8, 1000, whole.len() / 2, whole.len() - 1] {
        let error = error_of(&whole[..length]);
        assert!(error.contains("not a whole safetensors file"), "{error}");
    }
    for line in BROKEN.trim().lines() {
        let [from, to, said] = line.split(" => ").collect::<Vec<_>>()[..] else {
            panic!("{line}")
        };
        let mut windows = whole.windows(from.len());
        let at = windows.position(|it| it == from.as_bytes()).unwrap();
        let mut broken = whole.clone();
        broken[at..at + to.len()].copy_from_slice(to.as_bytes());
        let error = error_of(&broken);
        assert!(error.contains(said), "{line}: {error}");
    }
}
