//! Tests of `conv` and `impala`: convolutions of a task on every instruction set against candle's operations and derivatives in f64.
//! `driml experiment stability` compares single layers with candle's.
#![cfg(test)]

use candle_core::{DType, Device, Result, Tensor, Var};

use crate::geometry::{ConvLayer, ConvShape, stage_shapes};
use crate::kernels::candle;
use crate::kernels::conv::Stack;
use crate::kernels::images::Pixels;
use crate::kernels::impala::Stages;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::precision::Precision;
use crate::kernels::tasks::{
    parameters_len, split_parameters, split_parameters_mut, unpack_weights,
};

/// Images of a task.
const COUNT: usize = 3;

/// The 2-norm of the difference, relative to the 2-norm of `wanted`.
fn relative_error<T: Copy + Into<f64>>(found: &[f32], wanted: &[T]) -> f64 {
    assert_eq!(found.len(), wanted.len());
    let (mut error, mut size) = (0f64, 0f64);
    for (&found, &wanted) in found.iter().zip(wanted) {
        let wanted: f64 = wanted.into();
        error += (f64::from(found) - wanted).powi(2);
        size += wanted.powi(2);
    }
    assert!(size > 0.0);
    (error / size).sqrt()
}

fn values(len: usize, by: usize, scale: f32) -> Vec<f32> {
    let value = |at: usize| ((at * by % 1009) as f32 / 504.0 - 1.0) * scale;
    (0..len).map(value).collect()
}

struct Case<'a> {
    precision: Precision,
    /// Whether the convolutions are those of residual stages.
    is_residual: bool,
    shapes: &'a [ConvShape],
    images: Pixels<'a>,
}

impl Case<'_> {
    /// Returns the parameters. In bf16, biases of 3 and -3 keep sums far from 0, so that rounding changes no ReLU.
    fn parameters(&self) -> Vec<f32> {
        let scale = match self.precision {
            Precision::Bf16 => 0.1,
            Precision::F32 if self.is_residual => 0.4,
            Precision::F32 => 0.2,
        };
        let mut parameters = values(parameters_len(self.shapes), 383, scale);
        if self.precision == Precision::Bf16 {
            for [_, bias] in split_parameters_mut(self.shapes, &mut parameters) {
                let signs = [3.0, -3.0].into_iter().cycle();
                bias.iter_mut().zip(signs).for_each(|(it, far)| *it = far);
            }
        }
        parameters
    }

    fn grad_maps(&self) -> Vec<f32> {
        let last = &self.shapes[self.shapes.len() - 1];
        values(COUNT * last.map_len(), 571, 1.0)
    }

    /// Returns the maps, and the gradients of the parameters and, for plain convolutions, of the images.
    fn run_on<S: Simd>(&self, simd: S) -> Vec<Vec<f32>> {
        let (shapes, parameters, grad_maps) = (self.shapes, self.parameters(), self.grad_maps());
        let mut maps = vec![f32::NAN; grad_maps.len()];
        if let (true, Pixels::Bytes(images)) = (self.is_residual, self.images) {
            let stages = Stages::new(simd, shapes, &parameters, true);
            let mut tape = stages.allocate_tape(COUNT);
            stages.forward(images, &mut tape, &mut maps);
            let sums = stages.backward(images, &tape, &maps, &grad_maps);
            return vec![maps, unpack_weights(shapes, &sums)];
        }
        let stack = Stack::new(simd, shapes, &parameters, true, true);
        let images = self.images;
        let saved = stack.forward(images, &mut maps);
        let mut grad_images = vec![0.0; images.len()];
        let to = Some(&mut grad_images[..]);
        let sums = stack.backward(images, &saved, &maps, &grad_maps, to);
        vec![maps, unpack_weights(shapes, &sums), grad_images]
    }

    /// Computes the same with candle, always with the gradients of the images.
    fn reference(&self) -> Result<Vec<Vec<f64>>> {
        let images: Vec<f64> = match self.images {
            Pixels::Bytes(bytes) => bytes.iter().map(|&it| f64::from(it) / 255.0).collect(),
            Pixels::Floats(floats) => floats.iter().map(|&it| it.into()).collect(),
        };
        let (first, border) = (&self.shapes[0], if self.is_residual { 2 } else { 0 });
        let (height, width) = (first.height - border, first.width - border);
        let size = (COUNT, height, width, first.channels_in);
        let images = Var::from_vec(images, size, &Device::Cpu)?;
        let (mut vars, parameters) = (Vec::new(), self.parameters());
        let parts = split_parameters(self.shapes, &parameters);
        for (shape, [weight, bias]) in self.shapes.iter().zip(parts) {
            let (out, inputs, side) = (shape.channels_out, shape.channels_in, shape.kernel);
            for (part, size) in [(weight, &[out, inputs, side, side][..]), (bias, &[out])] {
                let part: Vec<f64> = part.iter().map(|&it| it.into()).collect();
                vars.push(Var::from_vec(part, size, &Device::Cpu)?);
            }
        }
        let layers = self.shapes.iter().zip(vars.chunks(2));
        let layers = layers.map(|(shape, it)| (it[0].as_tensor(), it[1].as_tensor(), shape.stride));
        let maps = if self.is_residual {
            let layers = layers.map(|(weight, bias, _)| (weight, bias));
            candle::residual_stages(&images, &layers.collect::<Vec<_>>())?
        } else {
            candle::conv_stack(&images, &layers.collect::<Vec<_>>())?
        };
        let slope = Tensor::from_vec(self.grad_maps(), maps.dims(), &Device::Cpu)?;
        let loss = (&maps * slope.to_dtype(DType::F64)?)?.sum_all()?;
        let gradients = loss.backward()?;
        let values = |of: &Tensor| of.flatten_all()?.to_vec1::<f64>();
        let mut parameter_gradients = Vec::new();
        for var in &vars {
            parameter_gradients.extend(values(gradients.get(var).unwrap())?);
        }
        let image_gradients = values(gradients.get(&images).unwrap())?;
        Ok(vec![values(&maps)?, parameter_gradients, image_gradients])
    }
}

#[test]
fn every_instruction_set_gives_what_candle_does_in_f64() -> Result<()> {
    // Sizes that fill no register: odd runs, odd numbers of windows, channels beyond a panel.
    let mut input = (17, 23, 3);
    let plain = [(5, 3, 2), (70, 4, 1), (9, 2, 1)].map(|(out, kernel, stride)| {
        let shape = ConvShape::new(input, ConvLayer::new(out, kernel, stride)).unwrap();
        input = shape.output();
        shape
    });
    // Odd runs, and channels beyond a register; maps of 5 x 7 and 3 x 4.
    let (residual, _) = stage_shapes((9, 14, 3), &[5, 18]);
    let bytes = |len: usize| -> Vec<u8> { (0..len).map(|at| (at * 31 % 253) as u8).collect() };
    let (large, mut small) = (bytes(COUNT * 17 * 23 * 3), bytes(COUNT * 9 * 14 * 3));
    // The last image is flat: most windows of the pools have nine equal values.
    small[(COUNT - 1) * 9 * 14 * 3..].fill(77);
    let floats = values(large.len(), 37, 1.0);
    for (is_residual, shapes, images) in [
        (false, &plain[..], Pixels::Floats(&floats)),
        (false, &plain, Pixels::Bytes(&large)),
        (true, &residual, Pixels::Bytes(&small)),
    ] {
        for precision in Precision::ALL {
            let case = Case {
                precision,
                is_residual,
                shapes,
                images,
            };
            let wanted = case.reference()?;
            // Largest distance from the reference, and from the first instruction set's result.
            let (tolerance, between_sets) = match precision {
                Precision::F32 => (3e-6, 3e-6),
                // Pools may choose differently. A sum rounded to the neighbouring bf16 changes what follows by 1/256.
                Precision::Bf16 => (0.03, 1e-2),
            };
            let on = |simd| with_simd!(simd, simd => case.run_on(simd));
            let sets = AnySimd::all_available(precision).into_iter();
            let results: Vec<_> = sets.map(on).collect();
            for found in &results {
                for ((found, first), wanted) in found.iter().zip(&results[0]).zip(&wanted) {
                    let error = relative_error(found, wanted);
                    let from_first = relative_error(found, first);
                    let is_close = error <= tolerance && from_first <= between_sets;
                    assert!(is_close, "{precision}: {error}, {from_first}");
                }
            }
        }
    }
    Ok(())
}
