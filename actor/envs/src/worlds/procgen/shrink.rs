//! Makes the engine's frames smaller, or grey: fewer bytes to store, to send and to learn from.
//! Frames that keep the engine's size and colours do not pass through here.

use procgen_sys::{FRAME_BYTES, FRAME_SIDE};

use crate::environment::FrameShape;

/// Bytes of the engine's pixel.
pub(super) const RGB: usize = 3;
/// Thousandths of red, green and blue in grey. Source: ITU-R BT.601, luma.
const LUMA: [u32; RGB] = [299, 587, 114];
const LUMA_SUM: u32 = 1000;

/// Shrinks a frame [64, 64, 3] to `side` x `side` pixels, in colour or grey.
///
/// A pixel is the mean over the area that it covers, pixels at its edges counted in proportion, rounded to the nearest number, halves
/// up; its grey is the luma of that mean before rounding. The arithmetic is exact in 32 bits.
pub(super) struct FrameShrinker {
    shape: FrameShape,
    /// For each pixel along a side, the first engine pixel that it covers, and how much of each it covers, in units of `1 / side`.
    coverage: Vec<(usize, Vec<u32>)>,
}

impl FrameShrinker {
    /// Shrinks to frames of this shape: a side of 1 to 64 pixels, and 3 bytes per pixel, or 1 if they are grey.
    pub(super) fn new(shape: FrameShape) -> Self {
        let side = shape.height;
        assert!((1..=FRAME_SIDE).contains(&side), "a side of {side} pixels");
        // In units of 1 / side of the engine's pixels, ours is FRAME_SIDE wide and the engine's is side wide.
        let coverage = (0..side).map(|index| {
            let (start, end) = (index * FRAME_SIDE, (index + 1) * FRAME_SIDE);
            let first = start / side;
            let overlaps = (first..end.div_ceil(side)).map(|pixel| {
                let overlap = end.min((pixel + 1) * side) - start.max(pixel * side);
                overlap as u32
            });
            (first, overlaps.collect())
        });
        Self {
            coverage: coverage.collect(),
            shape,
        }
    }

    /// Writes `frames` [N, 64, 64, 3] to `out` [N, side, side, 3 or 1].
    pub(super) fn apply(&self, frames: &[u8], out: &mut [u8]) {
        let frames = frames.chunks_exact(FRAME_BYTES);
        for (frame, out) in frames.zip(out.chunks_exact_mut(self.shape.bytes())) {
            self.shrink_frame(frame, out);
        }
    }

    fn shrink_frame(&self, frame: &[u8], out: &mut [u8]) {
        let mut pixels = out.chunks_exact_mut(self.shape.channels);
        for (top, rows) in &self.coverage {
            for (left, cols) in &self.coverage {
                // At most 255 * 64 * 64.
                let mut sums = [0u32; RGB];
                for (row, &row_weight) in rows.iter().enumerate() {
                    let line = &frame[((top + row) * FRAME_SIDE + left) * RGB..];
                    for (pixel, &col_weight) in line.chunks_exact(RGB).zip(cols) {
                        for (sum, &value) in sums.iter_mut().zip(pixel) {
                            *sum += row_weight * col_weight * u32::from(value);
                        }
                    }
                }
                let pixel = pixels.next().expect("side x side pixels");
                let area = (FRAME_SIDE * FRAME_SIDE) as u32;
                if self.shape.channels == 1 {
                    let luma: u32 = sums.iter().zip(LUMA).map(|(sum, share)| sum * share).sum();
                    pixel[0] = rounded_ratio(luma, area * LUMA_SUM);
                } else {
                    for (value, sum) in pixel.iter_mut().zip(sums) {
                        *value = rounded_ratio(sum, area);
                    }
                }
            }
        }
    }
}

/// `sum / divisor` to the nearest number, halves up; it must be below 256.
const fn rounded_ratio(sum: u32, divisor: u32) -> u8 {
    ((sum + divisor / 2) / divisor) as u8
}

#[cfg(test)]
mod tests {
    use rand::{RngCore, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn shrunk(side: usize, grey: bool, frame: &[u8]) -> Vec<u8> {
        let shape = FrameShape::new(side, side, if grey { 1 } else { RGB });
        let mut out = vec![0; frame.len() / FRAME_BYTES * shape.bytes()];
        FrameShrinker::new(shape).apply(frame, &mut out);
        out
    }

    fn random() -> Vec<u8> {
        let mut frame = vec![0; FRAME_BYTES];
        ChaCha8Rng::seed_from_u64(5).fill_bytes(&mut frame);
        frame
    }

    #[test]
    fn a_pixel_is_the_mean_of_its_area() {
        let frame = random();
        for side in [1, 13, 32, 48, 63, 64] {
            let found = shrunk(side, false, &frame);
            // The slow way: each of the engine's pixels as side x side points, each of ours as 64 x 64.
            let scale = 64 * side;
            for (at, &value) in found.iter().enumerate().step_by(7) {
                let (pixel, channel) = (at / 3, at % 3);
                let (top, left) = (pixel / side * 64, pixel % side * 64);
                let mut sum = 0u64;
                for y in top..top + 64 {
                    for x in left..left + 64 {
                        assert!(y < scale && x < scale);
                        sum += u64::from(frame[(y / side * 64 + x / side) * 3 + channel]);
                    }
                }
                assert_eq!(
                    u64::from(value),
                    (sum + 2048) / 4096,
                    "side {side}, byte {at}"
                );
            }
        }
        assert_eq!(shrunk(64, false, &frame), frame);
    }

    #[test]
    fn grey_is_luma_and_frames_stay_apart() {
        let pixels = [
            ([255_u8, 255, 255], 255_u8),
            ([255, 0, 0], 76),
            ([0, 255, 0], 150),
            ([0, 0, 255], 29),
            ([0, 0, 0], 0),
        ];
        let frames = pixels.map(|(pixel, _)| pixel.repeat(FRAME_BYTES / 3));
        for side in [64, 48, 32] {
            let greys = pixels.map(|(_, grey)| vec![grey; side * side]);
            assert_eq!(shrunk(side, true, &frames.concat()), greys.concat());
        }
    }
}
