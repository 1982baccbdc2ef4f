//! `driml parity` on updates computed elsewhere in float64; `deploy/docs/src/reference/parity.md` says what the files hold.
//! How each tensor compares is the learner's own test.

use std::{fs, path::Path};

use crate::system;

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
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("parity");
        let good = folder.join(format!("{case}.safetensors"));
        let mut bytes = fs::read(&good).unwrap();
        change(&mut bytes, tensor);
        fs::write(system.path("changed.safetensors"), bytes).unwrap();
        let good = good.display();
        let ended = system
            .run(&format!("parity changed.safetensors {good}"))
            .expect_code(1)
            .expect_said("error: 1 of 2 files are out of tolerance");
        let is_failed = |line: &&str| line.ends_with("FAILED");
        let failed: Vec<_> = ended.stdout.lines().filter(is_failed).collect();
        let name = tensor.trim_start_matches("expect.");
        assert!(
            failed.len() == 1 && failed[0].contains(name),
            "{tensor}: {failed:?}\n{}",
            ended.stdout
        );
        let is_ok = |line: &str| !line.starts_with("  ") || line.ends_with("  ok");
        let (_, unchanged) = ended.stdout.split_once(&format!("{good}\n")).unwrap();
        assert!(unchanged.lines().all(is_ok), "{unchanged}");
    }
}

/// Makes the first number of a tensor of a safetensors file 1000.
fn change(file: &mut [u8], tensor: &str) {
    let header_len = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&file[8..8 + header_len]).unwrap();
    let start = header[tensor]["data_offsets"][0].as_u64().unwrap() as usize + 8 + header_len;
    let number = match header[tensor]["dtype"].as_str().unwrap() {
        "F32" => 1000f32.to_le_bytes().to_vec(),
        "F64" => 1000f64.to_le_bytes().to_vec(),
        other => panic!("{tensor} has type {other}"),
    };
    file[start..start + number.len()].copy_from_slice(&number);
}
