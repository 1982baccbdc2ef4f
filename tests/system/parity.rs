//! `driml parity` on updates computed elsewhere in float64; `deploy/docs/src/reference/parity.md` describes the files.
//! The learner's own tests check the comparison of each tensor.

use std::fs;

use crate::{repo_rules::root, system};

/// A case, and the tensor that the test changes.
const CHANGED: [(&str, &str); 5] = [
    ("all_four", "expect.loss.total"),
    ("all_four", "expect.target_projection"),
    ("all_four", "expect.grad_norm"),
    ("all_four", "expect.updated.head.weight"),
    ("curl", "expect.updated_key.dim.psi4.out.weight"),
];

#[test]
fn a_case_with_another_expectation_fails() {
    let system = system();
    let folder = root().join("tests/parity");
    let mut call = format!("parity {}", folder.join("curl.safetensors").display());
    for (case, tensor) in CHANGED {
        let mut bytes = fs::read(folder.join(format!("{case}.safetensors"))).unwrap();
        change(&mut bytes, tensor);
        fs::write(system.path(tensor), bytes).unwrap();
        call += &format!(" {tensor}");
    }
    let ended = system.fails(&call, "error: files out of tolerance: 5 of 6");
    fs::write(system.path("cut"), "cut").unwrap();
    system.rejects("parity cut", "error: cut: not a whole safetensors file");
    let absent = "error: cannot read none: No such file or directory (os error 2)\n";
    system.rejects("parity none", absent);
    let stdout = &ended.stdout;
    let failed: Vec<_> = stdout.lines().filter(|it| it.ends_with("FAILED")).collect();
    assert_eq!(failed.len(), CHANGED.len(), "{stdout}");
    for ((_, tensor), line) in CHANGED.iter().zip(failed) {
        let name = tensor.trim_start_matches("expect.");
        assert!(line.contains(name), "{tensor}: {line}\n{stdout}");
    }
}

/// Sets the first number of a tensor of a safetensors file to 1000.
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
