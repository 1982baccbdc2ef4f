//! The convolution, forward and backward, against candle's own, for the network's first layers at batch 256.
//! Whole networks are measured by `driml bench learner` and `driml bench policy`.
#![allow(clippy::unwrap_used, missing_docs)]

use candle_core::{DType, Device, Result, Tensor, Var};
use criterion::{Criterion, criterion_group, criterion_main};
use driml_model::{Precision, conv2d_relu};

const BATCH: usize = 256;

/// A layer: height, width, channels in, channels out, kernel, stride, and whether its input is a frame.
const LAYERS: [(&str, [usize; 6], bool); 4] = [
    ("conv1 64x64x3", [64, 64, 3, 32, 8, 4], true),
    ("conv1 104x80x3", [104, 80, 3, 32, 8, 4], true),
    ("conv2 15x15x32", [15, 15, 32, 64, 4, 2], false),
    ("conv3 6x6x64", [6, 6, 64, 64, 3, 1], false),
];

fn values(len: usize, scale: f32) -> Vec<f32> {
    (0..len)
        .map(|index| ((index * 7919 % 1009) as f32 / 1009.0 - 0.5) * scale)
        .collect()
}

fn f32(images: &Tensor, weight: &Tensor, bias: &Tensor, stride: usize) -> Result<Tensor> {
    conv2d_relu(images, weight, bias, stride, Precision::F32)
}

fn bf16(images: &Tensor, weight: &Tensor, bias: &Tensor, stride: usize) -> Result<Tensor> {
    conv2d_relu(images, weight, bias, stride, Precision::Bf16)
}

fn stock(images: &Tensor, weight: &Tensor, bias: &Tensor, stride: usize) -> Result<Tensor> {
    let images = if images.dtype() == DType::U8 {
        (images.to_dtype(DType::F32)? / 255.0)?
    } else {
        images.clone()
    };
    let maps = images
        .permute((0, 3, 1, 2))?
        .contiguous()?
        .conv2d(weight, 0, stride, 1, 1)?;
    maps.broadcast_add(&bias.reshape((1, (), 1, 1))?)?.relu()
}

fn layers(criterion: &mut Criterion) {
    for (name, [height, width, channels_in, channels_out, kernel, stride], frames) in LAYERS {
        let shape = (BATCH, height, width, channels_in);
        let len = BATCH * height * width * channels_in;
        let device = &Device::Cpu;
        let images = if frames {
            Tensor::from_vec(
                (0..len).map(|index| (index * 31 % 256) as u8).collect(),
                shape,
                device,
            )
            .unwrap()
        } else {
            Var::from_vec(values(len, 1.0), shape, device)
                .unwrap()
                .as_tensor()
                .clone()
        };
        let weight_shape = (channels_out, channels_in, kernel, kernel);
        let weight = Var::from_vec(
            values(weight_shape.0 * channels_in * kernel * kernel, 0.1),
            weight_shape,
            device,
        );
        let (weight, bias) = (
            weight.unwrap(),
            Var::zeros(channels_out, DType::F32, device).unwrap(),
        );

        let mut group = criterion.benchmark_group(name);
        group.sample_size(10);
        type Layer = fn(&Tensor, &Tensor, &Tensor, usize) -> Result<Tensor>;
        for (which, layer) in [
            ("f32", f32 as Layer),
            ("bf16", bf16 as Layer),
            ("candle", stock as Layer),
        ] {
            group.bench_function(format!("{which} forward"), |bencher| {
                bencher.iter(|| layer(&images, &weight, &bias, stride).unwrap());
            });
            group.bench_function(format!("{which} forward and backward"), |bencher| {
                bencher.iter(|| {
                    let maps = layer(&images, &weight, &bias, stride).unwrap();
                    maps.sum_all().unwrap().backward().unwrap()
                });
            });
        }
        group.finish();
    }
}

criterion_group!(benches, layers);
criterion_main!(benches);
