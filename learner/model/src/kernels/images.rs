//! Images and maps as convolutions take them: as they are stored, and one by one as operands of products.

use crate::kernels::buffer::Buffer;
use crate::kernels::isa::{Element, Simd};
use crate::kernels::rounding::{store, store_bytes, store_steps_of, store_steps_of_bytes};

/// Images [n, height, width, channels_in], as they are stored.
#[derive(Clone, Copy)]
pub(crate) enum Pixels<'a> {
    /// Scaled by 1/255 when read.
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

    /// The scalars `range` of all images.
    pub(crate) fn slice(&self, range: std::ops::Range<usize>) -> Self {
        match self {
            Self::Bytes(bytes) => Self::Bytes(&bytes[range]),
            Self::Floats(floats) => Self::Floats(&floats[range]),
        }
    }
}

#[derive(Clone, Copy)]
pub(crate) enum Images<'a, E> {
    /// Images that are not operands yet: each becomes one when its turn comes, and stays in the first cache meanwhile.
    Pixels(Pixels<'a>),
    Maps(&'a [E]),
}

impl<E: Element> Images<'_, E> {
    /// What a product with them is multiplied by.
    pub(crate) const fn scale(&self) -> f32 {
        match self {
            Self::Pixels(Pixels::Bytes(_)) => E::BYTE_SCALE,
            Self::Pixels(Pixels::Floats(_)) | Self::Maps(_) => 1.0,
        }
    }

    /// The image with this index as an operand, `len` scalars and `padding` zeros after them; `room` is for those that have to be made.
    ///
    /// What lies behind an image in memory is the next one, which is not padding: 0 times a NaN in it is NaN.
    pub(crate) fn image<'r, S: Simd<Element = E>>(
        &'r self,
        simd: S,
        index: usize,
        (len, padding): (usize, usize),
        room: &'r mut Room<E>,
    ) -> &'r [E] {
        let range = index * len..(index + 1) * len;
        if let (Self::Maps(maps), 0) = (self, padding) {
            return &maps[range];
        }
        let operand = room.of(len + padding);
        operand[len..].fill(E::default());
        let image = &mut operand[..len];
        match self {
            Self::Maps(maps) => image.copy_from_slice(&maps[range]),
            Self::Pixels(Pixels::Bytes(bytes)) => store_bytes(simd, &bytes[range], image),
            Self::Pixels(Pixels::Floats(floats)) => store(simd, &floats[range], image),
        }
        operand
    }

    /// The image with this index as the operand of a sum over windows: each of its `len` scalars with the one `shift` further if
    /// steps are pairs, or with 0 where the image ends before.
    pub(crate) fn steps<'r, S: Simd<Element = E>>(
        &'r self,
        simd: S,
        index: usize,
        (len, shift): (usize, usize),
        [room, single]: &'r mut [Room<E>; 2],
    ) -> &'r [E] {
        let range = index * len..(index + 1) * len;
        if let Self::Pixels(Pixels::Bytes(bytes)) = self {
            let steps = room.of(len * E::DEPTH);
            store_steps_of_bytes(simd, &bytes[range], shift, steps);
            return steps;
        }
        let image = self.image(simd, index, (len, 0), single);
        if E::DEPTH == 1 {
            return image;
        }
        let steps = room.of(len * E::DEPTH);
        store_steps_of(simd, image, shift, steps);
        steps
    }
}

/// Memory for one image at a time.
pub(crate) struct Room<E: Element>(Option<Buffer<E>>);

impl<E: Element> Room<E> {
    pub(crate) const fn new() -> Self {
        Self(None)
    }

    /// `len` scalars, with what was there before; the same number every time.
    fn of(&mut self, len: usize) -> &mut [E] {
        self.0.get_or_insert_with(|| Buffer::new(len))
    }
}
