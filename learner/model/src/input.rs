//! Frames to the network's input size: enlargement by nearest neighbour on plain bytes.
//! It does not stack frames and does not convert them to floats.

use crate::error::{ModelError, Result};

/// Resizes u8 images [n, h, w, c] to another height and width by nearest neighbour.
///
/// Output pixel d takes source pixel floor((d + 1/2) * from / to), in each direction by itself: the source pixel under the
/// output pixel's centre. Procgen's 64x64 becomes the paper's 104x80, Ms. PacMan's 21x19 its 84x84.
#[derive(Clone, Debug)]
pub struct Enlarge {
    from: (usize, usize),
    channels: usize,
    source_rows: Vec<usize>,
    source_cols: Vec<usize>,
}

impl Enlarge {
    /// From and to are (height, width).
    ///
    /// # Errors
    /// [`ModelError::Config`] if a size is 0.
    pub fn new(from: (usize, usize), to: (usize, usize), channels: usize) -> Result<Self> {
        if from.0.min(from.1).min(to.0).min(to.1).min(channels) == 0 {
            return Err(ModelError::Config(format!(
                "resizing {from:?} to {to:?} with {channels} channels"
            )));
        }
        let sources =
            |from: usize, to: usize| (0..to).map(|at| (2 * at + 1) * from / (2 * to)).collect();
        Ok(Self {
            from,
            channels,
            source_rows: sources(from.0, to.0),
            source_cols: sources(from.1, to.1),
        })
    }

    /// Bytes of one source image.
    pub fn input_bytes(&self) -> usize {
        self.from.0 * self.from.1 * self.channels
    }

    /// Bytes of one resized image.
    pub fn output_bytes(&self) -> usize {
        self.source_rows.len() * self.source_cols.len() * self.channels
    }

    /// Resizes `images` [n, from, c] into `enlarged` [n, to, c].
    ///
    /// # Panics
    /// If the two lengths are not whole images of the same number.
    pub fn apply(&self, images: &[u8], enlarged: &mut [u8]) {
        let count = images.len() / self.input_bytes();
        assert!(
            images.len() == count * self.input_bytes()
                && enlarged.len() == count * self.output_bytes(),
            "resizing {} bytes into {}, {} and {} an image",
            images.len(),
            enlarged.len(),
            self.input_bytes(),
            self.output_bytes()
        );
        let (source_line, line) = (
            self.from.1 * self.channels,
            self.source_cols.len() * self.channels,
        );
        let images = images.chunks_exact(self.input_bytes());
        for (image, enlarged) in images.zip(enlarged.chunks_exact_mut(self.output_bytes())) {
            let mut previous: Option<usize> = None;
            for (at, &row) in self.source_rows.iter().enumerate() {
                let (done, rest) = enlarged.split_at_mut(at * line);
                let target = &mut rest[..line];
                if previous == Some(row) {
                    target.copy_from_slice(&done[(at - 1) * line..]);
                } else {
                    let source = &image[row * source_line..][..source_line];
                    for (pixel, &col) in target
                        .chunks_exact_mut(self.channels)
                        .zip(&self.source_cols)
                    {
                        pixel.copy_from_slice(&source[col * self.channels..][..self.channels]);
                    }
                }
                previous = Some(row);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_is_its_nearest_source() {
        for (from, to, channels) in [
            ((64, 64), (104, 80), 3),
            ((21, 19), (84, 84), 12),
            ((3, 5), (2, 4), 1),
        ] {
            let enlarge = Enlarge::new(from, to, channels).unwrap();
            let images: Vec<u8> = (0..2 * from.0 * from.1 * channels)
                .map(|index| (index * 7 % 251) as u8)
                .collect();
            let mut enlarged = vec![0; 2 * to.0 * to.1 * channels];
            enlarge.apply(&images, &mut enlarged);
            for (index, &value) in enlarged.iter().enumerate() {
                let (pixel, channel) = (index / channels, index % channels);
                let (image, y, x) = (pixel / (to.0 * to.1), pixel / to.1 % to.0, pixel % to.1);
                let source = |at: usize, from: usize, to: usize| {
                    ((at as f64 + 0.5) * from as f64 / to as f64).floor() as usize
                };
                let (sy, sx) = (source(y, from.0, to.0), source(x, from.1, to.1));
                let wanted = images[((image * from.0 + sy) * from.1 + sx) * channels + channel];
                assert_eq!(value, wanted, "{from:?} to {to:?} at {y}, {x}");
            }
        }
    }

    #[test]
    fn four_to_one_repeats_each_pixel_four_times() {
        let enlarge = Enlarge::new((1, 2), (4, 8), 1).unwrap();
        let mut enlarged = [0; 32];
        enlarge.apply(&[10, 20], &mut enlarged);
        assert_eq!(enlarged, [10, 10, 10, 10, 20, 20, 20, 20].repeat(4)[..]);
    }

    #[test]
    fn sizes_of_zero_are_errors() {
        assert!(Enlarge::new((0, 2), (4, 8), 1).is_err());
        assert!(Enlarge::new((1, 2), (4, 8), 0).is_err());
    }
}
