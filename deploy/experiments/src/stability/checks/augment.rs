//! States cropped and recoloured, as an auxiliary objective sees them, against bytes that are rounded once.

use driml_learner::augment::{Augment, AugmentSettings, View};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    edges::{one_of, worst},
    property::Cases,
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
        let frame_channels = one_of(&[1, 3], rng);
        let (height, width) = (rng.random_range(1..14), rng.random_range(1..14));
        let channels = frame_channels * rng.random_range(1..=4);
        // Of all bytes, or of the two ends alone.
        let any = rng.random_bool(0.5);
        let mut byte = || {
            if any {
                rng.random()
            } else {
                one_of(&[0, 255], rng)
            }
        };
        Self {
            size: (height, width, channels),
            frame_channels,
            state: (0..height * width * channels).map(|_| byte()).collect(),
            crop_side: rng.random_range(0.01..=1.0),
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

    /// The largest error of a crop, in bytes.
    fn crop_error(&self, view: &View) -> f64 {
        let augment = self.augment(self.crop_side);
        let (height, width, channels) = self.size;
        let (rows, columns) = augment.crop();
        // Where an output pixel lies in the crop: two pixels and the second one's share.
        let place = |at: usize, crop: usize, whole: usize| {
            let place = (at as f64 + 0.5) * crop as f64 / whole as f64 - 0.5;
            let place = place.clamp(0.0, (crop - 1) as f64);
            let near = place as usize;
            (near, (near + 1).min(crop - 1), place.fract())
        };
        let seen = self.seen(&augment, view);
        worst(seen.iter().enumerate().map(|(at, &found)| {
            let (pixel, channel) = (at / channels, at % channels);
            let (top, bottom, down) = place(pixel / width, rows, height);
            let (left, right, across) = place(pixel % width, columns, width);
            let pixel = |row, column| {
                let pixel = (view.top + row) * width + view.left + column;
                f64::from(self.state[pixel * channels + channel])
            };
            let line = |row| pixel(row, left) * (1.0 - across) + pixel(row, right) * across;
            let expected = line(top) * (1.0 - down) + line(bottom) * down;
            (f64::from(found) - expected).abs()
        }))
    }

    /// The largest error of a recoloured state, in bytes.
    fn colour_error(&self, view: &View) -> f64 {
        let seen = self.seen(&self.augment(1.0), view);
        let mean = |bytes: &[u8]| {
            bytes.iter().map(|&byte| f64::from(byte)).sum::<f64>() / bytes.len() as f64
        };
        let of_state = mean(&self.state);
        let (sin, cos) = (view.hue * std::f64::consts::TAU).sin_cos();
        let pixels = self.state.chunks_exact(self.frame_channels);
        let pixels = pixels.zip(seen.chunks_exact(self.frame_channels));
        worst(pixels.flat_map(|(pixel, found)| {
            let grey = mean(pixel);
            let d: Vec<f64> = pixel
                .iter()
                .map(|&channel| f64::from(channel) - grey)
                .collect();
            let errors = found.iter().enumerate().map(|(i, &found)| {
                let coloured = match d.as_slice() {
                    // A turn about the axis of greys, by Rodrigues' formula.
                    [_, _, _] => {
                        let cross = (d[(i + 2) % 3] - d[(i + 1) % 3]) / 3f64.sqrt();
                        grey + view.saturation * (d[i] * cos + cross * sin)
                    }
                    _ => grey,
                };
                let expected = view.brightness * (of_state + view.contrast * (coloured - of_state));
                (f64::from(found) - expected.clamp(0.0, 255.0)).abs()
            });
            errors.collect::<Vec<_>>()
        }))
    }
}

pub(crate) fn check(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for _ in cases.draws(0.5) {
        let rng = &mut cases.rng;
        let picture = Picture::drawn(rng);
        let any = picture.augment(picture.crop_side).draw(rng);
        // At the ends of its ranges, or anywhere in them.
        let mut end = |value: f64, ends: [f64; 3]| match rng.random_bool(0.5) {
            true => value,
            false => one_of(&ends, rng),
        };
        let view = View {
            brightness: end(any.brightness, [0.0, 1.0, 2.0]),
            contrast: end(any.contrast, [0.0, 1.0, 2.0]),
            saturation: end(any.saturation, [0.0, 1.0, 2.0]),
            hue: end(any.hue, [-0.5, 0.0, 0.5]),
            ..any
        };
        let plain = View {
            brightness: 1.0,
            contrast: 1.0,
            saturation: 1.0,
            hue: 0.0,
            ..view
        };
        let extreme = "states of 1 to 13 pixels a side, 1 to 4 frames in colour or grey; crops resized to the whole; the same states recoloured, factors and turns at the ends of their ranges and between, drawn";
        let input = format_args!(
            "{:?}, crop_side {}: {view:?}",
            picture.size, picture.crop_side
        );
        let errors = [picture.crop_error(&plain), picture.colour_error(&view)];
        cases.see(extreme, input, errors)?;
    }
    Ok(())
}
