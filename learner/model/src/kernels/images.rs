//! Inputs of convolutions: images and maps as they are stored, and one by one as operands of products.

use crate::kernels::buffer::Buffer;
use crate::kernels::isa::{Element, Simd};
use crate::kernels::rounding::{store, store_bytes, store_steps};

/// Stored images [n, height, width, channels_in].
#[derive(Clone, Copy)]
pub(crate) enum Pixels<'a> {
    /// Bytes that stand for byte / 255.
    Bytes(&'a [u8]),
    Floats(&'a [f32]),
}

impl Pixels<'_> {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Bytes(bytes) => bytes.len(),
            Self::Floats(floats) => floats.len(),
        }
    }

    /// Returns the scalars `range` of all images.
    pub(crate) fn slice(&self, range: std::ops::Range<usize>) -> Self {
        match self {
            Self::Bytes(bytes) => Self::Bytes(&bytes[range]),
            Self::Floats(floats) => Self::Floats(&floats[range]),
        }
    }
}

#[derive(Clone, Copy)]
pub(crate) enum Images<'a, E> {
    /// Images that are not operands yet. Each is converted when it is needed, and then stays in the L1 cache.
    Pixels(Pixels<'a>),
    Maps(&'a [E]),
}

impl<E: Element> Images<'_, E> {
    /// The factor that a product with these images must be multiplied by.
    pub(crate) const fn scale(&self) -> f32 {
        match self {
            Self::Pixels(Pixels::Bytes(_)) => E::BYTE_SCALE,
            Self::Pixels(Pixels::Floats(_)) | Self::Maps(_) => 1.0,
        }
    }

    /// Returns image `index` as an operand: `len` scalars, then `padding` zeros. `scratch` holds conversions and copies.
    ///
    /// The next image in memory cannot serve as padding: 0 times a NaN in it is NaN.
    pub(crate) fn image<'r, S: Simd<Element = E>>(
        &'r self,
        simd: S,
        index: usize,
        (len, padding): (usize, usize),
        scratch: &'r mut Scratch<E>,
    ) -> &'r [E] {
        let range = index * len..(index + 1) * len;
        if let (Self::Maps(maps), 0) = (self, padding) {
            return &maps[range];
        }
        let operand = scratch.get_or_insert_with(|| Buffer::new(len + padding));
        operand[len..].fill(E::default());
        let image = &mut operand[..len];
        match self {
            Self::Maps(maps) => image.copy_from_slice(&maps[range]),
            Self::Pixels(Pixels::Bytes(bytes)) => store_bytes(simd, &bytes[range], image),
            Self::Pixels(Pixels::Floats(floats)) => store(simd, &floats[range], image),
        }
        operand
    }

    /// Returns image `index` as the operand of a sum over windows. If `DEPTH` is 2, each of its `len` scalars
    /// is paired with the one `shift` further, or with 0 beyond the end.
    pub(crate) fn steps<'r, S: Simd<Element = E>>(
        &'r self,
        simd: S,
        index: usize,
        (len, shift): (usize, usize),
        [scratch, image_scratch]: &'r mut [Scratch<E>; 2],
    ) -> &'r [E] {
        let image = self.image(simd, index, (len, 0), image_scratch);
        if E::DEPTH == 1 {
            return image;
        }
        let steps = scratch.get_or_insert_with(|| Buffer::new(len * E::DEPTH));
        store_steps(simd, image, shift, steps);
        steps
    }
}

/// Scratch memory for one image at a time, with old content. All images have the same length.
pub(crate) type Scratch<E> = Option<Buffer<E>>;
