//! The project's update against updates computed elsewhere in float64, and the check against broken files.
//! It makes no cases of its own; `learner` does.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::{fs, path::PathBuf};

use driml_learner::{
    Compute, Kernels, Precision,
    parity::{ParityReport, check_file},
};

fn cases() -> Vec<PathBuf> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/parity");
    let entries = fs::read_dir(&folder).unwrap_or_else(|why| panic!("{}: {why}", folder.display()));
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| {
        path.extension()
            .is_some_and(|extension| extension == "safetensors")
    });
    files.sort();
    files
}

fn all_within_tolerance(compute: &Compute) {
    let reports: Vec<ParityReport> = cases()
        .iter()
        .map(|file| check_file(file, compute).unwrap())
        .collect();
    assert!(reports.len() >= 10, "the open cases are in tests/parity");
    for report in &reports {
        println!("{report}");
    }
    let failed = reports.iter().filter(|report| !report.passed()).count();
    assert_eq!(failed, 0, "of {} cases; see the lines above", reports.len());
}

#[test]
fn every_open_case_is_within_tolerance() {
    all_within_tolerance(&Compute::CPU);
}

/// With the tolerances of bf16, which are its own; in f32's it fails, so that they are no formality.
#[test]
fn so_it_is_in_bf16() {
    let bf16 = Compute::cpu(Precision::Bf16);
    all_within_tolerance(&bf16);
    let report = check_file(&cases()[0], &bf16).unwrap();
    let f32 = check_file(&cases()[0], &Compute::CPU).unwrap();
    for (bf16, f32) in report.lines.iter().zip(&f32.lines) {
        assert!(bf16.name != f32.name || bf16.tolerance >= f32.tolerance);
    }
    let farther = report.lines.iter().filter(|line| line.error > 2e-5).count();
    assert!(farther > 5, "products were not rounded: {report}");
}

/// What a GPU is given to compute, on the CPU: the same operations in the same order.
#[test]
fn so_it_is_with_candle_s_own_operations() {
    all_within_tolerance(&Compute {
        kernels: Kernels::Candle,
        ..Compute::CPU
    });
}

/// Rewrites the header of a case: its length, its text, and the data untouched.
fn with_header(bytes: &[u8], change: impl Fn(String) -> String) -> Vec<u8> {
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header = change(String::from_utf8(bytes[8..8 + length].to_vec()).unwrap());
    let mut out = (header.len() as u64).to_le_bytes().to_vec();
    out.extend(header.as_bytes());
    out.extend(&bytes[8 + length..]);
    out
}

#[test]
fn a_broken_file_is_a_clear_error() {
    let folder = std::env::temp_dir().join(format!("driml-parity-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    let whole = fs::read(&cases()[0]).unwrap();
    let says = |bytes: &[u8]| {
        let file = folder.join("broken.safetensors");
        fs::write(&file, bytes).unwrap();
        let error = check_file(&file, &Compute::CPU)
            .expect_err("broken")
            .to_string();
        assert!(error.contains("broken.safetensors"), "{error}");
        error
    };
    for length in [0, 5, 8, 1000, whole.len() / 2, whole.len() - 1] {
        assert!(
            says(&whole[..length]).contains("not a whole safetensors file"),
            "{length} bytes"
        );
    }
    let renamed = |from: &str, to: &str| with_header(&whole, |header| header.replace(from, to));
    for (from, to, said) in [
        ("\"config\"", "\"config_\"", "config"),
        ("\\\"atoms\\\": 51", "\\\"atoms\\\": -1", "config"),
        ("\\\"atoms\\\": 51", "\\\"atoms\\\": 50", "head"),
        ("\\\"atoms\\\": 51", "\\\"atoms\\\": 0", ""),
        (
            "\\\"tanh_clip\\\": 20.0",
            "\\\"tanh_clip\\\": 0.0",
            "tanh_clip",
        ),
        ("\"input.action\"", "\"input.axtion\"", "input.action"),
        ("\"online.head.bias\"", "\"online.bead.bias\"", "head.bias"),
        ("\"target.head.bias\"", "\"target.bead.bias\"", "head.bias"),
        (
            "\"expect.grad.head.bias\"",
            "\"expect.grad.bead.bias\"",
            "head.bias",
        ),
        (
            "\"expect.loss.total\"",
            "\"expect.loss.totle\"",
            "expect.loss.total",
        ),
    ] {
        let error = says(&renamed(from, to));
        assert!(error.contains(said), "{from} as {to}: {error}");
    }
    fs::remove_dir_all(&folder).unwrap();
    assert!(check_file(folder.join("none.safetensors"), &Compute::CPU).is_err());
}
