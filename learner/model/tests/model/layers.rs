//! Convolutions, the fully connected layer and ReLU: wrong shapes, gradients at exactly zero, and values that are not finite.
//! The property "products" of `driml experiment stability` compares results and gradients with candle's in f64.

use candle_core::{DType, Device, Result, Tensor, Var};
use driml_model::{Precision, conv_stack, linear, relu};

use crate::support::{double, floats, rng, values};

#[test]
fn relu_passes_no_gradient_at_exactly_zero() -> Result<()> {
    let x = Var::new(&[-1.0, 0.0, -0.0, 2.0, f32::NEG_INFINITY], &Device::Cpu)?;
    let y = relu(&x)?;
    assert_eq!(values(&y), [0.0, 0.0, 0.0, 2.0, 0.0]);
    let grads = (y * 3.0)?.sum_all()?.backward()?;
    assert_eq!(values(grads.get(&x).unwrap()), [0.0, 0.0, 0.0, 3.0, 0.0]);
    Ok(())
}

#[test]
fn a_convolution_passes_no_gradient_where_it_is_exactly_zero() -> Result<()> {
    let images = Var::zeros((1, 2, 2, 1), DType::F32, &Device::Cpu)?;
    let weight = Var::ones((1, 1, 2, 2), DType::F32, &Device::Cpu)?;
    let bias = Var::zeros(1, DType::F32, &Device::Cpu)?;
    let layer = (weight.as_tensor(), bias.as_tensor(), 1);
    let grads = conv_stack(&images, &[layer], Precision::F32)?
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
            let bad = image(index)?;
            assert!(bad.iter().all(|value| value.is_nan()), "{precision}");
        }
    }
    Ok(())
}

#[test]
fn layers_of_shapes_that_do_not_match_are_errors() {
    let rng = &mut rng(3);
    let x = floats(&[6, 5], rng);
    let w = floats(&[7, 5], rng);
    let b = floats(&[7], rng);
    assert!(linear(&x, &w, &b, Precision::F32).is_ok());
    assert!(linear(&x, &w, &floats(&[6], rng), Precision::F32).is_err());
    assert!(linear(&x, &floats(&[7, 4], rng), &b, Precision::F32).is_err());
    assert!(linear(&double(&x).unwrap(), &w, &b, Precision::F32).is_err());
}

#[test]
fn convolutions_of_shapes_that_do_not_match_are_errors() {
    let rng = &mut rng(4);
    let images = floats(&[2, 6, 6, 3], rng);
    let weight = floats(&[4, 3, 3, 3], rng);
    let bias = floats(&[4], rng);
    let fails = |images: &Tensor, weight: &Tensor, bias: &Tensor, stride| {
        assert!(conv_stack(images, &[(weight, bias, stride)], Precision::F32).is_err());
    };
    assert!(conv_stack(&images, &[(&weight, &bias, 1)], Precision::F32).is_ok());
    fails(&images, &weight, &bias, 0);
    fails(&images, &floats(&[4, 2, 3, 3], rng), &bias, 1);
    fails(&images, &floats(&[4, 3, 3, 2], rng), &bias, 1);
    fails(&images, &floats(&[4, 3, 7, 7], rng), &bias, 1);
    fails(&images, &weight, &floats(&[3], rng), 1);
    fails(&double(&images).unwrap(), &weight, &bias, 1);
    fails(&floats(&[6, 6, 3], rng), &weight, &bias, 1);
    assert!(conv_stack(&images, &[], Precision::F32).is_err());
}
