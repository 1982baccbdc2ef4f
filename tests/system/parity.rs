//! `driml parity` on updates computed elsewhere in float64; `parity/README.md` says what the files hold.
//! How each tensor compares is the learner's own test.

use std::{
    fs,
    path::{Path, PathBuf},
};

use crate::system;

fn cases() -> Vec<PathBuf> {
    let entries = fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("parity")).unwrap();
    let mut paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|it| it == "safetensors"));
    paths.sort();
    assert!(paths.len() >= 10, "{paths:?}");
    paths
}

#[test]
fn all_cases_are_within_tolerance() {
    let cases = cases();
    let args: Vec<_> = cases
        .iter()
        .map(|path| path.display().to_string())
        .collect();
    let ended = system()
        .run(&format!("parity {}", args.join(" ")))
        .expect_code(0);
    for path in &args {
        assert!(
            ended.stdout.lines().any(|line| line == path),
            "{path} is not in\n{}",
            ended.stdout
        );
    }
    let verdicts: Vec<_> = ended
        .stdout
        .lines()
        .filter(|line| line.starts_with("  "))
        .collect();
    assert!(
        verdicts.len() > 12 * cases.len() && verdicts.iter().all(|line| line.ends_with("  ok")),
        "{}",
        ended.stdout
    );
}

#[test]
fn a_truncated_case_is_no_case() {
    let system = system();
    let whole = fs::read(&cases()[0]).unwrap();
    fs::write(system.path("cut.safetensors"), &whole[..whole.len() - 1]).unwrap();
    system
        .run("parity cut.safetensors")
        .expect_code(1)
        .expect_said("error: cut.safetensors: not a whole safetensors file");
}

#[test]
fn a_case_with_another_expectation_fails() {
    let system = system();
    for (case, tensor) in [
        ("all_four", "expect.loss.total"),
        ("all_four", "expect.target_projection"),
        ("all_four", "expect.grad_norm"),
        ("all_four", "expect.updated.head.weight"),
        ("curl", "expect.updated_key.dim.psi4.out.weight"),
    ] {
        let mut cases = cases().into_iter();
        let good = cases.find(|path| path.file_stem().is_some_and(|it| it == case));
        let good = good.unwrap().display().to_string();
        let mut bytes = fs::read(&good).unwrap();
        change(&mut bytes, tensor);
        fs::write(system.path("changed.safetensors"), bytes).unwrap();
        let ended = system
            .run(&format!("parity changed.safetensors {good}"))
            .expect_code(1);
        let ended = ended.expect_said("error: 1 of 2 files are out of tolerance");
        let failed: Vec<_> = ended
            .stdout
            .lines()
            .filter(|line| line.ends_with("FAILED"))
            .collect();
        let name = tensor.trim_start_matches("expect.");
        assert!(
            failed.len() == 1 && failed[0].contains(name),
            "{tensor}: {failed:?}\n{}",
            ended.stdout
        );
    }
}

/// Makes x 2x + 1, for the first number x of a tensor of a safetensors file.
fn change(file: &mut [u8], tensor: &str) {
    let header_len = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&file[8..8 + header_len]).unwrap();
    let start = header[tensor]["data_offsets"][0].as_u64().unwrap() as usize + 8 + header_len;
    match header[tensor]["dtype"].as_str().unwrap() {
        "F32" => {
            let bytes = &mut file[start..start + 4];
            let value = f32::from_le_bytes(bytes.try_into().unwrap());
            bytes.copy_from_slice(&(2.0 * value + 1.0).to_le_bytes());
        }
        "F64" => {
            let bytes = &mut file[start..start + 8];
            let value = f64::from_le_bytes(bytes.try_into().unwrap());
            bytes.copy_from_slice(&(2.0 * value + 1.0).to_le_bytes());
        }
        other => panic!("{tensor} has type {other}"),
    }
}
