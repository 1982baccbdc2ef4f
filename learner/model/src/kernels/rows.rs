//! Rows of a tensor, each as often as listed, as a candle operation whose gradient is summed in a fixed order.
//! It knows no network; it runs on the CPU only.
//!
//! candle's own selection adds its gradient on a single thread.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::kernels::tensors::{floats, values_of};

/// Rows that one task takes.
const TASK_ROWS: usize = 16;

/// The rows `rows` [n] of `x` [R, ..] f32, as [n, ..].
///
/// The gradient of a row of `x` is the sum of those of its copies, first to last: the same bits whatever the number of threads.
pub(crate) fn select_rows(x: &Tensor, rows: &[u32]) -> Result<Tensor> {
    let count = x.dims().first().copied().unwrap_or(0);
    if let Some(row) = rows.iter().find(|&&row| row as usize >= count) {
        bail!("row {row} of {:?}", x.shape());
    }
    let rows = rows.to_vec();
    x.contiguous()?.apply_op1(Select { rows })
}

struct Select {
    rows: Vec<u32>,
}

impl Select {
    /// Where the copies of each of `count` rows are: those of row r are `copies[starts[r]..starts[r + 1]]`, ascending.
    fn copies(&self, count: usize) -> (Vec<usize>, Vec<u32>) {
        let mut starts = vec![0; count + 1];
        for &row in &self.rows {
            starts[row as usize + 1] += 1;
        }
        for row in 0..count {
            starts[row + 1] += starts[row];
        }
        let (mut next, mut copies) = (starts.clone(), vec![0; self.rows.len()]);
        for (copy, &row) in (0..).zip(&self.rows) {
            copies[next[row as usize]] = copy;
            next[row as usize] += 1;
        }
        (starts, copies)
    }
}

impl CustomOp1 for Select {
    fn name(&self) -> &'static str {
        "select-rows"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let mut dims = layout.dims().to_vec();
        let len: usize = dims[1..].iter().product();
        dims[0] = self.rows.len();
        let x = floats(x, layout)?;
        let mut selected = vec![0.0; self.rows.len() * len];
        selected
            .par_chunks_mut(len.max(1))
            .zip(&self.rows)
            .with_min_len(TASK_ROWS)
            .for_each(|(to, &row)| to.copy_from_slice(&x[row as usize * len..][..len]));
        Ok((CpuStorage::F32(selected), dims.into()))
    }

    fn bwd(&self, x: &Tensor, _selected: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let grad = grad.detach().contiguous()?;
        let grad = values_of(&grad)?;
        let count = x.dim(0)?;
        let len = x.elem_count() / count;
        let (starts, copies) = self.copies(count);
        let mut sums = vec![0.0; x.elem_count()];
        let sum_row = |(row, sum): (usize, &mut [f32])| {
            let mut copies = copies[starts[row]..starts[row + 1]]
                .iter()
                .map(|&copy| &grad[copy as usize * len..][..len]);
            if let Some(first) = copies.next() {
                sum.copy_from_slice(first);
            }
            for copy in copies {
                for (sum, value) in sum.iter_mut().zip(copy) {
                    *sum += value;
                }
            }
        };
        sums.par_chunks_mut(len.max(1))
            .enumerate()
            .with_min_len(TASK_ROWS)
            .for_each(sum_row);
        Tensor::from_vec(sums, x.shape(), x.device()).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    #[test]
    fn rows_are_copied_and_their_gradients_summed() -> Result<()> {
        let values: Vec<f32> = (0..24u8).map(f32::from).collect();
        let x = Var::from_vec(values.clone(), (4, 2, 3), &Device::Cpu)?;
        // Row 2 is not listed, row 1 three times.
        let rows = [1, 0, 1, 3, 1];
        let selected = select_rows(&x, &rows)?;
        assert_eq!(selected.dims(), [5, 2, 3]);
        let wanted = rows.map(|row| &values[row as usize * 6..][..6]).concat();
        assert_eq!(selected.flatten_all()?.to_vec1::<f32>()?, wanted);

        let slope: Vec<f32> = (0..30u8).map(|i| f32::from(i) + 0.5).collect();
        let slopes = Tensor::from_vec(slope.clone(), (5, 2, 3), &Device::Cpu)?;
        let gradient = (selected * slopes)?.sum_all()?.backward()?;
        let gradient = gradient.get(&x).unwrap().flatten_all()?.to_vec1::<f32>()?;
        let mut wanted = vec![0.0; 24];
        for (copy, row) in rows.into_iter().enumerate() {
            for at in 0..6 {
                wanted[row as usize * 6 + at] += slope[copy * 6 + at];
            }
        }
        assert_eq!(gradient, wanted);
        Ok(())
    }

    #[test]
    fn a_row_that_is_not_there_is_refused() -> Result<()> {
        let x = Tensor::zeros((2, 3), candle_core::DType::F32, &Device::Cpu)?;
        assert!(select_rows(&x, &[0, 1]).is_ok());
        assert!(select_rows(&x, &[2]).is_err());
        Ok(())
    }
}
