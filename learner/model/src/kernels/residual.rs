//! A residual block, out(relu(hidden(x))) + skip(x), as one candle operation with gradients.
//! This module knows no actions and no feature levels, and runs on the CPU only.
//!
//! As three candle layers, the block would pass gradients through candle, which adds each one to fresh zeros
//! on a single thread. That includes the two parts of a weight, for x and for the joined input.

use candle_core::{Result, Tensor, bail};

use crate::gradients::accumulate_in_place;
use crate::kernels::buffer::Buffer;
use crate::kernels::isa::Mode;
use crate::kernels::linear::{add_rows, add_to_sum, group_sums, relu_gradient, relu_in_place};
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::panels::Matrix;
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::tensors::{Input, values_of};

/// The parameters of a block on x, or on x with `joined` appended to each row.
#[derive(Clone, Debug)]
pub(crate) struct BlockParameters {
    /// [hidden, features + joined]
    pub(crate) hidden_weight: Tensor,
    /// [hidden]
    pub(crate) hidden_bias: Tensor,
    /// [outputs, hidden]
    pub(crate) out_weight: Tensor,
    /// [outputs, features + joined]
    pub(crate) skip_weight: Tensor,
    /// The biases of `out` and, if it has one, of `skip`, [outputs] each. The block adds them up.
    pub(crate) out_biases: Vec<Tensor>,
}

/// Computes `out(relu(hidden([x, joined]))) + skip([x, joined])`, [..., outputs], of x [..., features].
///
/// Each row of `joined` [groups, joined] serves an equal share of consecutive rows of x, without a copy per row. Gradients of
/// parameters that are variables are summed in place, so only [`backward`](crate::backward) can run the backward pass.
/// Gradients of other parameters are not computed. The bits of results and gradients do not depend on the number of threads.
pub(crate) fn residual_block(
    x: &Tensor,
    joined: Option<&Tensor>,
    parameters: &BlockParameters,
    precision: Precision,
) -> Result<Tensor> {
    let features = x.dims().last().copied().unwrap_or(0);
    let rows = x.elem_count() / features.max(1);
    let (hidden, inputs) = parameters.hidden_weight.dims2()?;
    let outputs = parameters.out_weight.dims2()?.0;
    let (groups, joined_width) = match joined {
        Some(joined) => joined.dims2()?,
        None => (1, 0),
    };
    let is_bias = |bias: &Tensor| bias.dims() == [outputs];
    let fits = rows > 0
        && features + joined_width == inputs
        && groups > 0
        && rows.is_multiple_of(groups)
        && parameters.hidden_bias.dims() == [hidden]
        && parameters.out_weight.dims() == [outputs, hidden]
        && parameters.skip_weight.dims() == [outputs, inputs]
        && parameters.out_biases.iter().all(is_bias);
    if !fits {
        bail!("residual block of {x:?} and {joined:?} with {parameters:?}");
    }
    let block = ResidualBlock {
        parameters: parameters.clone(),
        rows,
        groups,
        features,
        joined_width,
        hidden,
        outputs,
        precision,
    };
    let shape = [&x.dims()[..x.rank() - 1], &[outputs]].concat();
    // A parameter as an input ties the result to the backward pass, even if x has no gradient.
    let second = joined.unwrap_or(&parameters.hidden_bias);
    apply_op2(block, [x, second], shape)
}

struct ResidualBlock {
    parameters: BlockParameters,
    rows: usize,
    /// Rows of the joined input; 1 if nothing is joined.
    groups: usize,
    features: usize,
    /// Columns of the joined input; 0 if nothing is joined.
    joined_width: usize,
    hidden: usize,
    outputs: usize,
    precision: Precision,
}

impl ResidualBlock {
    const fn is_joined(&self) -> bool {
        self.joined_width > 0
    }

    /// Splits `weight` [outputs, features + joined] into the columns that multiply x and those that multiply the joined input.
    fn split_weight<'a>(&self, weight: &'a [f32]) -> (Matrix<'a>, Option<Matrix<'a>>) {
        let inputs = self.features + self.joined_width;
        let weight = Matrix::new(weight, weight.len() / inputs, inputs);
        let joined = self
            .is_joined()
            .then(|| weight.columns(self.features..inputs));
        (weight.columns(0..self.features), joined)
    }

    fn product<'a>(&self, a: Matrix<'a>, b: Matrix<'a>) -> Product<'a> {
        Product::new(self.precision, a, b)
    }

    /// Returns the biases [groups, outputs], one for each row of the joined input: `bias` plus that row times its part of a weight.
    fn biases(&self, bias: &[f32], joined: Option<(Matrix<'_>, Matrix<'_>)>) -> Vec<f32> {
        match joined {
            None => bias.to_vec(),
            Some((joined, weight)) => {
                let product = self.product(joined, weight.transposed());
                product.with_biases(bias).to_vec()
            }
        }
    }

    /// Returns `sum` plus the gradient of a weight, whose first columns belong to x and the others to the joined input.
    fn weight_gradient(
        &self,
        sum: Option<Vec<f32>>,
        grad: Matrix<'_>,
        x: Matrix<'_>,
        joined: Option<(Matrix<'_>, Matrix<'_>)>,
    ) -> Vec<f32> {
        let product = self.product(grad.transposed(), x);
        let Some((sums, joined)) = joined else {
            return product.added_to_sum(sum);
        };
        let inputs = self.features + self.joined_width;
        let mut sum = sum.unwrap_or_else(|| vec![0.0; grad.cols * inputs]);
        product.add_to_columns(&mut sum, inputs, 0);
        self.product(sums.transposed(), joined)
            .add_to_columns(&mut sum, inputs, self.features);
        sum
    }
}

/// The inputs are x, and the joined input or, without one, the hidden layer's bias.
impl Operation<2> for ResidualBlock {
    const NAME: &'static str = "residual-block";

    /// relu(hidden([x, joined])) [rows, hidden].
    type Saved = Buffer<f32>;

    fn forward(&self, [x, joined]: [Input<'_>; 2]) -> Result<(Vec<f32>, Self::Saved)> {
        let parameters = &self.parameters;
        let x = Matrix::new(x.floats()?, self.rows, self.features);
        let joined = joined.floats()?;
        let joined = self
            .is_joined()
            .then(|| Matrix::new(joined, self.groups, self.joined_width));

        let weight = values_of(&parameters.hidden_weight)?;
        let (weight, w_joined) = self.split_weight(&weight);
        let biases = self.biases(&values_of(&parameters.hidden_bias)?, joined.zip(w_joined));
        let mut hidden = Buffer::new(self.rows * self.hidden);
        self.product(x, weight.transposed())
            .with_biases(&biases)
            .then(&|_, rows| relu_in_place(rows))
            .write(&mut hidden, Mode::Replace);

        let weight = values_of(&parameters.skip_weight)?;
        let (weight, w_joined) = self.split_weight(&weight);
        let mut bias = vec![0.0; self.outputs];
        for part in &parameters.out_biases {
            add_rows(&mut bias, &values_of(part)?);
        }
        let biases = self.biases(&bias, joined.zip(w_joined));
        let product = self.product(x, weight.transposed());
        let mut y = product.with_biases(&biases).to_vec();
        let weight = values_of(&parameters.out_weight)?;
        let weight = Matrix::new(&weight, self.outputs, self.hidden);
        let active = Matrix::new(&hidden, self.rows, self.hidden);
        self.product(active, weight.transposed())
            .write(&mut y, Mode::Add);
        Ok((y, hidden))
    }

    /// Sums the gradients of the parameters in place.
    fn backward(
        &self,
        [x, joined]: [&Tensor; 2],
        hidden: &Self::Saved,
        _y: &Tensor,
        grad_y: &[f32],
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let grad = Matrix::new(grad_y, self.rows, self.outputs);
        let wanted = [x, joined].map(Tensor::track_op);
        let x = values_of(x)?;
        let x = Matrix::new(&x, self.rows, self.features);
        let parameters = &self.parameters;
        let active = Matrix::new(hidden, self.rows, self.hidden);
        let out_gradient = self.product(grad.transposed(), active);
        accumulate_in_place(&parameters.out_weight, |sum| out_gradient.added_to_sum(sum))?;

        let out = values_of(&parameters.out_weight)?;
        let out = Matrix::new(&out, self.outputs, self.hidden);
        let mut grad_hidden = Buffer::new(self.rows * self.hidden);
        let mask = |first: usize, rows: &mut [f32]| {
            let active = &hidden[first * self.hidden..][..rows.len()];
            for (grad, &active) in rows.iter_mut().zip(active) {
                *grad = relu_gradient(active, *grad);
            }
        };
        self.product(grad, out)
            .then(&mask)
            .write(&mut grad_hidden, Mode::Replace);

        // For each group, the summed gradients of its rows with respect to the hidden layer's biases and the outputs' biases.
        let sum_groups = |grads: &[f32], width: usize| -> Option<Vec<f32>> {
            (self.groups < self.rows).then(|| group_sums(grads, self.groups, width))
        };
        let hidden_sums = sum_groups(&grad_hidden, self.hidden);
        let hidden_sums = hidden_sums.as_deref().unwrap_or(&grad_hidden);
        let out_sums = sum_groups(grad_y, self.outputs);
        let out_sums = out_sums.as_deref().unwrap_or(grad_y);

        let joined = values_of(joined)?;
        let joined = self
            .is_joined()
            .then(|| Matrix::new(&joined, self.groups, self.joined_width));
        let hidden_weight = values_of(&parameters.hidden_weight)?;
        let skip_weight = values_of(&parameters.skip_weight)?;
        let mut gradients = [None, None];
        let layers = [
            (&parameters.skip_weight, &skip_weight, grad, out_sums),
            (
                &parameters.hidden_weight,
                &hidden_weight,
                Matrix::new(&grad_hidden, self.rows, self.hidden),
                hidden_sums,
            ),
        ];
        for (weight, values, grad, sums) in layers {
            let sums = Matrix::new(sums, self.groups, grad.cols);
            accumulate_in_place(weight, |sum| {
                self.weight_gradient(sum, grad, x, joined.map(|it| (sums, it)))
            })?;
            let (w_x, w_joined) = self.split_weight(values);
            let parts = [Some((grad, w_x)), w_joined.map(|weight| (sums, weight))];
            for ((gradient, part), wanted) in gradients.iter_mut().zip(parts).zip(wanted) {
                if let Some((grad, weight)) = part.filter(|_| wanted) {
                    *gradient = Some(self.product(grad, weight).added_to_sum(gradient.take()));
                }
            }
        }
        let sum_rows = |sums: &[f32], width| group_sums(sums, 1, width);
        let hidden_bias = sum_rows(hidden_sums, self.hidden);
        accumulate_in_place(&parameters.hidden_bias, |sum| add_to_sum(sum, hidden_bias))?;
        let out_bias = sum_rows(out_sums, self.outputs);
        for bias in &parameters.out_biases {
            accumulate_in_place(bias, |sum| add_to_sum(sum, out_bias.clone()))?;
        }
        Ok(gradients)
    }
}
