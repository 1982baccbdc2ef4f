//! Augmentation: crops and recolours states at random for the auxiliary loss, bytes in, bytes out.
//! C51 always sees the plain states. This module knows neither networks nor losses, and holds no random generator.

use driml_protocol::config::{ConfigError, check_range};
use rand::Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Colour coefficients are whole multiples of 2^-12.
const COLOUR_BITS: u32 = 12;
/// Weights of neighbouring pixels are whole multiples of 1/256.
const FULL_WEIGHT: u16 = 256;

/// Largest error of a byte of a resized crop: 1/2 from rounding, and up to 1/512 in each of two weights.
pub const CROP_ERROR: f64 = 0.5 + 2.0 * 255.0 / 512.0;

/// Largest error of a recoloured byte: 1/2 from rounding, and up to 2^-13 in each of three coefficients and in the addend.
pub const COLOUR_ERROR: f64 = 0.5 + (3.0 * 255.0 + 1.0) / 8192.0;

/// The `[learner.augment]` table: how strongly states are changed. All frames of a state are changed in the same way.
///
/// `crop_side` at 1 and the others at 0 leave every byte unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AugmentSettings {
    /// Share of each side that a crop keeps, above 0, at most 1. The crop is resized to the state's size.
    pub crop_side: f64,
    /// Strength s in [0, 1]: colours are scaled by a factor from 1 - s to 1 + s.
    pub brightness: f64,
    /// Strength s in [0, 1]: distances from the state's mean grey are scaled by a factor from 1 - s to 1 + s.
    pub contrast: f64,
    /// Strength s in [0, 1]: distances from a pixel's own grey are scaled by a factor from 1 - s to 1 + s.
    pub saturation: f64,
    /// Largest turn h in [0, 0.5], in turns of the colour circle: hues are turned by -h to h.
    pub hue: f64,
}

impl AugmentSettings {
    /// Checks each strength against its range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let share = "it must lie above 0 and be at most 1, which crops nothing";
        let strength = "it must lie between 0 and 1";
        let turn = "it must lie between 0 and 0.5, half a turn either way";
        for (key, value, range, why) in [
            ("crop_side", self.crop_side, f64::MIN_POSITIVE..=1.0, share),
            ("brightness", self.brightness, 0.0..=1.0, strength),
            ("contrast", self.contrast, 0.0..=1.0, strength),
            ("saturation", self.saturation, 0.0..=1.0, strength),
            ("hue", self.hue, 0.0..=0.5, turn),
        ] {
            let key = format!("learner.augment.{key}");
            check_range(&key, value, range, why)?;
        }
        Ok(())
    }
}

/// The augmentation of one state: a crop and changes of its colours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// First row of the crop.
    pub top: usize,
    /// First column of the crop.
    pub left: usize,
    /// Factor on all colours.
    pub brightness: f64,
    /// Factor on distances from the state's mean grey.
    pub contrast: f64,
    /// Factor on distances from a pixel's own grey.
    pub saturation: f64,
    /// Turns of the colour circle; a third takes red to green.
    pub hue: f64,
}

/// The two source pixels of an output pixel along one axis, and the weight of `far` in 1/256.
#[derive(Clone, Copy, Debug)]
struct Tap {
    near: usize,
    far: usize,
    far_weight: u16,
}

/// Augments states at random.
#[derive(Debug)]
pub struct Augmenter {
    settings: AugmentSettings,
    /// Height, width and channels of a state.
    size: (usize, usize, usize),
    frame_channels: usize,
    /// Height and width of the crop, pixels.
    crop: (usize, usize),
    rows: Vec<Tap>,
    columns: Vec<Tap>,
}

impl Augmenter {
    /// Creates the augmentation of states [height, width, stack * `frame_channels`]. `settings` are in their ranges, and no size is 0.
    ///
    /// A crop has `crop_side` of each side, rounded, and at least one pixel.
    pub fn new(
        settings: AugmentSettings,
        (height, width, channels): (usize, usize, usize),
        frame_channels: usize,
    ) -> Self {
        let crop_length = |whole: usize| {
            let kept = (whole as f64 * settings.crop_side).round() as usize;
            kept.clamp(1, whole)
        };
        let crop = (crop_length(height), crop_length(width));
        Self {
            settings,
            size: (height, width, channels),
            frame_channels,
            crop,
            rows: taps(crop.0, height),
            columns: taps(crop.1, width),
        }
    }

    /// Height and width of the crop, pixels.
    pub const fn crop(&self) -> (usize, usize) {
        self.crop
    }

    /// Draws the augmentation of one state: every position of the crop is equally likely, factors and turn are uniform in their ranges.
    pub fn draw(&self, rng: &mut impl Rng) -> View {
        let (settings, (height, width, _)) = (self.settings, self.size);
        let top = rng.random_range(0..=height - self.crop.0);
        let left = rng.random_range(0..=width - self.crop.1);
        let mut around = |middle: f64, by: f64| middle + by * (2.0 * rng.random::<f64>() - 1.0);
        View {
            top,
            left,
            brightness: around(1.0, settings.brightness),
            contrast: around(1.0, settings.contrast),
            saturation: around(1.0, settings.saturation),
            hue: around(0.0, settings.hue),
        }
    }

    /// Augments each of `states` [n, H, W, C] with a separate draw. Writes the results to `out`, resized to the length of `states`.
    ///
    /// All draws are made in order before the parallel part, so that the bytes depend on `rng` alone.
    pub fn apply(&self, states: &[u8], out: &mut Vec<u8>, rng: &mut impl Rng) {
        let (height, width, channels) = self.size;
        let state_bytes = height * width * channels;
        let count = states.len() / state_bytes;
        let views: Vec<View> = (0..count).map(|_| self.draw(rng)).collect();
        out.resize(states.len(), 0);
        out.par_chunks_exact_mut(state_bytes)
            .zip(states.par_chunks_exact(state_bytes))
            .zip(&views)
            .for_each(|((out, state), view)| self.apply_view(state, view, out));
    }

    /// Applies `view` to one state and writes the result to `out`.
    pub fn apply_view(&self, state: &[u8], view: &View, out: &mut [u8]) {
        let (height, width, channels) = self.size;
        if self.crop == (height, width) {
            out.copy_from_slice(state);
        } else {
            let resize = match channels {
                1 => Self::resize::<1>,
                3 => Self::resize::<3>,
                4 => Self::resize::<4>,
                12 => Self::resize::<12>,
                _ => Self::resize_any,
            };
            let mut line = vec![0; self.crop.1 * channels];
            resize(self, state, view, out, &mut line);
        }
        recolour(out, view, self.frame_channels);
    }

    /// [`Augmenter::resize_any`] specialised at compile time for states of `C` channels.
    fn resize<const C: usize>(&self, state: &[u8], view: &View, out: &mut [u8], line: &mut [u16]) {
        let (outputs, _) = out.as_chunks_mut::<C>();
        for (tap, outputs) in self.rows.iter().zip(outputs.chunks_exact_mut(self.size.1)) {
            self.blend_rows(state, view, tap, line);
            let (pixels, _) = line.as_chunks::<C>();
            for (output, tap) in outputs.iter_mut().zip(&self.columns) {
                let (near, far) = (&pixels[tap.near], &pixels[tap.far]);
                for c in 0..C {
                    output[c] = blend(near[c], far[c], tap.far_weight);
                }
            }
        }
    }

    /// Resizes the view's crop of `state` to the size of the state, bilinearly.
    ///
    /// Output pixel d lies at (d + 1/2) * crop / whole - 1/2 of the crop. It mixes the two pixels beside it, with weights in 1/256 and
    /// one rounding, as PyTorch's `interpolate(mode = "bilinear", align_corners = False)` does. Nearest neighbours would double every
    /// fourth pixel, and with it the thin objects of a 64 x 64 frame.
    fn resize_any(&self, state: &[u8], view: &View, out: &mut [u8], line: &mut [u16]) {
        let (_, width, channels) = self.size;
        let outputs = out.chunks_exact_mut(width * channels);
        for (tap, outputs) in self.rows.iter().zip(outputs) {
            self.blend_rows(state, view, tap, line);
            for (output, tap) in outputs.chunks_exact_mut(channels).zip(&self.columns) {
                let (near, far) = (tap.near * channels, tap.far * channels);
                for (c, output) in output.iter_mut().enumerate() {
                    *output = blend(line[near + c], line[far + c], tap.far_weight);
                }
            }
        }
    }

    /// Mixes two rows of the crop into `line`, exactly, in units of 1/256 of a byte.
    fn blend_rows(&self, state: &[u8], view: &View, tap: &Tap, line: &mut [u16]) {
        let (_, width, channels) = self.size;
        let row = |at: usize| {
            let start = ((view.top + at) * width + view.left) * channels;
            &state[start..start + line.len()]
        };
        let (near, far) = (row(tap.near), row(tap.far));
        let (near_weight, far_weight) = (FULL_WEIGHT - tap.far_weight, tap.far_weight);
        for ((out, &near), &far) in line.iter_mut().zip(near).zip(far) {
            *out = u16::from(near) * near_weight + u16::from(far) * far_weight;
        }
    }
}

/// Mixes two values in units of 1/256 of a byte, and rounds to a byte.
fn blend(near: u16, far: u16, far_weight: u16) -> u8 {
    let sum = u32::from(near) * u32::from(FULL_WEIGHT - far_weight)
        + u32::from(far) * u32::from(far_weight);
    ((sum + (1 << 15)) >> 16) as u8
}

/// The position of each of `to` output pixels among `from` source pixels, clamped at the ends.
fn taps(from: usize, to: usize) -> Vec<Tap> {
    let tap = |at: usize| {
        let position = (at as f64 + 0.5) * from as f64 / to as f64 - 0.5;
        let position = position.clamp(0.0, (from - 1) as f64);
        let near = position.floor() as usize;
        Tap {
            near,
            far: (near + 1).min(from - 1),
            far_weight: ((position - position.floor()) * f64::from(FULL_WEIGHT)).round() as u16,
        }
    };
    (0..to).map(tap).collect()
}

/// Changes brightness, contrast, saturation and hue of a state in place. A pixel has `frame_channels` channels of each stacked frame.
///
/// Let b and c be the factors of brightness and contrast, m the mean of all bytes, and M the matrix that turns hues and scales
/// distances from grey. A pixel x becomes b c M x + b (1 - c) m, rounded and clamped once. Grey is the mean of the three channels
/// and hues turn about the axis of greys, so that the four changes commute and their order does not matter. (torchvision's
/// `ColorJitter` draws an order, clamps in between, weights the channels and turns hues in HSV.) Frames that do not have three
/// channels keep their saturation and hue.
fn recolour(state: &mut [u8], view: &View, frame_channels: usize) {
    let unit = f64::from(1u32 << COLOUR_BITS);
    let sum: u64 = state.iter().map(|&byte| u64::from(byte)).sum();
    let mean = sum as f64 / state.len().max(1) as f64;
    let gain = view.brightness * view.contrast;
    let half = 1 << (COLOUR_BITS - 1);
    let add = (view.brightness * (1.0 - view.contrast) * mean * unit).round() as i32 + half;
    let to_fixed_point = |coefficient: f64| (gain * coefficient * unit).round() as i32;
    let to_byte = |sum: i32| (sum >> COLOUR_BITS).clamp(0, 255) as u8;
    if frame_channels == 3 {
        let (sin, cos) = (view.hue * std::f64::consts::TAU).sin_cos();
        let (along, across) = (view.saturation * cos, view.saturation * sin / 3f64.sqrt());
        let own = to_fixed_point(1.0 / 3.0 + along * 2.0 / 3.0);
        let next = to_fixed_point(1.0 / 3.0 - along / 3.0 - across);
        let last = to_fixed_point(1.0 / 3.0 - along / 3.0 + across);
        if (own, next, last, add) == (1 << COLOUR_BITS, 0, 0, half) {
            return;
        }
        let (pixels, _) = state.as_chunks_mut::<3>();
        for pixel in pixels {
            let [r, g, b] = pixel.map(i32::from);
            *pixel = [
                to_byte(own * r + next * g + last * b + add),
                to_byte(last * r + own * g + next * b + add),
                to_byte(next * r + last * g + own * b + add),
            ];
        }
    } else {
        let own = to_fixed_point(1.0);
        if (own, add) == (1 << COLOUR_BITS, half) {
            return;
        }
        let changed: [u8; 256] = std::array::from_fn(|value| to_byte(own * value as i32 + add));
        state
            .iter_mut()
            .for_each(|value| *value = changed[usize::from(*value)]);
    }
}
