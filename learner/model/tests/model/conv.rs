//! The convolution compared with candle's own, computed in f64.
//! The benches measure its speed.

use candle_core::{DType, Device, Result, Tensor, Var};
use driml_model::{Precision, conv_stack, conv2d_relu};

use crate::support::{assert_layer, bytes, double, floats, rng, rounded, values, variable};

/// Images [batch, height, width, channels], output channels, kernel, stride.
type Shape = ([usize; 4], usize, usize, usize);

const SHAPES: [Shape; 8] = [
    ([1, 9, 7, 1], 1, 3, 2),
    ([3, 11, 13, 3], 5, 4, 3),
    ([7, 8, 8, 2], 17, 8, 4),
    ([7, 5, 6, 4], 3, 1, 1),
    ([3, 21, 19, 12], 6, 5, 2),
    ([1, 64, 64, 3], 32, 8, 4),
    ([33, 15, 15, 8], 16, 4, 2),
    ([17, 6, 6, 16], 16, 3, 1),
];

/// Computes relu(conv2d + bias) of channels-last images with candle's operations.
///
/// Pixels that no window covers are cut off first, because candle's backward pass fails on them.
fn candle_conv(images: &Tensor, weight: &Tensor, bias: &Tensor, stride: usize) -> Result<Tensor> {
    let covered = |size: usize, kernel: usize| (size - kernel) / stride * stride + kernel;
    let height = covered(images.dim(1)?, weight.dim(2)?);
    let width = covered(images.dim(2)?, weight.dim(3)?);
    let images = images.narrow(1, 0, height)?.narrow(2, 0, width)?;
    let maps = images
        .permute((0, 3, 1, 2))?
        .contiguous()?
        .conv2d(weight, 0, stride, 1, 1)?;
    maps.permute((0, 2, 3, 1))?.broadcast_add(bias)?.relu()
}

/// Operands that are bf16 already are not rounded, so bf16 results are as exact as in f32.
#[test]
fn images_of_floats_and_of_bytes_match_candle_forward_and_backward() -> Result<()> {
    let rng = &mut rng(2);
    let each = Precision::ALL
        .into_iter()
        .flat_map(|precision| SHAPES.map(|shape| (precision, shape)));
    for (precision, (images, out, kernel, stride)) in each {
        let what = format!("{precision}, images {images:?}");
        let weight = rounded(&variable(&[out, images[3], kernel, kernel], rng), precision);
        let bias = variable(&[out], rng);
        let floats = rounded(&variable(&images, rng), precision);
        assert_layer(
            &what,
            &[floats, weight.clone(), bias.clone()],
            precision,
            rng,
            |args| conv2d_relu(&args[0], &args[1], &args[2], stride, precision),
            |args| candle_conv(&args[0], &args[1], &args[2], stride),
        )?;
        let bytes = bytes(images.iter().product(), rng);
        let bytes = Var::from_tensor(&Tensor::from_vec(bytes, &images[..], &Device::Cpu)?)?;
        let scaled = (double(&bytes)? / 255.0)?;
        assert_layer(
            &format!("{what} of bytes"),
            &[weight.clone(), bias.clone()],
            precision,
            rng,
            |args| conv2d_relu(&bytes, &args[0], &args[1], stride, precision),
            |args| candle_conv(&scaled, &args[0], &args[1], stride),
        )?;
        let maps = conv2d_relu(&bytes, &weight, &bias, stride, precision)?;
        let gradients = maps.sum_all()?.backward()?;
        assert!(
            gradients.get(&bytes).is_none(),
            "an image needs no gradient"
        );
    }
    Ok(())
}

#[test]
fn relu_passes_no_gradient_at_exactly_zero() -> Result<()> {
    let images = Var::zeros((1, 2, 2, 1), DType::F32, &Device::Cpu)?;
    let weight = Var::ones((1, 1, 2, 2), DType::F32, &Device::Cpu)?;
    let bias = Var::zeros(1, DType::F32, &Device::Cpu)?;
    let grads = conv2d_relu(&images, &weight, &bias, 1, Precision::F32)?
        .sum_all()?
        .backward()?;
    for var in [&images, &weight, &bias] {
        let grads = values(grads.get(var).unwrap());
        assert!(grads.iter().all(|&grad| grad == 0.0));
    }
    Ok(())
}

#[test]
fn a_nan_stays_in_its_image() -> Result<()> {
    // Odd runs: the last step of a window reads one scalar beyond it.
    let shapes = [([5, 3, 3, 3], 1), ([7, 5, 3, 3], 2), ([1, 7, 1, 1], 1)];
    let rng = &mut rng(6);
    let layers =
        shapes.map(|(shape, stride)| (floats(&shape, rng), floats(&shape[..1], rng), stride));
    let layers = layers
        .each_ref()
        .map(|(weight, bias, stride)| (weight, bias, *stride));
    let good = floats(&[1, 9, 9, 3], rng);
    let nan = good.ones_like()?.affine(0.0, f64::NAN)?;
    for precision in Precision::ALL {
        let alone = conv_stack(&good, &layers, precision)?;
        let among = Tensor::cat(&[&nan, &good, &nan], 0)?;
        let among = conv_stack(&among, &layers, precision)?;
        let image = |index| among.narrow(0, index, 1).map(|image| values(&image));
        assert_eq!(image(1)?, values(&alone), "{precision}");
        for index in [0, 2] {
            assert!(
                image(index)?.iter().all(|value| value.is_nan()),
                "{precision}"
            );
        }
    }
    Ok(())
}

#[test]
fn shapes_that_do_not_match_are_errors() {
    let rng = &mut rng(4);
    let images = floats(&[2, 6, 6, 3], rng);
    let weight = floats(&[4, 3, 3, 3], rng);
    let bias = floats(&[4], rng);
    let fails = |images: &Tensor, weight: &Tensor, bias: &Tensor, stride| {
        assert!(conv2d_relu(images, weight, bias, stride, Precision::F32).is_err());
    };
    assert!(conv2d_relu(&images, &weight, &bias, 1, Precision::F32).is_ok());
    fails(&images, &weight, &bias, 0);
    fails(&images, &floats(&[4, 2, 3, 3], rng), &bias, 1);
    fails(&images, &floats(&[4, 3, 3, 2], rng), &bias, 1);
    fails(&images, &floats(&[4, 3, 7, 7], rng), &bias, 1);
    fails(&images, &weight, &floats(&[3], rng), 1);
    fails(&double(&images).unwrap(), &weight, &bias, 1);
    fails(&floats(&[6, 6, 3], rng), &weight, &bias, 1);
    assert!(conv_stack(&images, &[], Precision::F32).is_err());
}
