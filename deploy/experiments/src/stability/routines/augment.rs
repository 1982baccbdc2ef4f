//! States cropped and recoloured, as an auxiliary objective sees them, against bytes that are rounded once.

use driml_learner::augment::{Augment, AugmentSettings, COLOUR_ERROR, CROP_ERROR, View};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::check::{Context, Routine, Row};

const AUGMENT: Routine = Routine {
    name: "augmentation",
    range: "crops of a pixel and more; brightness, contrast and saturation 0 to 2, hue -0.5 to 0.5 turns",
};

/// States [height, width, stack * frame channels] and a crop of each side.
struct Picture {
    size: (usize, usize, usize),
    frame_channels: usize,
    crop_side: f64,
    state: Vec<u8>,
}

impl Picture {
    fn drawn(rng: &mut ChaCha8Rng) -> Self {
        let frame_channels = [1, 3][rng.random_range(0..2)];
        let size = (
            rng.random_range(1..14),
            rng.random_range(1..14),
            frame_channels * rng.random_range(1..=4),
        );
        let count = size.0 * size.1 * size.2;
        // Of all bytes, or of the two ends alone.
        let state = match rng.random_bool(0.5) {
            true => (0..count).map(|_| rng.random()).collect(),
            false => (0..count)
                .map(|_| [0, 255][rng.random_range(0..2)])
                .collect(),
        };
        Self {
            size,
            frame_channels,
            crop_side: rng.random_range(0.01..=1.0),
            state,
        }
    }

    fn augment(&self, crop_side: f64) -> Augment {
        let strongest = AugmentSettings {
            crop_side,
            brightness: 1.0,
            contrast: 1.0,
            saturation: 1.0,
            hue: 0.5,
        };
        Augment::new(strongest, self.size, self.frame_channels)
    }

    fn seen(&self, augment: &Augment, view: &View) -> Vec<u8> {
        let mut seen = vec![0; self.state.len()];
        augment.apply_view(&self.state, view, &mut seen);
        seen
    }

    fn pixel(&self, row: usize, column: usize, channel: usize) -> f64 {
        let (_, width, channels) = self.size;
        self.state[(row * width + column) * channels + channel].into()
    }

    /// The largest error of a crop, in bytes.
    fn crop_error(&self, view: &View) -> f64 {
        let augment = self.augment(self.crop_side);
        let seen = self.seen(&augment, view);
        let (height, width, channels) = self.size;
        let (rows, columns) = augment.crop();
        // Where an output pixel lies in the crop: two pixels and the second one's share.
        let place = |at: usize, crop: usize, whole: usize| {
            let place = (at as f64 + 0.5) * crop as f64 / whole as f64 - 0.5;
            let place = place.clamp(0.0, (crop - 1) as f64);
            let near = place as usize;
            (near, (near + 1).min(crop - 1), place.fract())
        };
        let errors = seen.iter().enumerate().map(|(at, &found)| {
            let (pixel, channel) = (at / channels, at % channels);
            let (top, bottom, down) = place(pixel / width, rows, height);
            let (left, right, across) = place(pixel % width, columns, width);
            let line = |row: usize| {
                let at = |column| self.pixel(view.top + row, view.left + column, channel);
                at(left) * (1.0 - across) + at(right) * across
            };
            let expected = line(top) * (1.0 - down) + line(bottom) * down;
            (f64::from(found) - expected).abs()
        });
        errors.fold(0.0, f64::max)
    }

    /// The largest error of a recoloured state, in bytes.
    fn colour_error(&self, view: &View) -> f64 {
        let seen = self.seen(&self.augment(1.0), view);
        let bytes = self.state.iter().map(|&byte| f64::from(byte));
        let mean = bytes.sum::<f64>() / self.state.len() as f64;
        let (sin, cos) = (view.hue * std::f64::consts::TAU).sin_cos();
        let mut error: f64 = 0.0;
        let pixels = self.state.chunks_exact(self.frame_channels);
        for (pixel, found) in pixels.zip(seen.chunks_exact(self.frame_channels)) {
            let channels = pixel.iter().map(|&channel| f64::from(channel));
            let grey = channels.clone().sum::<f64>() / pixel.len() as f64;
            let d: Vec<f64> = channels.map(|channel| channel - grey).collect();
            for (i, &found) in found.iter().enumerate() {
                let coloured = match d.as_slice() {
                    // A turn about the axis of greys, by Rodrigues' formula.
                    [_, _, _] => {
                        let cross = (d[(i + 2) % 3] - d[(i + 1) % 3]) / 3f64.sqrt();
                        grey + view.saturation * (d[i] * cos + cross * sin)
                    }
                    _ => grey,
                };
                let expected = view.brightness * (mean + view.contrast * (coloured - mean));
                error = error.max((f64::from(found) - expected.clamp(0.0, 255.0)).abs());
            }
        }
        error
    }
}

/// A view at the ends of its ranges, or anywhere in them.
fn drawn_view(picture: &Picture, rng: &mut ChaCha8Rng) -> View {
    let any = picture.augment(picture.crop_side).draw(rng);
    let mut end = |value: f64, ends: [f64; 3]| match rng.random_bool(0.5) {
        true => value,
        false => ends[rng.random_range(0..3)],
    };
    View {
        brightness: end(any.brightness, [0.0, 1.0, 2.0]),
        contrast: end(any.contrast, [0.0, 1.0, 2.0]),
        saturation: end(any.saturation, [0.0, 1.0, 2.0]),
        hue: end(any.hue, [-0.5, 0.0, 0.5]),
        ..any
    }
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut crop = Row::new(
        AUGMENT,
        "states of 1 to 13 pixels a side, 1 to 4 frames in colour or grey; crops resized to the whole, drawn",
        "error of a byte",
        CROP_ERROR,
    );
    let mut colour = Row::new(
        AUGMENT,
        "the same states recoloured, factors and turns at the ends of their ranges and between, drawn",
        "error of a byte",
        COLOUR_ERROR,
    );
    context.draw(0.5, |_, rng| {
        let picture = Picture::drawn(rng);
        let view = drawn_view(&picture, rng);
        let plain = View {
            brightness: 1.0,
            contrast: 1.0,
            saturation: 1.0,
            hue: 0.0,
            ..view
        };
        let shown = || {
            format!(
                "{:?}, crop_side {}: {view:?}",
                picture.size, picture.crop_side
            )
        };
        crop.see(picture.crop_error(&plain), shown);
        colour.see(picture.colour_error(&view), shown);
        Ok(())
    })?;
    Ok(vec![crop, colour])
}
