//! Convolutions with ReLU against float64: results, and gradients of images, weights and biases.

use candle_core::{DType, Device, Tensor, Var};
use driml_model::{Precision, conv2d_relu};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::sums::{Sum, flat, moderate, places, row, tensor, worst};
use crate::stability::{
    check::{Context, Row},
    edges::{finites, shown, widened},
    routines::losses::worse,
};

/// The three of Procgen's network, the border that the first would not read left out.
const REAL: [Picture; 3] = [
    Picture::new(32, (60, 3), (8, 4), 32),
    Picture::new(32, (14, 32), (4, 2), 64),
    Picture::new(32, (6, 64), (3, 1), 64),
];

/// Images [B, side, side, channels] under one convolution.
#[derive(Clone, Copy)]
struct Picture {
    images: usize,
    side: usize,
    channels: usize,
    kernel: usize,
    stride: usize,
    out: usize,
}

impl Picture {
    const fn new(
        images: usize,
        (side, channels): (usize, usize),
        (kernel, stride): (usize, usize),
        out: usize,
    ) -> Self {
        Self {
            images,
            side,
            channels,
            kernel,
            stride,
            out,
        }
    }

    /// A small one.
    fn drawn(rng: &mut ChaCha8Rng) -> Self {
        let kernel = rng.random_range(1..5);
        Self {
            images: 3,
            side: kernel + rng.random_range(0..6),
            channels: rng.random_range(1..6),
            kernel,
            stride: rng.random_range(1..4),
            out: rng.random_range(1..20),
        }
    }

    const fn pixels(&self) -> usize {
        self.images * self.side * self.side * self.channels
    }

    const fn weights(&self) -> usize {
        self.out * self.channels * self.kernel * self.kernel
    }

    /// Places of a map along one side.
    const fn places(&self) -> usize {
        (self.side - self.kernel) / self.stride + 1
    }

    const fn results(&self) -> usize {
        self.images * self.places() * self.places() * self.out
    }

    const fn pixel_at(&self, image: usize, row: usize, column: usize, channel: usize) -> usize {
        ((image * self.side + row) * self.side + column) * self.channels + channel
    }

    const fn weight_at(&self, out: usize, channel: usize, row: usize, column: usize) -> usize {
        ((out * self.channels + channel) * self.kernel + row) * self.kernel + column
    }

    const fn result_at(&self, image: usize, row: usize, column: usize, out: usize) -> usize {
        ((image * self.places() + row) * self.places() + column) * self.out + out
    }

    /// Along one side: the places of a map, each with the kernel's line, that read the pixel at `at`.
    fn readers(&self, at: usize) -> impl Iterator<Item = (usize, usize)> + Clone + use<> {
        let (stride, places) = (self.stride, self.places());
        (0..self.kernel).filter_map(move |line| {
            let first = at.checked_sub(line)?;
            (first % stride == 0 && first / stride < places).then_some((first / stride, line))
        })
    }
}

/// One case: what a picture is computed from, and the gradient of its results.
struct Case {
    picture: Picture,
    images: Images,
    w: Vec<f32>,
    b: Vec<f32>,
    g: Vec<f32>,
}

enum Images {
    Bytes(Vec<u8>),
    Floats(Vec<f32>),
}

impl Case {
    /// Of numbers that `values` draws, which images of bytes have 255ths of.
    fn drawn(
        picture: Picture,
        with_bytes: bool,
        rng: &mut ChaCha8Rng,
        mut values: impl FnMut(usize, &mut ChaCha8Rng) -> Vec<f32>,
    ) -> Self {
        Self {
            w: values(picture.weights(), rng),
            b: values(picture.out, rng),
            g: values(picture.results(), rng),
            images: match with_bytes {
                true => Images::Bytes((0..picture.pixels()).map(|_| rng.random()).collect()),
                false => Images::Floats(values(picture.pixels(), rng)),
            },
            picture,
        }
    }

    /// The worst error of results and gradients.
    fn error(&self, precision: Precision, rng: &mut ChaCha8Rng) -> anyhow::Result<f64> {
        let it = self.picture;
        let shape = [it.images, it.side, it.side, it.channels];
        let (images, pixels): (_, Vec<f64>) = match &self.images {
            Images::Bytes(x) => (
                Var::from_tensor(&Tensor::from_slice(x, shape.as_slice(), &Device::Cpu)?)?,
                x.iter().map(|&x| f64::from(x) / 255.0).collect(),
            ),
            Images::Floats(x) => (tensor(x, &shape)?, widened(x)),
        };
        // A byte / 255 has two roundings of its own.
        let roundings = if images.dtype() == DType::U8 { 2 } else { 0 };
        let weight = tensor(&self.w, &[it.out, it.channels, it.kernel, it.kernel])?;
        let bias = tensor(&self.b, &[it.out])?;
        let y = conv2d_relu(&images, &weight, &bias, it.stride, precision)?;
        let slopes = Tensor::from_slice(&self.g, y.shape(), &Device::Cpu)?;
        let gradients = (&y * &slopes)?.sum_all()?.backward()?;
        let found = flat(&y)?;
        let (ws, bs) = (widened(&self.w), widened(&self.b));
        // Where a result is 0 its gradient is.
        let gs: Vec<f64> = found
            .iter()
            .zip(&self.g)
            .map(|(&y, &g)| if y > 0.0 { g.into() } else { 0.0 })
            .collect();
        let kernel = || (0..it.kernel * it.kernel).map(|at| (at / it.kernel, at % it.kernel));
        let map = || {
            let places = it.places();
            (0..it.images * places * places)
                .map(move |at| (at / (places * places), at / places % places, at % places))
        };
        let y_of = |at: usize| {
            let (out, place) = (at % it.out, at / it.out);
            let (image, row, column) = (
                place / (it.places() * it.places()),
                place / it.places() % it.places() * it.stride,
                place % it.places() * it.stride,
            );
            let mut sum = Sum::default();
            for channel in 0..it.channels {
                for (r, c) in kernel() {
                    let x = pixels[it.pixel_at(image, row + r, column + c, channel)];
                    sum.add(x, ws[it.weight_at(out, channel, r, c)]);
                }
            }
            sum.value += bs[out];
            sum.sizes += bs[out].abs();
            sum.terms += roundings;
            sum
        };
        let w_of = |at: usize| {
            let (r, c) = (at / it.kernel % it.kernel, at % it.kernel);
            let channel = at / (it.kernel * it.kernel) % it.channels;
            let out = at / (it.kernel * it.kernel * it.channels);
            let mut sum = Sum::default();
            for (image, row, column) in map() {
                let (y, x) = (row * it.stride + r, column * it.stride + c);
                let slope = gs[it.result_at(image, row, column, out)];
                sum.add(pixels[it.pixel_at(image, y, x, channel)], slope);
            }
            sum.terms += roundings;
            sum
        };
        let b_of = |out: usize| {
            let mut sum = Sum::default();
            map().for_each(|(image, row, column)| {
                sum.add(gs[it.result_at(image, row, column, out)], 1.0);
            });
            sum
        };
        let x_of = |at: usize| {
            let (channel, pixel) = (at % it.channels, at / it.channels);
            let (column, row) = (pixel % it.side, pixel / it.side % it.side);
            let image = pixel / (it.side * it.side);
            let mut sum = Sum::default();
            for (row, r) in it.readers(row) {
                for (column, c) in it.readers(column) {
                    for out in 0..it.out {
                        let slope = gs[it.result_at(image, row, column, out)];
                        sum.add(slope, ws[it.weight_at(out, channel, r, c)]);
                    }
                }
            }
            sum
        };
        let results = places(found.len(), rng).into_iter().filter_map(|at| {
            let mut sum = y_of(at);
            let error = sum.error(found[at], precision);
            // Below 0 it is 0, and what is near 0 may be either.
            sum.value = sum.value.max(0.0);
            let cut = sum.error(found[at], precision);
            Some(cut?.min(error?))
        });
        let mut error = results.fold(0.0, worse);
        let mut of = |var: &Var, sum_of: &dyn Fn(usize) -> Sum, precision| -> anyhow::Result<()> {
            let missing = || anyhow::anyhow!("a convolution without a gradient");
            let found = flat(gradients.get(var).ok_or_else(missing)?)?;
            let places = places(found.len(), rng);
            error = worse(error, worst(&found, &places, sum_of, precision));
            Ok(())
        };
        of(&weight, &w_of, precision)?;
        // Sums of gradients are no products, and f32 in either precision.
        of(&bias, &b_of, Precision::F32)?;
        if let Images::Floats(_) = self.images {
            of(&images, &x_of, precision)?;
        }
        Ok(error)
    }

    fn shown(&self) -> String {
        let images = match &self.images {
            Images::Bytes(x) => format!("bytes {:?}", &x[..x.len().min(6)]),
            Images::Floats(x) => format!("x {}", shown(x)),
        };
        let Picture { side, kernel, .. } = self.picture;
        format!(
            "side {side}, kernel {kernel}, {images}, w {}",
            shown(&self.w)
        )
    }
}

pub(super) fn check(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Vec<Row>> {
    let mut floats = row(
        precision,
        "convolution with ReLU, results and gradients, drawn",
    );
    let mut bytes = row(precision, "the same on bytes 0 to 255");
    let mut real = row(
        precision,
        "both at the sizes of Procgen's network, 32 images, 4,000 places of each tensor",
    );
    let edges = |count: usize, rng: &mut ChaCha8Rng| moderate(finites(count, rng));
    let usual = |count: usize, rng: &mut ChaCha8Rng| {
        (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
    };
    context.draw(0.02, |_, rng| {
        let picture = Picture::drawn(rng);
        for (row, with_bytes) in [(&mut floats, false), (&mut bytes, true)] {
            let case = Case::drawn(picture, with_bytes, rng, edges);
            row.see(case.error(precision, rng)?, || case.shown());
        }
        Ok(())
    })?;
    for picture in REAL {
        for with_bytes in [false, true] {
            for moderately in [false, true] {
                let rng = &mut context.rng;
                let case = match moderately {
                    true => Case::drawn(picture, with_bytes, rng, usual),
                    false => Case::drawn(picture, with_bytes, rng, edges),
                };
                real.see(case.error(precision, rng)?, || case.shown());
            }
        }
        context.progress.advance(0)?;
    }
    Ok(vec![floats, bytes, real])
}
