//! The 3 x 3 max pool of stride 2 with padding 1 over one image's maps, forward and backward.
//! This module knows neither tensors nor threads.
//!
//! The padding is never the largest. Of equal values the first in row-major order is taken, as in PyTorch.

use crate::geometry::pooled_size;
use crate::kernels::isa::{each_block, vectorized};

/// Height, width and channels of maps.
pub(crate) type Size = (usize, usize, usize);

/// Iterates over the windows of maps of this size, row by row.
#[inline(always)]
fn windows(size: Size) -> impl Iterator<Item = Window> {
    let (rows, cols, channels) = pooled_size(size);
    (0..rows).flat_map(move |y| {
        (0..cols).map(move |x| Window {
            start: (y * cols + x) * channels,
            corner: (2 * y, 2 * x),
            size,
        })
    })
}

/// A window of 3 x 3 pixels, some of which may lie outside the maps.
#[derive(Clone, Copy)]
struct Window {
    /// Index of the window's first scalar in the pooled maps.
    start: usize,
    /// Row and column of the window's first pixel, where index 0 is the padding and the maps begin at 1.
    corner: (usize, usize),
    /// The size of the maps.
    size: Size,
}

impl Window {
    /// Iterates over the pixels inside the maps: index in the window, 0 to 8, and index of the first scalar in the maps.
    #[inline(always)]
    fn pixels(self) -> impl Iterator<Item = (u32, usize)> {
        let (height, width, channels) = self.size;
        let (y, x) = self.corner;
        let inside = |first: usize, len: usize| usize::from(first == 0)..3.min(len + 1 - first);
        let cols = inside(x, width);
        inside(y, height).flat_map(move |row| {
            let line = (y + row - 1) * width;
            let each = cols.clone();
            each.map(move |col| ((row * 3 + col) as u32, (line + x + col - 1) * channels))
        })
    }
}

vectorized! {
    /// Writes the maximum of each window of `maps` into `largest`, and the index of its pixel, 0 to 8, into
    /// `argmax`. A NaN counts as the largest. Channels that do not fill half a register are processed one by one.
    pub(crate) fn pool<S>(
        simd,
        maps: &'a [f32],
        size: Size,
        largest: &'a mut [f32],
        argmax: &'a mut [u8],
    ) {
        for window in windows(size) {
            let to = window.start..window.start + size.2;
            let (largest, argmax) = (&mut largest[to.clone()], &mut argmax[to]);
            each_block!(size.2, pool_block(maps, window, largest, argmax));
        }
    }
}

/// [`pool`] of one window's channels from `first` on. Values and pixels stay in registers of the same width.
#[inline(always)]
fn pool_block<const N: usize>(
    first: usize,
    maps: &[f32],
    window: Window,
    largest: &mut [f32],
    argmax: &mut [u8],
) {
    let (mut best, mut best_at) = ([f32::NEG_INFINITY; N], [u32::MAX; N]);
    for (at, from) in window.pixels() {
        let values = &maps[from + first..][..N];
        for ((best, best_at), &value) in best.iter_mut().zip(&mut best_at).zip(values) {
            let is_larger = value > *best || value.is_nan() || *best_at == u32::MAX;
            *best = if is_larger { value } else { *best };
            *best_at = if is_larger { at } else { *best_at };
        }
    }
    largest[first..][..N].copy_from_slice(&best);
    for (argmax, at) in argmax[first..][..N].iter_mut().zip(best_at) {
        *argmax = at as u8;
    }
}

vectorized! {
    /// The backward pass of [`pool`]: adds each window's gradient, from `grads`, to the pixel of `grad_maps` with the maximum.
    pub(crate) fn unpool<S>(
        simd,
        grads: &'a [f32],
        size: Size,
        argmax: &'a [u8],
        grad_maps: &'a mut [f32],
    ) {
        for window in windows(size) {
            let from = window.start..window.start + size.2;
            let (grads, argmax) = (&grads[from.clone()], &argmax[from]);
            each_block!(size.2, unpool_block(grads, window, argmax, grad_maps));
        }
    }
}

/// [`unpool`] of one window's channels from `first` on.
#[inline(always)]
fn unpool_block<const N: usize>(
    first: usize,
    grads: &[f32],
    window: Window,
    argmax: &[u8],
    grad_maps: &mut [f32],
) {
    let (mut own, mut own_at) = ([0.0; N], [0; N]);
    own.copy_from_slice(&grads[first..][..N]);
    for (at, &argmax) in own_at.iter_mut().zip(&argmax[first..][..N]) {
        *at = u32::from(argmax);
    }
    for (at, to) in window.pixels() {
        let sums = &mut grad_maps[to + first..][..N];
        for ((sum, &grad), &own_at) in sums.iter_mut().zip(&own).zip(&own_at) {
            *sum += if own_at == at { grad } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::isa::{AnySimd, with_simd};
    use crate::kernels::precision::Precision;

    /// Returns the maxima on every instruction set, and the gradients of the maps for window gradients of 1, 2, 3 and so on.
    fn pooled_and_back(maps: &[f32], size: Size) -> Vec<(Vec<f32>, Vec<f32>)> {
        let (rows, cols, channels) = pooled_size(size);
        let len = rows * cols * channels;
        let grads: Vec<f32> = (1..=len).map(|at| at as f32).collect();
        let of_simd = |simd| {
            let (mut largest, mut argmax) = (vec![f32::NAN; len], vec![u8::MAX; len]);
            let mut grad_maps = vec![0.0; maps.len()];
            with_simd!(simd, simd => {
                pool(simd, maps, size, &mut largest, &mut argmax);
                unpool(simd, &grads, size, &argmax, &mut grad_maps);
            });
            (largest, grad_maps)
        };
        AnySimd::all_available(Precision::F32)
            .into_iter()
            .map(of_simd)
            .collect()
    }

    /// The same by definition: the first of the largest pixels of each window, or the last NaN.
    fn wanted(maps: &[f32], size: Size) -> (Vec<f32>, Vec<f32>) {
        let ((height, width, channels), (rows, cols, _)) = (size, pooled_size(size));
        let (mut largest, mut grads) = (Vec::new(), vec![0.0; maps.len()]);
        for y in 0..rows {
            for x in 0..cols {
                for channel in 0..channels {
                    let mut best: Option<usize> = None;
                    for row in (2 * y).saturating_sub(1)..(2 * y + 2).min(height) {
                        for col in (2 * x).saturating_sub(1)..(2 * x + 2).min(width) {
                            let at = (row * width + col) * channels + channel;
                            let value = maps[at];
                            if best.is_none_or(|best| value > maps[best] || value.is_nan()) {
                                best = Some(at);
                            }
                        }
                    }
                    let best = best.unwrap();
                    largest.push(maps[best]);
                    grads[best] += largest.len() as f32;
                }
            }
        }
        (largest, grads)
    }

    #[test]
    fn the_first_of_the_largest_or_the_last_nan_is_taken_whatever_the_size() {
        let bits = |values: &[f32]| -> Vec<u32> { values.iter().map(|it| it.to_bits()).collect() };
        for size in [(1, 1, 1), (2, 3, 5), (7, 4, 16), (6, 6, 33), (3, 5, 24)] {
            let len = size.0 * size.1 * size.2;
            // All different, ties everywhere, all the same, and every 7th a NaN. All are below 0, where zero padding would win.
            for (values, nan_period) in [(1009, None), (3, None), (1, None), (3, Some(7))] {
                let value = |at: usize| match nan_period {
                    Some(period) if at % period == 3 => f32::NAN,
                    _ => (at * 383 % 1009 % values) as f32 - 2000.0,
                };
                let maps: Vec<f32> = (0..len).map(value).collect();
                let (largest, grads) = wanted(&maps, size);
                for got in pooled_and_back(&maps, size) {
                    let case = format!("{size:?}, {values} values, NaN {nan_period:?}");
                    assert_eq!(bits(&got.0), bits(&largest), "{case}");
                    assert_eq!(got.1, grads, "{case}");
                }
            }
        }
    }
}
