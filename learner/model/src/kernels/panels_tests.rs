//! Tests of `panels`.

use half::bf16;

use super::*;
use crate::kernels::isa::{AnySimd, with_simd};
use crate::kernels::precision::Precision;

/// All scalars of `rows`, row by row.
fn scalars<E: Element>(rows: &Rows<'_, E>, m: usize) -> Vec<f32> {
    let scalar = |row: usize, at: usize| {
        let left = rows.left(row);
        left.values[left.start + at / E::DEPTH * left.step + at % E::DEPTH].value()
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
        let turned: Vec<f32> = (0..m * k).map(|at| value(at % m, at / m)).collect();
        for simd in Precision::ALL.into_iter().flat_map(AnySimd::every) {
            for threads in [Threads::Caller, Threads::Pool] {
                // Memory with old content, so that missing zeros are noticed.
                Buffer::<bf16>::new(m * (k + 64)).fill(bf16::NAN);
                with_simd!(simd, simd => {
                    let wanted = Rows::pack(simd, Matrix::new(&dense, m, k), threads);
                    let turned = Matrix::new(&turned, k, m).transposed();
                    let turned = Rows::pack(simd, turned, threads);
                    assert_eq!(scalars(&turned, m), scalars(&wanted, m), "{m}x{k}");
                });
            }
        }
    }
}
