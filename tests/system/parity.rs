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
    let whole = root().join("tests/parity/curl.safetensors");
    let mut call = format!("parity {}", whole.display());
    for (case, tensor) in CHANGED {
        fs::write(system.path(tensor), changed(case, tensor)).unwrap();
        call += &format!(" {tensor}");
    }
    let ended = system.fails(&call, "error: files out of tolerance: 5 of 6");
    // A sound case whose update overflows is not a wrong call.
    let overflow = changed("all_four", "target.torso.conv1.weight");
    fs::write(system.path("overflow"), overflow).unwrap();
    system.fails("parity overflow", "is not finite");
    fs::write(system.path("cut"), "cut").unwrap();
    system.rejects("parity cut", "error: cut: not a whole safetensors file");
    let absent = "error: cannot read none: No such file or directory (os error 2)\n";
    system.rejects("parity none", absent);
    let lines = ended.stdout.lines();
    let failed: Vec<_> = lines.filter(|it| it.ends_with("FAILED")).collect();
    assert_eq!(failed.len(), CHANGED.len(), "{failed:?}");
    for ((_, tensor), line) in CHANGED.iter().zip(failed) {
        let name = tensor.trim_start_matches("expect.");
        assert!(line.contains(name), "{tensor}: {line}");
    }
}

/// Returns a case with all numbers of a tensor changed: an expectation is then wrong, and a parameter overflows.
fn changed(case: &str, tensor: &str) -> Vec<u8> {
    let mut file = fs::read(root().join(format!("tests/parity/{case}.safetensors"))).unwrap();
    let start = 8 + u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&file[8..start]).unwrap();
    let offset = |end: usize| header[tensor]["data_offsets"][end].as_u64().unwrap() as usize;
    let number = match header[tensor]["dtype"].as_str().unwrap() {
        "F32" => f32::MAX.to_le_bytes().to_vec(),
        "F64" => 1000f64.to_le_bytes().to_vec(),
        other => panic!("{tensor} has type {other}"),
    };
    let numbers = &mut file[start + offset(0)..start + offset(1)];
    numbers.copy_from_slice(&number.repeat(numbers.len() / number.len()));
    file
}
