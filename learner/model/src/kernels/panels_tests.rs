//! Tests of `panels`.

use half::bf16;

use super::*;
use crate::kernels::isa::{AnySimd, with_simd};
use crate::kernels::precision::Precision;

/// All scalars of `rows`, row by row.
fn scalars<E: Element>(rows: &PackedRows<'_, E>, m: usize) -> Vec<f32> {
    let scalar = |row: usize, at: usize| {
        let left = rows.operand_from(row);
        left.values[left.start + at / E::DEPTH * left.step_stride + at % E::DEPTH].value()
    };
    let k = rows.steps * E::DEPTH;
    (0..m * k).map(|at| scalar(at / k, at % k)).collect()
}

/// Covers rows that are longer than what one task rounds, too.
#[test]
fn every_instruction_set_packs_the_rows_of_a_transposed_matrix() {
    for (m, k) in [(1, 1), (16, 32), (37, 75), (3, TASK_LEN + 1)] {
        let value = |row: usize, at: usize| (row * k + at) as f32 % 251.0;
        let dense: Vec<f32> = (0..m * k).map(|at| value(at / k, at % k)).collect();
        let transposed: Vec<f32> = (0..m * k).map(|at| value(at % m, at / m)).collect();
        for simd in Precision::ALL.into_iter().flat_map(AnySimd::all_available) {
            for threads in [Threads::Caller, Threads::Pool] {
                // Memory with old content, so that missing zeros are noticed.
                Buffer::<bf16>::new(m * (k + 64)).fill(bf16::NAN);
                with_simd!(simd, simd => {
                    let wanted = PackedRows::pack(simd, Matrix::new(&dense, m, k), threads);
                    let transposed = Matrix::new(&transposed, k, m).transposed();
                    let transposed = PackedRows::pack(simd, transposed, threads);
                    assert_eq!(scalars(&transposed, m), scalars(&wanted, m), "{m}x{k}");
                });
            }
        }
    }
}
