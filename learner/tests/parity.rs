//! Compares the project's update with updates computed elsewhere in float64, and tests the check with broken files.
//! It makes no cases.

#![allow(clippy::unwrap_used)]

use std::{fs, path::PathBuf};

use driml_learner::{
    Compute, Precision,
    parity::{ParityReport, check_file, deviation::REFERENCE},
};

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
    check_all(&REFERENCE);
}

/// bf16 has its own tolerances. It would fail those of f32, so the difference matters.
#[test]
fn so_it_is_in_bf16() {
    let report = check_all(&Compute::cpu(Precision::Bf16)).swap_remove(0);
    let farther = report.lines.iter().filter(|line| line.error > 2e-5).count();
    assert!(farther > 5, "products were not rounded: {report}");
}

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
        assert!(
            error_of(&whole[..length]).contains("not a whole safetensors file"),
            "{length} bytes"
        );
    }
    // Each pair has the same length, so that the file stays complete.
    for (from, to, said) in [
        (r#""config""#, r#""confix""#, "config"),
        (r#"\"atoms\": 51"#, r#"\"atoms\": -1"#, "config"),
        (r#"\"atoms\": 51"#, r#"\"atoms\": 50"#, "head"),
        (r#"\"atoms\": 51"#, r#"\"atoms\":  0"#, "atoms"),
        (
            r#"\"tanh_clip\": 20.0"#,
            r#"\"tanh_clip\":  0.0"#,
            "tanh_clip",
        ),
        ("input.action", "input.axtion", "input.action"),
        ("online.head.bias", "online.bead.bias", "head.bias"),
        ("target.head.bias", "target.bead.bias", "head.bias"),
        (
            "expect.grad.head.bias",
            "expect.grad.bead.bias",
            "head.bias",
        ),
        (
            "expect.loss.total",
            "expect.loss.totle",
            "expect.loss.total",
        ),
    ] {
        let mut windows = whole.windows(from.len());
        let at = windows.position(|it| it == from.as_bytes()).unwrap();
        let mut broken = whole.clone();
        broken[at..at + to.len()].copy_from_slice(to.as_bytes());
        let error = error_of(&broken);
        assert!(error.contains(said), "{from} as {to}: {error}");
    }
    let none = folder.path().join("none.safetensors");
    assert!(check_file(none, &Compute::CPU).is_err());
}
