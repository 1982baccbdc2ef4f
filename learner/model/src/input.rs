//! From frames to the network's input: enlarges the part of a u8 frame that the network reads, by nearest neighbour.
//! This module does not stack frames or convert them to floats.

use serde::{Deserialize, Serialize};

use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::geometry::ConvLayer;
use crate::torso::TorsoName;

/// The size to which frames are enlarged for the network: the `[input]` table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputSize {
    /// Rows of a whole frame after enlargement.
    pub height: u32,
    /// Columns of a whole frame after enlargement.
    pub width: u32,
    /// The size of a whole frame as the environment gives it. If set, pixels that the network does not read are cut
    /// off before a frame is recorded. Settings of earlier versions lack this field and record whole frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<FrameSize>,
}

/// Rows and columns of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameSize {
    /// Rows of pixels.
    pub height: u32,
    /// Pixels in a row.
    pub width: u32,
}

/// The part that a network reads, from the upper left corner, as (height, width).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadArea {
    /// The part of the enlarged frame.
    pub input: (usize, usize),
    /// The part of the frame as the environment gives it.
    pub frame: (usize, usize),
}

impl InputSize {
    /// Rows and columns of a whole frame after enlargement.
    pub const fn whole_input(&self) -> (usize, usize) {
        (self.height as usize, self.width as usize)
    }

    /// Rows and columns of a whole frame as the environment gives it, if frames of `sent` rows and columns are transferred.
    pub fn whole_frame(&self, sent: (usize, usize)) -> (usize, usize) {
        self.frame
            .map_or(sent, |whole| (whole.height as usize, whole.width as usize))
    }

    /// Returns the part that `torso` (with the layers `conv` if it is `nature`) reads of a frame of
    /// (height, width) enlarged to this size. Returns the whole if the layers do not fit.
    pub fn read_area(
        &self,
        torso: TorsoName,
        conv: &[ConvLayer],
        frame: (usize, usize),
    ) -> ReadArea {
        let whole = self.whole_input();
        let read = (torso.kind().read_size)(conv, whole);
        let Some(input) = read.filter(|&(rows, cols)| rows.min(cols) > 0) else {
            let input = whole;
            return ReadArea { input, frame };
        };
        let frame_side = |read: usize, from: usize, to: usize| source_at(read - 1, from, to) + 1;
        let height = frame_side(input.0, frame.0, whole.0);
        let width = frame_side(input.1, frame.1, whole.1);
        let frame = (height, width);
        ReadArea { input, frame }
    }

    /// Returns the resize from transferred frames of size `sent`, (height, width), to the input of `model`; `None` if none is needed.
    ///
    /// # Errors
    /// [`ModelError::Config`] if the network reads pixels that these frames lack.
    pub fn resizer(&self, sent: (usize, usize), model: &ModelConfig) -> Result<Option<Resizer>> {
        let (frame, whole) = (self.whole_frame(sent), self.whole_input());
        let read = (model.height, model.width);
        if frame != whole {
            let resizer = Resizer::new(frame, whole, model.input_channels)?;
            return resizer.restrict(sent, read).map(Some);
        }
        if sent == read {
            return Ok(None);
        }
        Err(ModelError::Config(format!(
            "the network takes {read:?} of {whole:?}, but the frames are {sent:?}"
        )))
    }
}

/// Returns the source index of output index `at` along one side.
const fn source_at(at: usize, from: usize, to: usize) -> usize {
    (2 * at + 1) * from / (2 * to)
}

/// Resizes u8 images [n, h, w, c] to another height and width by nearest neighbour.
///
/// Output pixel d copies source pixel floor((d + 1/2) * from / to), independently in each direction: the
/// pixel under its centre. Procgen's 64x64 becomes the paper's 104x80, Ms. PacMan's 21x19 its 84x84.
#[derive(Clone, Debug)]
pub struct Resizer {
    from: (usize, usize),
    channels: usize,
    source_rows: Vec<usize>,
    source_cols: Vec<usize>,
}

impl Resizer {
    /// Builds a resize between two sizes, each (height, width).
    ///
    /// # Errors
    /// [`ModelError::Config`] if a size is 0.
    pub fn new(from: (usize, usize), to: (usize, usize), channels: usize) -> Result<Self> {
        if from.0.min(from.1).min(to.0).min(to.1).min(channels) == 0 {
            return Err(ModelError::Config(format!(
                "resizing {from:?} to {to:?} with {channels} channels"
            )));
        }
        let sources = |from: usize, to: usize| (0..to).map(|at| source_at(at, from, to)).collect();
        Ok(Self {
            from,
            channels,
            source_rows: sources(from.0, to.0),
            source_cols: sources(from.1, to.1),
        })
    }

    /// Restricts the resize to the upper left parts: from the part `from` of a source image to the part `to` of its result.
    ///
    /// # Errors
    /// [`ModelError::Config`] if the part `to` needs pixels outside `from`, or if either part exceeds its image.
    pub fn restrict(mut self, from: (usize, usize), to: (usize, usize)) -> Result<Self> {
        let whole = (self.from, (self.source_rows.len(), self.source_cols.len()));
        self.source_rows.truncate(to.0);
        self.source_cols.truncate(to.1);
        let fits = |sources: &[usize], whole: usize, wanted: usize, part: usize| {
            let last = sources.last().copied();
            sources.len() == wanted && part <= whole && last.is_some_and(|last| last < part)
        };
        if fits(&self.source_rows, whole.0.0, to.0, from.0)
            && fits(&self.source_cols, whole.0.1, to.1, from.1)
        {
            self.from = from;
            return Ok(self);
        }
        Err(ModelError::Config(format!(
            "resizing {from:?} of {:?} to {to:?} of {:?}",
            whole.0, whole.1
        )))
    }

    /// Bytes of one source image.
    pub fn input_bytes(&self) -> usize {
        self.from.0 * self.from.1 * self.channels
    }

    /// Bytes of one resized image.
    pub fn output_bytes(&self) -> usize {
        self.source_rows.len() * self.source_cols.len() * self.channels
    }

    /// Resizes `images` [n, from, c] to [n, to, c].
    pub fn resized(&self, images: &[u8]) -> Vec<u8> {
        let mut enlarged = vec![0; images.len() / self.input_bytes() * self.output_bytes()];
        self.apply(images, &mut enlarged);
        enlarged
    }

    /// Resizes `images` [n, from, c] into `enlarged` [n, to, c].
    pub fn apply(&self, images: &[u8], enlarged: &mut [u8]) {
        let count = images.len() / self.input_bytes();
        let bytes = [self.input_bytes(), self.output_bytes()].map(|bytes| count * bytes);
        assert_eq!([images.len(), enlarged.len()], bytes, "{count} images");
        let source_line = self.from.1 * self.channels;
        let line = self.source_cols.len() * self.channels;
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
            let resizer = Resizer::new(from, to, channels).unwrap();
            let images: Vec<u8> = (0..2 * from.0 * from.1 * channels)
                .map(|index| (index * 7 % 251) as u8)
                .collect();
            let enlarged = resizer.resized(&images);
            assert_eq!(enlarged.len(), 2 * to.0 * to.1 * channels);
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

    /// Cuts the upper left `part` out of images [h, w, 1].
    fn cut(images: &[u8], width: usize, part: (usize, usize)) -> Vec<u8> {
        let rows = images.chunks_exact(width).take(part.0);
        rows.flat_map(|row| &row[..part.1]).copied().collect()
    }

    #[test]
    fn what_is_read_is_the_same_of_a_part_as_of_the_whole() {
        let conv =
            [(8, 4), (4, 2), (3, 1)].map(|(kernel, stride)| ConvLayer::new(1, kernel, stride));
        for (frame, input, read) in [
            ((64, 64), (64, 64), ((60, 60), (60, 60))),
            ((64, 64), (104, 80), ((100, 76), (62, 61))),
            ((21, 19), (84, 84), ((84, 84), (21, 19))),
            ((64, 50), (80, 64), ((76, 60), (61, 47))),
        ] {
            let size = InputSize {
                height: input.0 as u32,
                width: input.1 as u32,
                frame: Some(FrameSize {
                    height: frame.0 as u32,
                    width: frame.1 as u32,
                }),
            };
            let found = size.read_area(TorsoName::Nature, &conv, frame);
            assert_eq!((found.input, found.frame), read);
            let image: Vec<u8> = (0..frame.0 * frame.1)
                .map(|at| (at * 7 % 251) as u8)
                .collect();
            let whole = Resizer::new(frame, input, 1).unwrap().resized(&image);
            let model = ModelConfig {
                height: found.input.0,
                width: found.input.1,
                conv: conv.to_vec(),
                ..ModelConfig::small()
            };
            let sent = cut(&image, frame.1, found.frame);
            let part = match size.resizer(found.frame, &model).unwrap() {
                Some(resizer) => resizer.resized(&sent),
                None => sent,
            };
            assert_eq!(part, cut(&whole, input.1, found.input), "{frame:?}");
            // One row less is too small.
            let less = (found.frame.0 - 1, found.frame.1);
            assert!(size.resizer(less, &model).is_err(), "{frame:?}");
        }
    }

    #[test]
    fn sizes_of_zero_are_errors() {
        assert!(Resizer::new((0, 2), (4, 8), 1).is_err());
        assert!(Resizer::new((1, 2), (4, 8), 0).is_err());
    }
}
