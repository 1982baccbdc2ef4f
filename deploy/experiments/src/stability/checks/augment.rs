//! Cropping and recolouring of states for an auxiliary loss, compared with values in f64.

use driml_learner::augment::{AugmentSettings, Augmenter, COLOUR_ERROR, CROP_ERROR, View};

use crate::stability::property::*;

const RANGE: &str =
    "crops of a pixel and more; brightness, contrast and saturation 0 to 2, hue -0.5 to 0.5 turns";
const STATES: &str = "states of 1 to 13 pixels a side, 1 to 4 frames in colour or grey; crops resized to the whole; the same states recoloured, factors and turns at the ends of their ranges and between, drawn";

pub(super) fn properties() -> Vec<Property> {
    vec![
        Property::new("augmentation", RANGE)
            .promise("a byte of a crop", CROP_ERROR)
            .promise("a recoloured byte", COLOUR_ERROR)
            .check("states and crops of the sizes of worlds", Listed, check)
            .check(STATES, Drawn(0.5), check),
    ]
}

/// A state [height, width, stack * frame channels].
struct Picture {
    size: (usize, usize, usize),
    frame_channels: usize,
    state: Vec<u8>,
}

impl Picture {
    /// Creates the strongest augmentation, with crops of this side.
    fn augment(&self, crop_side: f64) -> Augmenter {
        let strongest = AugmentSettings {
            crop_side,
            brightness: 1.0,
            contrast: 1.0,
            saturation: 1.0,
            hue: 0.5,
        };
        Augmenter::new(strongest, self.size, self.frame_channels)
    }

    /// Returns the largest difference between the bytes of a view and their expected values.
    fn error(&self, augment: &Augmenter, view: &View, expected: impl Fn(usize) -> f64) -> f64 {
        let mut seen = vec![0u8; self.state.len()];
        augment.apply_view(&self.state, view, &mut seen);
        let seen = seen.into_iter().enumerate();
        max_error(seen.map(|(at, found)| (f64::from(found) - expected(at)).abs()))
    }

    fn crop_error(&self, augment: &Augmenter, view: &View) -> f64 {
        let (height, width, channels) = self.size;
        let (rows, columns) = augment.crop();
        // The position of an output pixel in the crop: its two neighbours, and the weight of the second.
        let place = |at: usize, crop: usize, whole: usize| {
            let place = (at as f64 + 0.5) * crop as f64 / whole as f64 - 0.5;
            let place = place.clamp(0.0, (crop - 1) as f64);
            let near = place as usize;
            (near, (near + 1).min(crop - 1), place.fract())
        };
        self.error(augment, view, |at| {
            let (pixel, channel) = (at / channels, at % channels);
            let (top, bottom, down) = place(pixel / width, rows, height);
            let (left, right, across) = place(pixel % width, columns, width);
            let pixel = |row, column| {
                let pixel = (view.top + row) * width + view.left + column;
                f64::from(self.state[pixel * channels + channel])
            };
            let line = |row| pixel(row, left) * (1.0 - across) + pixel(row, right) * across;
            line(top) * (1.0 - down) + line(bottom) * down
        })
    }

    fn colour_error(&self, view: &View) -> f64 {
        let mean = |bytes: &[u8]| {
            bytes.iter().map(|&byte| f64::from(byte)).sum::<f64>() / bytes.len() as f64
        };
        let of_state = mean(&self.state);
        let (sin, cos) = (view.hue * std::f64::consts::TAU).sin_cos();
        self.error(&self.augment(1.0), view, |at| {
            let (first, i) = (at - at % self.frame_channels, at % self.frame_channels);
            let pixel = &self.state[first..first + self.frame_channels];
            let grey = mean(pixel);
            let coloured = match pixel {
                // A rotation about the grey axis, by Rodrigues' formula.
                [_, _, _] => {
                    let d = |i: usize| f64::from(pixel[i % 3]) - grey;
                    let cross = (d(i + 2) - d(i + 1)) / 3f64.sqrt();
                    grey + view.saturation * (d(i) * cos + cross * sin)
                }
                _ => grey,
            };
            let expected = view.brightness * (of_state + view.contrast * (coloured - of_state));
            expected.clamp(0.0, 255.0)
        })
    }
}

fn check(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let sizes = [
        (64, 64, 3, 1, 0.8),
        (84, 84, 3, 4, 0.8),
        (104, 80, 1, 3, 0.8),
        (12, 12, 1, 1, 0.5),
        (9, 5, 1, 4, 0.6),
        (7, 8, 1, 5, 0.01),
    ];
    let (height, width, frame_channels, stack, crop_side) = cases.listed_or(&sizes, |rng| {
        let (height, width) = (rng.random_range(1..14), rng.random_range(1..14));
        let (channels, stack) = (one_of(&[1, 3], rng), rng.random_range(1..=4));
        (height, width, channels, stack, rng.random_range(0.01..=1.0))
    });
    let (rng, channels) = (&mut cases.rng, frame_channels * stack);
    // The state has any bytes, or only 0 and 255.
    let bytes: &[u8] = if rng.random() { &[] } else { &[0, 255] };
    let state = (0..height * width * channels).map(|_| match bytes {
        [] => rng.random(),
        ends => one_of(ends, rng),
    });
    let picture = Picture {
        state: state.collect(),
        size: (height, width, channels),
        frame_channels,
    };
    let augment = picture.augment(crop_side);
    let any = augment.draw(rng);
    // Each value is a listed one (the ends and the neutral value) or anywhere in its range.
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
    let of_crop = picture.crop_error(&augment, &plain);
    let of_colour = picture.colour_error(&view);
    let input = format_args!("{:?}, crop_side {crop_side}: {view:?}", picture.size);
    cases.record_errors(input, [of_crop, of_colour])
}
