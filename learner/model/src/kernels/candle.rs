//! The network's layers as compositions of candle's operations, for devices without kernels of this project.
//! Arguments, results and gradients are those of `conv`, `linear`, `impala`, `grouped` and `dots`. Only those modules check shapes.
//!
//! candle's convolution has a naive backward pass on every device. Here a convolution is a matrix product of
//! patches with the kernel, so its gradients are matrix products too.

use candle_core::{DType, Result, Tensor};

use crate::geometry::{STAGE_CONVOLUTIONS, pooled_size};

/// Weight [out, in, k, k], bias [out] and stride of a convolution.
pub(crate) type ConvLayerTensors<'a> = (&'a Tensor, &'a Tensor, usize);

/// Weight [out, in, 3, 3] and bias [out] of a convolution with zero padding.
pub(crate) type BorderedTensors<'a> = (&'a Tensor, &'a Tensor);

/// As `conv::conv_stack`: images [B, H, W, C] to maps [B, h, w, c].
pub(crate) fn conv_stack(images: &Tensor, layers: &[ConvLayerTensors<'_>]) -> Result<Tensor> {
    let mut maps = scale_pixels(images)?;
    for &(weight, bias, stride) in layers {
        maps = relu(&conv2d(&maps, weight, bias, stride)?)?;
    }
    Ok(maps)
}

/// Scales bytes to floats from 0 to 1, and returns floats unchanged.
fn scale_pixels(images: &Tensor) -> Result<Tensor> {
    match images.dtype() {
        DType::U8 => images.to_dtype(DType::F32)?.affine(1.0 / 255.0, 0.0),
        _ => Ok(images.clone()),
    }
}

/// As `impala::residual_stages`: images [B, H, W, C] to f3 [B, h, w, c].
pub(crate) fn residual_stages(images: &Tensor, layers: &[BorderedTensors<'_>]) -> Result<Tensor> {
    let mut x = scale_pixels(images)?;
    for stage in layers.chunks_exact(STAGE_CONVOLUTIONS) {
        x = max_pool(&padded_conv2d(&x, stage[0])?)?;
        for block in stage[1..].chunks_exact(2) {
            let inner = padded_conv2d(&relu(&x)?, block[0])?;
            x = (x + padded_conv2d(&relu(&inner)?, block[1])?)?;
        }
    }
    relu(&x)
}

/// A 3 x 3 convolution of images [B, H, W, in] with zero padding, without ReLU.
fn padded_conv2d(images: &Tensor, (weight, bias): BorderedTensors<'_>) -> Result<Tensor> {
    let images = images.pad_with_zeros(1, 1, 1)?.pad_with_zeros(2, 1, 1)?;
    conv2d(&images, weight, bias, 1)
}

/// As `pool::pool`: a 3 x 3 max pool of stride 2 on maps [B, H, W, C]. Of equal values the first is taken.
///
/// The maps, padded with minus infinity, are cut into blocks of 2 x 2 pixels. Pixel (row, col) of every
/// window then has the same place in its block. A window touches four neighbouring blocks.
fn max_pool(maps: &Tensor) -> Result<Tensor> {
    let (batch, height, width, channels) = maps.dims4()?;
    let (rows, cols, _) = pooled_size((height, width, channels));
    let pad = |maps: &Tensor, dim: usize, before: usize, after: usize| {
        let padding = |len: usize| {
            let mut shape = maps.dims().to_vec();
            shape[dim] = len;
            Tensor::full(f32::NEG_INFINITY, shape, maps.device())?.to_dtype(maps.dtype())
        };
        Tensor::cat(&[&padding(before)?, maps, &padding(after)?], dim)
    };
    let maps = pad(maps, 1, 1, 2 * rows + 1 - height)?;
    let maps = pad(&maps, 2, 1, 2 * cols + 1 - width)?;
    let blocks = maps.reshape(vec![batch, rows + 1, 2, cols + 1, 2, channels])?;
    let pixel = |row: usize, col: usize| {
        let select = |blocks: &Tensor, dim: usize, at: usize, len: usize| {
            blocks.narrow(dim, at / 2, len)?.narrow(dim + 1, at % 2, 1)
        };
        let pixel = select(&select(&blocks, 1, row, rows)?, 3, col, cols)?;
        pixel.reshape((batch, rows, cols, channels))
    };
    let mut largest = pixel(0, 0)?;
    for at in 1..9 {
        let next = pixel(at / 3, at % 3)?;
        let is_larger = next.gt(&largest)?.add(&next.ne(&next)?)?;
        largest = is_larger.where_cond(&next, &largest)?;
    }
    Ok(largest)
}

/// As `linear::linear`: x [..., in], w [out, in], b [groups..., out].
pub(crate) fn linear(x: &Tensor, w: &Tensor, b: &Tensor) -> Result<Tensor> {
    let (outputs, inputs) = w.dims2()?;
    let rows = x.elem_count() / inputs;
    let groups = b.elem_count() / outputs;
    let y = x
        .reshape((rows, inputs))?
        .matmul(&w.contiguous()?.t()?)?
        .reshape((groups, rows / groups, outputs))?
        .broadcast_add(&b.reshape((groups, 1, outputs))?)?;
    let mut shape = x.dims().to_vec();
    if let Some(last) = shape.last_mut() {
        *last = outputs;
    }
    y.reshape(shape)
}

/// As `grouped::grouped_linear`: computes the whole layer and keeps one group per row.
pub(crate) fn grouped_linear(
    x: &Tensor,
    w: &Tensor,
    b: &Tensor,
    groups: &[u8],
    out: usize,
) -> Result<Tensor> {
    let rows = x.dim(0)?;
    let groups = groups.iter().map(|&group| u32::from(group)).collect();
    let groups = Tensor::from_vec(groups, (rows, 1, 1), x.device())?
        .broadcast_as((rows, 1, out))?
        .contiguous()?;
    let all = linear(x, w, b)?.reshape((rows, (), out))?;
    all.gather(&groups, 1)?.squeeze(1)
}

/// max(x, 0). Its gradient at exactly 0 is 0, unlike that of candle's `relu`. It keeps NaN.
pub(crate) fn relu(x: &Tensor) -> Result<Tensor> {
    x.le(0f32)?.where_cond(&x.zeros_like()?, x)
}

/// As `dots::dot_products`: psi and phi [B, L, R] or [B, R] to [L, B, B].
pub(crate) fn dot_products(psi: &Tensor, phi: &Tensor) -> Result<Tensor> {
    let by_location = |vectors: &Tensor| match vectors.rank() {
        3 => vectors.transpose(0, 1)?.contiguous(),
        _ => vectors.unsqueeze(0),
    };
    let phi = by_location(phi)?.t()?.contiguous()?;
    by_location(psi)?.broadcast_matmul(&phi)
}

/// Images [B, H, W, in] to [B, h, w, out], without ReLU. Zeros complete the kernel to whole strides, and images to the patches' size.
fn conv2d(images: &Tensor, weight: &Tensor, bias: &Tensor, stride: usize) -> Result<Tensor> {
    let (batch, height, width, _) = images.dims4()?;
    let (outputs, _, kernel, _) = weight.dims4()?;
    let (blocks, out) = (kernel.div_ceil(stride), |side| (side - kernel) / stride + 1);
    let (rows, cols) = (out(height), out(width));
    let pad = |tensor: &Tensor, dims: [usize; 2], zeros: [usize; 2]| {
        let padded = tensor.pad_with_zeros(dims[0], 0, zeros[0])?;
        padded.pad_with_zeros(dims[1], 0, zeros[1])
    };
    let weight = pad(weight, [2, 3], [blocks * stride - kernel; 2])?;
    let missing = |out: usize, side| ((out + blocks - 1) * stride).saturating_sub(side);
    let images = pad(
        images,
        [1, 2],
        [missing(rows, height), missing(cols, width)],
    )?;
    let patches = patches(&images, (rows, cols), blocks, stride)?;
    linear(&patches, &patch_weight(&weight, stride)?, bias)?.reshape((batch, rows, cols, outputs))
}

/// Returns the patches [B * h * w, k * k * c] under each output of a convolution whose kernel is `blocks` strides wide.
///
/// The image is cut into blocks of stride x stride pixels; a patch is `blocks` x `blocks` neighbouring
/// blocks. A patch's scalars are in the order block row, block column, row, column, channel.
fn patches(
    images: &Tensor,
    (rows, cols): (usize, usize),
    blocks: usize,
    stride: usize,
) -> Result<Tensor> {
    let (batch, _, _, channels) = images.dims4()?;
    let (block_rows, block_cols) = (rows + blocks - 1, cols + blocks - 1);
    let block_len = stride * stride * channels;
    let blocked = images
        .narrow(1, 0, block_rows * stride)?
        .narrow(2, 0, block_cols * stride)?
        .reshape(vec![
            batch, block_rows, stride, block_cols, stride, channels,
        ])?
        .permute(vec![0, 1, 3, 2, 4, 5])?
        .reshape((batch, block_rows, block_cols, block_len))?;
    let mut neighbours = Vec::with_capacity(blocks * blocks);
    for row in 0..blocks {
        for col in 0..blocks {
            neighbours.push(blocked.narrow(1, row, rows)?.narrow(2, col, cols)?);
        }
    }
    Tensor::cat(&neighbours, 3)?.reshape((batch * rows * cols, blocks * blocks * block_len))
}

/// Reorders a kernel [out, in, k, k] to a matrix [out, k * k * in], in the order of [`patches`].
fn patch_weight(weight: &Tensor, stride: usize) -> Result<Tensor> {
    let (outputs, inputs, kernel, _) = weight.dims4()?;
    let blocks = kernel / stride;
    weight
        .reshape(vec![outputs, inputs, blocks, stride, blocks, stride])?
        .permute(vec![0, 2, 4, 3, 5, 1])?
        .reshape((outputs, kernel * kernel * inputs))
}
