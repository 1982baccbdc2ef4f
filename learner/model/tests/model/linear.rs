//! The fully connected layer compared with candle's operations in f64, for every way to give its bias; and ReLU at zero.

use candle_core::{Device, Result, Tensor, Var};
use driml_model::{Precision, linear, relu};

use crate::support::{assert_layer, double, floats, rng, rounded, values, variable};

/// Computes the layer with candle's operations: x [rows, in], b [out].
fn candle_linear(x: &Tensor, w: &Tensor, b: &Tensor, with_relu: bool) -> Result<Tensor> {
    let y = x.matmul(&w.t()?)?.broadcast_add(b)?;
    if with_relu { y.relu() } else { Ok(y) }
}

#[test]
fn it_matches_candle_forward_and_backward() -> Result<()> {
    let rng = &mut rng(1);
    let shapes = [
        [1, 1, 1],
        [7, 5, 3],
        [6, 33, 17],
        [520, 12, 40],
        [300, 64, 255],
    ];
    for [rows, inputs, outputs] in shapes {
        for (with_relu, precision) in [false, true]
            .into_iter()
            .flat_map(|with_relu| Precision::ALL.map(|precision| (with_relu, precision)))
        {
            // Operands that are bf16 already are not rounded, so the result is as exact as in f32.
            let args = [
                rounded(&variable(&[rows, inputs], rng), precision),
                rounded(&variable(&[outputs, inputs], rng), precision),
                variable(&[outputs], rng),
            ];
            assert_layer(
                &format!("{precision}, {rows}x{inputs} to {outputs}"),
                &args,
                precision,
                rng,
                |args| {
                    let y = linear(&args[0], &args[1], &args[2], precision)?;
                    if with_relu { relu(&y) } else { Ok(y) }
                },
                |args| candle_linear(&args[0], &args[1], &args[2], with_relu),
            )?;
        }
    }
    Ok(())
}

#[test]
fn leading_dimensions_and_a_plain_bias_are_kept() -> Result<()> {
    let rng = &mut rng(2);
    let x = variable(&[2, 3, 4, 5], rng);
    let w = variable(&[7, 5], rng);
    let b = variable(&[7], rng);
    let y = linear(&x, &w, &b, Precision::F32)?;
    assert_eq!(y.dims(), [2, 3, 4, 7]);
    let flat = linear(&x.reshape((24, 5))?, &w, &b, Precision::F32)?;
    assert_eq!(values(&y), values(&flat));
    let grads = y.sqr()?.sum_all()?.backward()?;
    for var in [&x, &w, &b] {
        assert_eq!(grads.get(var).unwrap().dims(), var.dims());
    }
    Ok(())
}

#[test]
fn relu_passes_no_gradient_at_exactly_zero() -> Result<()> {
    let x = Var::new(&[-1.0f32, 0.0, -0.0, 2.0], &Device::Cpu)?;
    let y = relu(&x)?;
    assert_eq!(values(&y), [0.0, 0.0, 0.0, 2.0]);
    let grads = (y * 3.0)?.sum_all()?.backward()?;
    assert_eq!(values(grads.get(&x).unwrap()), [0.0, 0.0, 0.0, 3.0]);
    Ok(())
}

#[test]
fn shapes_that_do_not_match_are_errors() {
    let rng = &mut rng(3);
    let x = floats(&[6, 5], rng);
    let w = floats(&[7, 5], rng);
    let b = floats(&[7], rng);
    assert!(linear(&x, &w, &b, Precision::F32).is_ok());
    assert!(linear(&x, &w, &floats(&[6], rng), Precision::F32).is_err());
    assert!(linear(&x, &floats(&[7, 4], rng), &b, Precision::F32).is_err());
    assert!(linear(&double(&x).unwrap(), &w, &b, Precision::F32).is_err());
}
